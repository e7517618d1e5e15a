"""What all commands share: their common arguments, and how they print."""

from __future__ import annotations

import dataclasses
import json
import math
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Any, Literal

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn
from rich.table import Table
from tyro.conf import arg

Data = Annotated[Path, arg(metavar="DIR", help="The data folder.")]
Json = Annotated[bool, arg(name="json", help="Print one JSON value instead of text.")]
EpisodeId = Annotated[str, arg(metavar="ID", help="An episode; see `studio episodes`.")]
ProgressPath = Annotated[
    Path | None,
    arg(metavar="FILE", help="Keep telling this file how far it is, as JSON."),
]
TaskName = Annotated[str, arg(metavar="TASK", help="A task; see `studio tasks`.")]

DATA = Path("data")
UNLIMITED = 10_000  # [columns] where nobody sees the edge of a terminal: one row, one line
console = Console(width=None if sys.stdout.isatty() else UNLIMITED, markup=False)
errors = Console(stderr=True, markup=False)


def say(text: str) -> None:
    """At once, also where the output is a pipe."""
    print(text, flush=True)


def complain(text: object) -> None:
    errors.print(f"studio: {text}", style="red", soft_wrap=True)


def print_json(value: Any) -> None:
    print(encode(value))


def encode(value: Any) -> str:
    return json.dumps(plain(value), ensure_ascii=False)


def plain(value: Any) -> Any:
    """What JSON can hold: dataclasses as objects, paths as text, NaN as null."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: plain(getattr(value, field.name)) for field in dataclasses.fields(value)}
    if isinstance(value, dict):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value if isinstance(value, str | int | float | bool | None) else str(value)


def table_of(*columns: str) -> Table:
    """The first column is never folded; those that begin with ">" hold numbers."""
    table = Table(box=None, header_style="bold", pad_edge=False)
    for number, column in enumerate(columns):
        justify: Literal["left", "right"] = "right" if column.startswith(">") else "left"
        table.add_column(column.lstrip(">"), justify=justify, no_wrap=number == 0, overflow="fold")
    return table


@contextmanager
def progress(what: str, total: int, quiet: bool) -> Iterator[Callable[[], None]]:
    """A progress bar on standard error; call what it yields once for each thing done."""
    columns = (TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn())
    with Progress(*columns, console=errors, disable=quiet or not errors.is_terminal, transient=True) as bar:
        task = bar.add_task(what, total=total)
        yield lambda: bar.advance(task)


@contextmanager
def ends_orderly() -> Iterator[None]:
    """Let SIGTERM do what Ctrl-C does: what is half done is put away before the process ends."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def interrupt(*_: object) -> None:
        signal.signal(signal.SIGTERM, signal.SIG_IGN)  # once is enough
        raise KeyboardInterrupt

    before = signal.signal(signal.SIGTERM, interrupt)
    try:
        yield
    finally:
        signal.signal(signal.SIGTERM, before)
