"""How far a command has come, for whoever waits for it: `--progress-file FILE`, one small JSON value.

The file is replaced as the command goes on, a few times a second at most, and once more at its end. A disk
that is full stops the telling, never the work.
"""

from __future__ import annotations

import dataclasses
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import msgspec

from studio.jobs.job import Progress

PERIOD = 0.5  # [s] between two writings


class ProgressFile:
    """Tells a file, or nobody where there is none."""

    def __init__(self, path: Path | None, total: float, first: float = 0.0) -> None:
        """`first` was done already when the command began."""
        self._path, self._written = path, 0.0
        self._now = Progress(first, total, first=first, began=time.time())
        self._rollouts: list[dict[str, Any]] = []
        self._write()

    def tell(self, done: float, what: str = "") -> None:
        """So much of the total is done."""
        self._change(done=done, what=what)
        if time.monotonic() - self._written >= PERIOD:
            self._write()

    def add(self, rollout: dict[str, Any]) -> None:
        """One more of an evaluation."""
        self._rollouts.append(rollout)
        self._change(done=len(self._rollouts), rollouts=tuple(self._rollouts))
        self._write()

    def end(self, result: dict[str, Any]) -> None:
        """The command is finished, with what it prints with `--json`."""
        self._change(result=result)
        self._write()

    def _change(self, **fields: Any) -> None:
        self._now = dataclasses.replace(self._now, updated=time.time(), **fields)

    def _write(self) -> None:
        self._written = time.monotonic()
        if self._path is None:
            return
        part = self._path.with_name(f".{self._path.name}.part")
        with suppress(OSError):
            part.write_bytes(msgspec.json.encode(self._now, enc_hook=str))
            part.replace(self._path)
