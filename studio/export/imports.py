"""Takes from elsewhere: datasets of other programs, and other data folders."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from studio.catalog import Catalog
from studio.export.folder import Progress
from studio.export.rebuild import Rows, write_take

Source = Literal["studio", "lerobot", "act-hdf5"]
READERS: dict[Source, str] = {"lerobot": "lerobot_reader", "act-hdf5": "act_hdf5"}


@dataclass(frozen=True, slots=True)
class Imported:
    """What `import_takes` found."""

    source: Source
    episode_ids: tuple[str, ...]
    refused: dict[str, str]  # takes of a data folder that were not copied, and why
    left_out: tuple[str, ...]  # columns of a dataset that no episode has


def import_takes(
    catalog: Catalog,
    source: Path,
    *,
    task: str | None = None,
    arms: Sequence[str] = (),
    rate: float | None = None,
    tell: Callable[[float, str], None] = lambda share, what: None,
    cancel: threading.Event | None = None,
) -> Imported:
    """Bring in the takes of a data folder, of a LeRobot v3 dataset, or of ACT's HDF5 files.

    Takes of a data folder keep their ids, and those that are here already are refused, each with its reason;
    those copied stay, whatever comes after. A dataset's takes become new episodes, all or none. `task` names
    theirs, `arms` and `rate` [Hz] are needed where the dataset does not tell.
    """
    kind = kind_of(source)
    if kind == "studio":
        return _copy(catalog, source, tell, cancel)
    module: Any = importlib.import_module(f"studio.export.{READERS[kind]}")
    total, takes = module.read(source, tuple(arms), rate)
    progress = Progress(total, tell, cancel)
    written, left_out = _write(catalog, takes, source, task, progress)
    ids = tuple(catalog.add(path).episode_id for path in written)
    return Imported(kind, ids, {}, left_out)


def kind_of(source: Path) -> Source:
    """What lies at `source`."""
    if (source / "meta" / "info.json").is_file():
        return "lerobot"
    if (source / "episodes").is_dir():
        return "studio"
    if (source.is_file() and source.suffix in (".hdf5", ".h5")) or any(source.glob("episode_*.hdf5")):
        return "act-hdf5"
    if not source.exists():
        raise FileNotFoundError(f"There is nothing at {source}.")
    raise ValueError(
        f"{source} is neither a data folder (episodes/), nor a LeRobot dataset (meta/info.json), nor ACT's "
        "(episode_0.hdf5 …)."
    )


def _write(
    catalog: Catalog, takes: Iterator[Rows], source: Path, task: str | None, progress: Progress
) -> tuple[list[Path], tuple[str, ...]]:
    """All takes, or none of them."""
    written: list[Path] = []
    left_out: dict[str, None] = {}
    try:
        for rows in takes:
            progress.advance(0.0, rows.name)
            written.append(write_take(rows, catalog.data_dir, source.absolute().name, task, progress))
            left_out |= dict.fromkeys(rows.left_out)
    except BaseException:
        for path in written:
            path.unlink(missing_ok=True)
        raise
    return written, tuple(left_out)


def _copy(
    catalog: Catalog, source: Path, tell: Callable[[float, str], None], cancel: threading.Event | None
) -> Imported:
    if source.resolve() == catalog.data_dir.resolve():
        raise ValueError(f"{source} is this very data folder; name another.")
    paths = sorted((source / "episodes").glob("*/*.mcap"))
    if not paths:
        raise ValueError(f"There are no takes in {source}.")
    catalog.refresh()
    progress = Progress(len(paths), tell, cancel)
    copied, refused = [], {}
    for path in paths:
        progress.advance(0.0, path.stem)
        try:
            copied.append(catalog.adopt(path).episode_id)
        except (FileExistsError, ValueError) as error:  # what is no take is told, too
            refused[path.stem] = str(error)
        progress.advance(1.0, path.stem)
    return Imported("studio", tuple(copied), refused, ())
