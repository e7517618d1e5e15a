"""The folder of an export: there when it is whole, never half of it; and how far it has come."""

from __future__ import annotations

import json
import shutil
import threading
import uuid
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from studio.export.source import Take
from studio.recorder import versions

TAKES = "takes.json"  # in every export: which takes it holds, with which edits


class Cancelled(RuntimeError):
    """Somebody asked to stop; what was written is gone."""


class Progress:
    """How far a long work has come, told to whoever waits for it."""

    def __init__(
        self,
        total: float,
        tell: Callable[[float, str], None] = lambda share, what: None,
        cancel: threading.Event | None = None,
    ) -> None:
        """`tell` hears the share done, 0..1, and what is being done; `cancel` may be set by any thread."""
        self._total, self._tell, self._cancel = max(total, 1e-9), tell, cancel
        self._done = 0.0

    def advance(self, amount: float, what: str) -> None:
        """Raise `Cancelled` where that was asked for."""
        if self._cancel is not None and self._cancel.is_set():
            raise Cancelled(f"Cancelled at {self._done / self._total:.0%}; what was written is removed.")
        self._done += amount
        self._tell(min(self._done / self._total, 1.0), what)


@contextmanager
def new_folder(out: Path) -> Iterator[Path]:
    """A folder to write to, which becomes `out` at the end. Whatever is raised removes it, and only it."""
    out = out.absolute()
    if out.exists() and not out.is_dir():
        raise NotADirectoryError(f"{out} is a file; an export needs a new or empty folder.")
    if out.exists() and any(out.iterdir()):
        raise FileExistsError(f"{out} is not empty; an export needs a new or empty folder.")
    out.parent.mkdir(parents=True, exist_ok=True)
    draft = out.with_name(f".{out.name}.{uuid.uuid4().hex[:8]}.part")
    draft.mkdir()
    try:
        yield draft
        draft.replace(out)  # also over an empty folder
    except BaseException:
        shutil.rmtree(draft, ignore_errors=True)
        raise


def write_takes(folder: Path, form: str, takes: Sequence[Take], told: Mapping[str, Any]) -> None:
    """Say what the export in `folder` holds."""
    facts = {
        "format": form,
        "exported": datetime.now(UTC).isoformat(timespec="seconds"),
        "studio": versions()["studio"],
        **told,
        "takes": [take.to_json() for take in takes],
    }
    (folder / TAKES).write_text(json.dumps(facts, indent=1, ensure_ascii=False))


def size_of(folder: Path) -> int:
    """[bytes] of all its files."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file())
