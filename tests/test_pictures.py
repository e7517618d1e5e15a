"""Pictures of the tasks, and the page of the documentation that shows them."""

from __future__ import annotations

import re
from pathlib import Path

import cv2
import numpy as np
import pytest

from studio import tasks
from studio.doctor import render_backend
from studio.pictures import CAPTION, GAP, MOMENTS, SIZE, write_picture

DOCS = Path(__file__).parents[1] / "docs"


def test_a_picture_shows_every_camera_at_every_moment(tmp_path: Path) -> None:
    if render_backend() is None:
        pytest.skip("no offscreen rendering on this machine")
    write_picture("wiping", tmp_path / "new" / "wiping.jpg")
    picture = cv2.imread(str(tmp_path / "new" / "wiping.jpg"))
    width, height = SIZE
    rows = np.split(picture, len(tasks.load("wiping").cameras))
    assert picture.shape == (len(rows) * (height + CAPTION), len(MOMENTS) * (width + GAP), 3)
    for row in rows:
        columns = np.split(row[CAPTION:].astype(float), len(MOMENTS), axis=1)
        images = [column[:, :width] for column in columns]
        assert min(image.std() for image in images) > 20.0  # of 255: not one colour
        assert np.abs(images[0] - images[2]).mean() > 2.0  # the arm has moved


def test_the_documentation_has_a_section_and_a_picture_of_each_task() -> None:
    text = (DOCS / "tasks.md").read_text()
    assert set(tasks.names()) <= set(re.findall(r"^## `(.*)`$", text, re.MULTILINE))
    pictures = [DOCS / path for path in re.findall(r"^!\[.*\]\((.*)\)$", text, re.MULTILINE)]
    assert set(tasks.names()) <= {path.stem for path in pictures}
    assert sum(path.stat().st_size for path in pictures) < 600_000
    for name in tasks.names():
        assert tasks.load(name).instruction in text
