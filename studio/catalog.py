"""The catalogue of a data folder: find, annotate, delete and restore takes.

The files are the truth, `studio.index` only makes them quick to find. Any number of processes may use one
folder: recordings and sidecars change under one lock of the folder, and a row is always written from the
sidecar as it is inside the writing transaction, so that the last writer has seen every edit.
"""

from __future__ import annotations

import dataclasses
import difflib
import fcntl
import os
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Unpack

from studio import collections, edits
from studio.edits import Edit, Outcome, edits_path, sync_folder
from studio.episode import open_episode, totals_of
from studio.index import FACETS, SORTS, Amount, EpisodeRow, Filters, Index, Stamps, Summary

__all__ = [
    "FACETS",
    "SORTS",
    "Catalog",
    "EpisodeRow",
    "Filters",
    "InUseError",
    "NotFinishedError",
    "Refreshed",
    "Summary",
    "summarise",
]

BATCH = 0.5  # [s] of reading recordings between two commits of `refresh`
OVERHANG = 0.05  # [s] of one image: a player rounds the end of a take up to it
PLACES = ("episodes", "trash")


class InUseError(ValueError):
    """A take that is to be deleted is in a collection."""


class NotFinishedError(KeyError):
    """A take that is asked for is still being recorded, or waits for `studio recover`."""


@dataclass(frozen=True, slots=True)
class Refreshed:
    """What `refresh` found."""

    indexed: int  # takes that are new or changed
    removed: int
    unreadable: dict[Path, str]  # every file that is no take, and why


def summarise(path: Path) -> Summary:
    """What the catalogue keeps of a recording; reads all its forces only where nobody summed them up."""
    found = totals_of(path)
    if found is None:
        with open_episode(path) as episode:
            found = episode.header, episode.totals
    header, totals = found
    return Summary(
        episode_id=header.episode_id,
        task=header.task,
        instruction=header.instruction,
        operator=header.operator,
        agent=header.agent,
        seed=header.seed,
        started=header.started,
        duration=totals.duration,
        arms=header.arms,
        cameras=totals.cameras,
        recorded_success=totals.success,
        progress=totals.progress,
        recovered=totals.recovered,
        peak_force=totals.peak_force,
        mean_force=totals.mean_force,
        stiffness_share=totals.stiffness_share,
    )


