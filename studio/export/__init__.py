"""Takes for other programs: datasets to learn from, recordings to look at. One file for each format.

Each has `write(takes, folder, options, progress)`; what can be read again, `studio.export.imports` reads.
"""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal, get_args

from studio.export.folder import Cancelled, Progress, new_folder, size_of, write_takes
from studio.export.source import Control, Take, check_alike, choose

__all__ = ["FORMATS", "Cancelled", "Exported", "Format", "Options", "Take", "choose", "export"]

Format = Literal["lerobot", "act-hdf5", "rrd"]
FORMATS: tuple[Format, ...] = get_args(Format)


@dataclass(frozen=True, slots=True)
class Options:
    """How takes become rows of a dataset. A Rerun recording keeps every rate as it is."""

    rate: float = 20.0  # [Hz] of the rows; cameras record at 20 Hz
    control: Control = "cartesian"  # or "joints": what plain ACT learns
    cameras: tuple[str, ...] | None = None  # None: all
    pad: bool = True  # ACT HDF5: repeat the last row until all takes are equally long

    def __post_init__(self) -> None:
        if not 1 <= self.rate <= 100:
            raise ValueError(f"Rows from 1 to 100 Hz are possible, not {self.rate:g}.")


@dataclass(frozen=True, slots=True)
class Exported:
    """What `export` has written."""

    format: Format
    folder: Path
    episode_ids: tuple[str, ...]
    seconds: float  # of takes, within their trims
    size: int  # [bytes]


def export(
    takes: Sequence[Take],
    form: Format,
    out: Path,
    options: Options | None = None,
    tell: Callable[[float, str], None] = lambda share, what: None,
    cancel: threading.Event | None = None,
) -> Exported:
    """Write takes to the new or empty folder `out`, all or nothing.

    `tell` hears the share done and the take in work; `cancel`, set by any thread, ends it with `Cancelled`.
    Raises ValueError, telling what differs, where takes cannot be in one dataset.
    """
    if form not in FORMATS:
        raise KeyError(f"No format {form!r}; there are {', '.join(FORMATS)}.")
    options = options or Options()
    if form != "rrd":
        check_alike(takes, options.cameras)
    seconds = sum(take.span[1] - take.span[0] for take in takes)
    with new_folder(out) as folder:
        _format(form).write(takes, folder, options, Progress(seconds, tell, cancel))
        write_takes(folder, form, takes, {} if form == "rrd" else {"options": asdict(options)})
    names = tuple(take.episode_id for take in takes)
    return Exported(form, out.absolute(), names, round(seconds, 3), size_of(out))


def _format(form: Format) -> Any:
    """The module of a format; it loads heavy libraries."""
    return importlib.import_module(f"{__name__}.{form.replace('-', '_')}")
