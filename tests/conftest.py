"""What several files of tests share: a twin, a data folder with two takes, agents of a few lines."""

from __future__ import annotations

from pathlib import Path

import pytest

from studio import tasks
from studio.api import DemoReport, Studio
from studio.twin import Twin


@pytest.fixture(scope="session")
def twin() -> Twin:
    """The wiping scene. Tests share it: reset it first."""
    return Twin(tasks.load("wiping"))


@pytest.fixture(scope="session")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, DemoReport]:
    """A data folder with the demonstrations of seeds 7 and 8, without images. Tests only read it."""
    data = tmp_path_factory.mktemp("recorded")
    with Studio(data) as studio:
        return data, studio.demo("wiping", episodes=2, seed=7, cameras=False)