class Catalog:
    """The takes of one data folder. Threads may share it; close it, or use it in a `with`."""

    def __init__(self, data_dir: Path, summarise: Callable[[Path], Summary] = summarise) -> None:
        self.data_dir = Path(data_dir).absolute()
        self._summarise = summarise
        if self.data_dir.exists() and not self.data_dir.is_dir():
            raise NotADirectoryError(f"{self.data_dir} is a file; a data folder is needed.")
        self.data_dir.mkdir(parents=True, exist_ok=True)
        with self._folder_lock():
            self._index = Index(self.data_dir)

    def close(self) -> None:
        self._index.close()

    def __enter__(self) -> Catalog:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def refresh(self) -> Refreshed:
        """Bring the index up to date with the files; reads only those whose size or time changed."""
        return self._refresh(reread=False)

    def rebuild(self) -> Refreshed:
        """Read every file again."""
        return self._refresh(reread=True)

    def add(self, path: Path) -> EpisodeRow:
        """Index one take that was just finished, without looking through the whole folder."""
        path = Path(path).absolute()
        self._read([path])
        row = self._index.by_path(path)
        if row is None:
            raise ValueError(self._index.unreadable().get(path, f"There is no take at {path}."))
        return row

    def episodes(
        self,
        *,
        sort: str = "started",
        descending: bool = True,
        limit: int | None = 50,
        offset: int = 0,
        **filters: Unpack[Filters],
    ) -> list[EpisodeRow]:
        """One page of the takes that match every filter, by default the newest; all without a limit."""
        return self._index.page(filters, sort, descending, limit, offset)

    def count(self, **filters: Unpack[Filters]) -> int:
        """How many takes match every filter."""
        return self._index.count(filters)

    def facets(self, **filters: Unpack[Filters]) -> dict[str, dict[str, int]]:
        """How many matching takes have each value of each of FACETS, the most frequent first."""
        return self._index.facets(filters)

    def amount(self, **filters: Unpack[Filters]) -> Amount:
        """How much there is of all takes that match."""
        return self._index.amount(filters)

    def revision(self) -> str:
        """Another one after every change of a take or a collection, whoever makes it; asking is cheap."""
        return f"{self._index.revision()}.{collections.revision(self.data_dir)}"

    def get(self, episode_id: str) -> EpisodeRow:
        """The take of this id; one that another process has just recorded is found, too."""
        row = self._index.by_id(episode_id)
        if row is None:
            self.refresh()
            row = self._index.by_id(episode_id)
        if row is None or self._is_in_trash(row.path):
            raise self._missing(episode_id)
        return row

    def get_as_of(self, episode_id: str, edit_version: int) -> EpisodeRow:
        """A take as it was annotated then. Raises ValueError where its sidecar has fewer edits."""
        row = self.get(episode_id)
        return _row(row, edits.read(edits_path(row.path), edit_version), row.path)

    def known(self, episode_ids: Sequence[str]) -> list[EpisodeRow]:
        """Those of the takes that are in the index and not in the trash."""
        found = [self._index.by_id(episode_id) for episode_id in episode_ids]
        return [row for row in found if row is not None and not self._is_in_trash(row.path)]

    def trash(self) -> list[EpisodeRow]:
        """The deleted takes, the newest first."""
        return self._index.trash()

    def unreadable(self) -> dict[Path, str]:
        """The files in the folder that are no takes, and why."""
        return self._index.unreadable()

    def annotate(self, episode_id: str, *, author: str, **changes: Any) -> EpisodeRow:
        """Append an edit to the take's sidecar; `changes` are fields of `studio.edits.Edit`."""
        return self.annotate_all([episode_id], author=author, **changes)[0]

    def annotate_all(self, episode_ids: Sequence[str], *, author: str, **changes: Any) -> list[EpisodeRow]:
        """One edit to several takes; to none where one of them is missing or the edit does not fit."""
        edit = _edit(author, changes)
        with self._folder_lock():
            rows = [self._get_on_disk(episode_id) for episode_id in dict.fromkeys(episode_ids)]
            if edit.undo is not None:
                _check_undo(edit.undo, rows)
            for row in rows:
                _check_times(edit, row)
            for row in rows:
                edits.append(edits_path(row.path), edit)
            self._read([row.path for row in rows])
        return [self.get(row.episode_id) for row in rows]

    def undo(self, episode_id: str, *, author: str) -> EpisodeRow:
        """Take back the newest edit of `author` that still counts."""
        edit = edits.read(edits_path(self.get(episode_id).path)).undoable(author)
        if edit is None:
            raise KeyError(f"{author!r} has no edit of {episode_id} to take back.")
        return self.annotate(episode_id, author=author, undo=edit.edit_id)

    def delete(self, episode_id: str, *, even_if_used: bool = False) -> EpisodeRow:
        """Move a take and its sidecar to the trash, from where `restore` brings it back.

        Raises `InUseError` where it is in a collection, unless it may go `even_if_used`.
        """
        with self._folder_lock():
            using = [] if even_if_used else collections.holding(self.data_dir, episode_id)
            source = self._get_on_disk(episode_id).path
            if using:
                raise InUseError(
                    f"{episode_id} is in {_some(using)}: a collection names what a run has seen. Delete the "
                    "collection first, or insist (`studio delete --even-if-used`)."
                )
            target = self._place(source, "trash")
            source.rename(target)
            _move_edits(source, target)  # a crash before this leaves the sidecar where `restore` wants it
            return self._moved(source, target)

    def restore(self, episode_id: str) -> EpisodeRow:
        """Move a take and its sidecar back from the trash."""
        with self._folder_lock():
            deleted = {row.episode_id: row.path for row in self.trash() if row.path.exists()}
            if episode_id not in deleted:
                raise KeyError(f"No episode {episode_id!r} in the trash; it has {_some(list(deleted))}.")
            source = deleted[episode_id]
            target = self._place(source, "episodes")
            _move_edits(source, target)
            source.rename(target)
            return self._moved(source, target)

    def adopt(self, source: Path) -> EpisodeRow:
        """Copy a take of another data folder, with its sidecar, under its own id.

        Raise FileExistsError where this folder has a take of that id, in the trash too.
        """
        summary = self._summarise(source)
        if summary.episode_id != source.stem:
            raise ValueError(f"{source} says that it is episode {summary.episode_id!r}; give it that name.")
        with self._folder_lock():
            known = self._index.by_id(summary.episode_id)
            if known is not None and known.path.exists():
                where = "in the trash" if self._is_in_trash(known.path) else f"at {known.path}"
                raise FileExistsError(f"Episode {summary.episode_id} is here already, {where}.")
            target = self._place(source, "episodes")
            draft = target.with_name(f"{target.name}.copy")
            try:
                shutil.copyfile(source, draft)
                with draft.open("rb") as file:
                    os.fsync(file.fileno())
                if edits_path(source).exists():
                    edits.merge(edits_path(source), edits_path(target))
                draft.rename(target)
            except BaseException:
                draft.unlink(missing_ok=True)
                raise
            sync_folder(target.parent)
        return self.add(target)

    # The index and the files.

    def _refresh(self, *, reread: bool) -> Refreshed:
        known, found = self._index.stamps(), self._scan()
        changed = [self.data_dir / path for path in found if reread or known.get(path) != found[path]]
        self._read(changed, reread=reread)
        gone = [path for path in known.keys() - found.keys() if not (self.data_dir / path).exists()]
        if gone:
            with self._index.transaction():
                self._index.remove(gone)
        unreadable = self.unreadable()
        return Refreshed(len(changed) - len(unreadable.keys() & set(changed)), len(gone), unreadable)

    def _scan(self) -> dict[str, Stamps]:
        """Every recording of the folder, by its path below it."""
        found = {}
        for place in PLACES:
            for folder in (self.data_dir / place).glob("*/"):
                stamps = dict(_stamped_files(folder))
                for name, recording in stamps.items():
                    if name.endswith(".mcap"):
                        sidecar = stamps.get(f"{name.removesuffix('.mcap')}.edits.jsonl", "")
                        found[f"{place}/{folder.name}/{name}"] = Stamps(recording, sidecar)
        return found

    def _read(self, paths: Sequence[Path], *, reread: bool = False) -> None:
        """Write the rows of some takes. Recordings are read outside of the transactions, sidecars inside."""
        rest = list(paths)[::-1]
        while rest:
            batch, deadline = [], time.monotonic() + BATCH
            while rest and time.monotonic() < deadline:
                path = rest.pop()
                batch.append((path, self._summary(path, reread=reread)))
            with self._index.transaction():
                for path, summary in batch:
                    self._write(path, summary)

    def _summary(self, path: Path, *, reread: bool) -> Summary | str | None:
        """Of a recording, from its row if it is unchanged; why it cannot be read; None if it is gone."""
        if not reread and self._index.recording_stamp(path) == _stamp(path):
            return self._index.by_path(path)
        try:
            summary = self._summarise(path)
        except FileNotFoundError:
            return None
        except Exception as error:  # whatever a foreign file does to its reader must not hide the other takes
            return f"{path.name} cannot be read: {error}"
        if summary.episode_id != path.stem:
            return f"{path.name} says that it is episode {summary.episode_id!r}; give it back that name."
        return summary

    def _write(self, path: Path, summary: Summary | str | None) -> None:
        stamps = Stamps(_stamp(path), _stamp(edits_path(path)))
        if summary is None or not stamps.recording:
            return  # moved meanwhile, by a process that writes the row itself
        if isinstance(summary, Summary):
            other = self._index.by_id(summary.episode_id)
            if other is None or other.path == path or not other.path.exists():
                said = edits.read(edits_path(path))
                labels = [segment.label for segment in said.segments]
                row = _row(summary, said, path)
                self._index.put(row, stamps, labels, in_trash=self._is_in_trash(path))
                return
            summary = f"{path} has the id of {other.path}; ids must differ."
        self._index.put_unreadable(path, stamps, summary)

    def _place(self, path: Path, place: str) -> Path:
        """Where `path` goes among the episodes or in the trash."""
        target = self.data_dir / place / path.parent.name / path.name
        if target.exists():
            raise FileExistsError(f"{target} exists already; move it away first.")
        target.parent.mkdir(parents=True, exist_ok=True)
        return target

    def _moved(self, source: Path, target: Path) -> EpisodeRow:
        for folder in (source.parent, target.parent):
            sync_folder(folder)
        with self._index.transaction():
            self._index.rename(source, target)
            self._write(target, self._index.by_path(target))
        return self.add(target)

    def _is_in_trash(self, path: Path) -> bool:
        return path.is_relative_to(self.data_dir / "trash")

    def _get_on_disk(self, episode_id: str) -> EpisodeRow:
        row = self.get(episode_id)
        if not row.path.exists():  # moved away by hand
            self.refresh()
            raise self._missing(episode_id)
        return row

    def _missing(self, episode_id: str) -> KeyError:
        """Why there is no such take, and what to do."""
        parts = (self.data_dir / "episodes").glob("*/*.mcap.part")
        if any(part.name == f"{episode_id}.mcap.part" for part in parts):
            return NotFinishedError(
                f"Episode {episode_id!r} is still being recorded, or waits for `studio recover`."
            )
        return KeyError(self._why_missing(episode_id))

    def _why_missing(self, episode_id: str) -> str:
        if any(row.episode_id == episode_id for row in self.trash()):
            return f"Episode {episode_id!r} is in the trash; `studio restore {episode_id}` brings it back."
        for path, why in self.unreadable().items():
            if path.stem == episode_id:
                return why
        ids = self._index.ids()
        if not ids:
            return f"No episode {episode_id!r}: there are none in {self.data_dir}."
        near = [known for known in reversed(ids) if episode_id and episode_id in known]
        near = near or difflib.get_close_matches(episode_id, ids[-1000:], n=5, cutoff=0.5)
        hint = f"near are {', '.join(near[:5])}; " if near else ""
        return f"No episode {episode_id!r}; {hint}`studio episodes` lists all {len(ids)}."

    @contextmanager
    def _folder_lock(self) -> Iterator[None]:
        """Held while files of the folder are moved or annotated, by one thread of one process."""
        with (self.data_dir / ".lock").open("a") as file:
            fcntl.flock(file, fcntl.LOCK_EX)
            yield


