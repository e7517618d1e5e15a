"""What several files of tests share: a twin, a data folder with two takes, a program at a studio."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from http_site import Site

from studio import tasks
from studio.api import DemoReport, Studio
from studio.client import Client
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


@pytest.fixture
def client(site: Site) -> Iterator[Client]:
    """Of the file's own `site`."""
    with Client(site.front.url, author="ann") as client:
        yield client


@pytest.fixture
def ids(site: Site) -> list[str]:
    """Of the takes of the file's own `site`."""
    return [row.episode_id for row in site.studio.episodes()]
