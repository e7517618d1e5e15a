"""A studio on a data folder, its HTTP API behind a front server: no page of viser's, no session process.

A file of tests has a fixture `site` of it; `client` and `ids` in `conftest.py` are of that one.
"""

from __future__ import annotations

from pathlib import Path

from studio.api import Studio
from studio.benchmarks.episodes import made_up_header, write_take
from studio.http import add_api
from studio.lease import Lease
from studio.server import FrontServer, make_app
from studio.ui.remote import Remote

NOBODY = 9  # the discard port: the page of viser is not needed here


class Site:
    """Close it."""

    def __init__(self, data: Path, **options: object) -> None:
        """`options` are the front server's."""
        self.studio, self.remote = Studio(data), Remote()
        self.studio.catalog.refresh()
        self.lease = Lease(self.remote.post)
        self.app = make_app(NOBODY)
        self.reader = add_api(self.app, self.studio, self.remote, self.lease)
        self.front = FrontServer(self.app, port=0, **options)  # type: ignore[arg-type]
        self.front.start()

    def close(self) -> None:
        self.front.stop()
        self.reader.close()
        self.remote.close()
        self.studio.close()


def record(data: Path, *seconds: float) -> None:
    """A take of each length, of two arms and three cameras."""
    for length in seconds:
        header = made_up_header()
        write_take(data / "episodes" / header.task / f"{header.episode_id}.mcap", header, length)