def _row(summary: Summary, said: edits.Edits, path: Path) -> EpisodeRow:
    recorded: dict[bool | None, Outcome] = {True: "success", False: "failure", None: "unmarked"}
    return EpisodeRow(
        **{field.name: getattr(summary, field.name) for field in dataclasses.fields(Summary)},
        outcome=said.outcome or recorded[summary.recorded_success],
        quality=said.quality,
        flags=said.flags,
        note=said.note,
        trim=said.trim,
        edit_version=said.version,
        path=path,
        size=path.stat().st_size,
    )


def _stamped_files(folder: Path) -> Iterator[tuple[str, str]]:
    """Name and stamp of the recordings and sidecars in a folder."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith((".mcap", ".edits.jsonl")):
                yield entry.name, _stamp(entry)


def _stamp(file: Path | os.DirEntry[str]) -> str:
    try:
        status = file.stat()
    except FileNotFoundError:
        return ""
    return f"{status.st_mtime_ns}:{status.st_size}"


def _move_edits(source: Path, target: Path) -> None:
    """The sidecar of one recording to another; what lies there already is kept as well."""
    old, new = edits_path(source), edits_path(target)
    if not old.exists():
        return
    if new.exists():
        edits.merge(old, new)
        old.unlink()
    else:
        old.rename(new)


def _edit(author: str, changes: dict[str, Any]) -> Edit:
    possible = [field.name for field in dataclasses.fields(Edit)][1:]
    unknown = changes.keys() - set(possible)
    if unknown:
        raise TypeError(f"Unknown field {min(unknown)!r}; an edit has {', '.join(possible)}.")
    listed = {name: tuple(value) for name, value in changes.items() if isinstance(value, list)}
    return Edit(author=author, **changes | listed)


def _check_undo(edit_id: str, rows: Sequence[EpisodeRow]) -> None:
    """An edit of several takes has one id in all of them."""
    for row in rows:
        if edit_id not in {edit.edit_id for edit in edits.read(edits_path(row.path)).history}:
            raise KeyError(f"No edit {edit_id!r} to take back in {row.episode_id}.")


def _check_times(edit: Edit, row: EpisodeRow) -> None:
    ends = {f"segment {segment.label!r}": segment.end for segment in edit.put_segments}
    if edit.trim is not None:
        ends["trim"] = edit.trim[1]
    for name, end in ends.items():
        if end > row.duration + OVERHANG:
            raise ValueError(f"The {name} ends at {end:.2f} s, but {row.episode_id} at {row.duration:.2f} s.")


def _some(names: Sequence[str], most: int = 5) -> str:
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return (", ".join(names[:most]) + rest) or "none"
