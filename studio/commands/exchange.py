"""Commands that give takes to other programs and take them from there."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated, Literal

from tyro.conf import Positional, arg

from studio.commands.terminal import (
    DATA,
    Data,
    Json,
    ProgressPath,
    console,
    ends_orderly,
    plain,
    print_json,
    progress,
)
from studio.jobs.progress import ProgressFile

PERCENT = 100


def export(
    ids: Positional[tuple[Annotated[str, arg(metavar="ID")], ...]] = (),
    *,
    out: Path,
    format: Literal["lerobot", "act-hdf5", "rrd"] = "lerobot",
    collection: str | None = None,
    task: str | None = None,
    operator: str | None = None,
    agent: str | None = None,
    outcome: Literal["success", "failure", "unmarked"] | None = None,
    min_quality: int | None = None,
    flags: tuple[str, ...] = (),
    rate: float = 20.0,
    actions: Literal["cartesian", "joints"] = "cartesian",
    cameras: tuple[str, ...] | None = None,
    images: bool = True,
    pad: bool = True,
    takes: Path | None = None,
    data: Data = DATA,
    progress_file: ProgressPath = None,
    json: Json = False,
) -> int:
    """Write takes as a dataset or as Rerun recordings, all or nothing; Ctrl-C removes what was written.

    Trims and outcomes are those of the takes' annotations; the file takes.json tells which.

    Args:
        ids: Takes to export, in this order; else all that match, the oldest first.
        out: A new or empty folder.
        format: lerobot (v3), act-hdf5 (the paper's layout), or rrd (Rerun).
        collection: The takes of a collection, with the edits that they had then.
        flags: All of these must be set.
        rate: Rows a second of a dataset.
        actions: Poses and stiffness, or the joints that plain ACT learns.
        cameras: Only these.
        images: Off leaves out all cameras.
        pad: ACT files are as long as the longest, the last row repeated.
        takes: The takes.json of a run or a job: exactly these takes, with the edits that they had then.
    """
    from studio.api import Studio
    from studio.export import Options
    from studio.training import chosen_in

    options = Options(rate, actions, cameras if images else (), pad)
    filters = (task, operator, agent, outcome, min_quality, *flags)
    if sum((bool(ids), collection is not None, takes is not None, any(filters))) != 1:
        raise ValueError("Say which takes: by their ids, as a --collection, or by a filter such as --task.")
    with Studio(data) as studio:
        if takes is not None:
            named = chosen_in(takes)
            chosen = [take.episode_id for take in named]
            versions = {t.episode_id: t.edit_version for t in named if t.edit_version is not None}
        elif collection is not None:
            members = studio.collection(collection).members
            chosen = [member.episode_id for member in members]
            versions = {member.episode_id: member.edit_version for member in members}
        elif ids:
            chosen, versions = list(ids), {}
        else:
            rows = studio.episodes(
                task=task,
                operator=operator,
                agent=agent,
                outcome=outcome,
                min_quality=min_quality,
                flags=flags or None,
            )
            chosen, versions = [row.episode_id for row in reversed(rows)], {}
        file = ProgressFile(progress_file, PERCENT)
        with _percents(_takes(chosen), quiet=json, file=file) as tell, ends_orderly():
            done = studio.export(chosen, out, format, options, versions=versions, on_progress=tell)
        file.end(plain(done))
    if json:
        print_json(done)
        return 0
    console.print(
        f"{_takes(done.episode_ids)}, {done.seconds:.0f} s, {done.size / 1e6:.1f} MB in {done.folder}",
        soft_wrap=True,
    )
    return 0


def import_takes(
    source: Positional[Annotated[Path, arg(metavar="PATH")]],
    task: str | None = None,
    arms: tuple[str, ...] = (),
    rate: float | None = None,
    data: Data = DATA,
    json: Json = False,
) -> int:
    """Bring in takes of another data folder, of a LeRobot v3 dataset, or of ACT's HDF5 files.

    Takes of a data folder keep their ids and annotations; those that are here already are refused.

    Args:
        source: The folder, or one HDF5 file.
        task: What a dataset's takes show, where it does not tell.
        arms: Of a dataset that does not name its numbers, left to right.
        rate: Rows a second, where a dataset does not tell.
    """
    from studio.api import Studio

    with Studio(data) as studio, _percents(f"{source.name}", quiet=json) as tell:
        found = studio.import_takes(source, task=task, arms=arms, rate=rate, on_progress=tell)
    if json:
        print_json(found)
        return int(bool(found.refused))
    console.print(f"{_takes(found.episode_ids)} from {found.source} to {data}", soft_wrap=True)
    for why in found.refused.values():
        console.print(f"  refused: {why}", style="yellow", soft_wrap=True)
    for column in found.left_out:
        console.print(f"  left out: {column}", style="yellow", soft_wrap=True)
    return int(bool(found.refused))


def _takes(names: Sequence[str]) -> str:
    return f"{len(names)} take{'' if len(names) == 1 else 's'}"


@contextmanager
def _percents(
    what: str, quiet: bool, file: ProgressFile | None = None
) -> Iterator[Callable[[float, str], None]]:
    """A progress bar for what tells its share, 0..1."""
    with progress(what, PERCENT, quiet=quiet) as advance:
        shown = 0

        def tell(share: float, name: str) -> None:
            nonlocal shown
            if file is not None:
                file.tell(share * PERCENT, name)
            while shown < int(share * PERCENT):
                shown += 1
                advance()

        yield tell
