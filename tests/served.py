"""`studio serve` in a process of its own, and a second client of its session."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import httpx
from visitor import wait_for

from studio import messages as m
from studio.link import socket_path
from studio.serve import SessionProcess
from studio.ui.remote import Remote

URL = re.compile(r"at (http://127\.0\.0\.1:\d+)")


class Served:
    """A `studio serve` on a folder, in a process of its own. A test's `Site` ends what the test leaves."""

    def __init__(self, data: Path, *options: str) -> None:
        self.data = data
        self.process = subprocess.Popen(
            [
                sys.executable,
                "-m",
                "studio",
                "serve",
                "--data",
                str(data),
                "--port",
                "0",
                "--no-cameras",
                *options,
            ],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )
        self.said: list[str] = []

    def url(self) -> str:
        """As soon as the page is served and the session drives."""
        assert self.process.stdout
        for line in self.process.stdout:
            self.said.append(line)
            if found := URL.search(line):
                return found[1]
        raise AssertionError(f"It ended: {self.said} {self.process.communicate()}")

    def health(self, url: str) -> dict[str, Any]:
        health: dict[str, Any] = httpx.get(f"{url}/api/v1/health").json()
        return health

    def end(self, number: int = signal.SIGTERM) -> int:
        if self.process.poll() is None:
            self.process.send_signal(number)
            self.process.communicate(timeout=30)  # closes the pipes
        return self.process.returncode


class Site:
    """A data folder on which servers run."""

    def __init__(self, data: Path) -> None:
        self.data = data
        self._all: list[Served] = []

    def serve(self, *options: str, data: Path | None = None) -> Served:
        self._all.append(Served(data or self.data, *options))
        return self._all[-1]

    def close(self) -> None:
        for served in self._all:
            served.end(signal.SIGKILL)
        SessionProcess(self.data, "wiping").end()


def start_take(data: Path) -> Remote:
    """A client that has a take recorded for a while."""
    remote = Remote()
    remote.connect(socket_path(data))
    remote.post(m.StartTake(countdown=0.0, operator="ana"))
    wait_for(lambda: (status := remote.status.get()[0]) and status.take_seconds > 0.7)
    return remote
