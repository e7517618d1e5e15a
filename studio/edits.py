"""What people say about a take: an append-only file of edits beside it, one JSON object a line.

The recording itself is never touched. Every process appends under a file lock, so no two lines mix; the state
of a take is the fold of its lines in file order. A scalar (outcome, quality, note, trim) is its newest value;
flags and segments are added and removed one by one, so that what two people say at the same time survives.
Nothing is erased: `undo` names an edit to leave out of the fold, and undoing that undo brings it back.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
import math
import os
import time
import uuid
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any, Literal, cast, get_args

Outcome = Literal["success", "failure", "unmarked"]
OUTCOMES: tuple[Outcome, ...] = get_args(Outcome)
QUALITIES = (1, 2, 3, 4, 5)
FLAGS = ("jittery", "hesitation", "excessive_force", "collision", "wrong_object")  # others are kept too
CLEARABLE = ("outcome", "quality", "note", "trim")


def edits_path(episode: Path) -> Path:
    """The sidecar of `<id>.mcap`: `<id>.edits.jsonl`."""
    return episode.with_suffix(".edits.jsonl")


def _new_id() -> str:
    return uuid.uuid4().hex[:12]


@dataclass(frozen=True, slots=True)
class Segment:
    """A labelled stretch of a take. The same id put again moves or renames it."""

    start: float  # [s] since the take's start
    end: float  # [s]
    label: str
    segment_id: str = field(default_factory=_new_id)

    def __post_init__(self) -> None:
        if not (_is_time(self.start) and _is_time(self.end) and self.start < self.end):
            raise ValueError(
                f"A segment needs 0 <= start < end in seconds, not {self.start!r} to {self.end!r}."
            )
        if not (_is_word(self.label) and _is_word(self.segment_id)):
            raise ValueError(
                f"A segment needs a label and an id, not {self.label!r} and {self.segment_id!r}."
            )


@dataclass(frozen=True, slots=True, kw_only=True)
class Edit:
    """One line of the sidecar: what one person changed at one time. None and () leave things as they are."""

    author: str
    time: float = field(default_factory=time.time)  # [s] since 1970
    edit_id: str = field(default_factory=_new_id)
    outcome: Outcome | None = None
    quality: int | None = None  # 1 poor .. 5 excellent
    note: str | None = None
    trim: tuple[float, float] | None = None  # [s] in and out points; the recording is not cut
    add_flags: tuple[str, ...] = ()
    remove_flags: tuple[str, ...] = ()
    put_segments: tuple[Segment, ...] = ()
    remove_segments: tuple[str, ...] = ()  # segment ids
    clear: tuple[str, ...] = ()  # scalars to set back to what was recorded, see CLEARABLE
    undo: str | None = None  # the edit_id that this edit takes back
    more: Mapping[str, Any] = field(default_factory=dict)  # fields of other versions, kept as they are

    def __post_init__(self) -> None:
        for name, check in _CHECKS.items():
            value = getattr(self, name)
            if value is not None:
                check(value)
        both = [name for name in self.clear if getattr(self, name) is not None]
        if both:
            raise ValueError(f"An edit cannot set and clear {both[0]} at once.")

    @property
    def changes(self) -> tuple[str, ...]:
        """The fields that this edit says something about."""
        return (*(name for name in _CHANGES if getattr(self, name) not in (None, ())), *self.more)


@dataclass(frozen=True, slots=True)
class Edits:
    """A take's sidecar, folded."""

    outcome: Outcome | None = None  # None: as recorded
    quality: int | None = None
    note: str = ""
    trim: tuple[float, float] | None = None  # [s]
    flags: tuple[str, ...] = ()  # sorted
    segments: tuple[Segment, ...] = ()  # by start
    more: Mapping[str, Any] = field(default_factory=dict)
    history: tuple[Edit, ...] = ()  # every line, oldest first, also those taken back

    @property
    def version(self) -> int:
        """How many edits there were: with the episode's id it names this very state, see `read`."""
        return len(self.history)

    def undoable(self, author: str) -> Edit | None:
        """The newest edit of `author` that still counts; other people's edits are left alone."""
        mine = [e for e in _in_force(self.history) if e.author == author and e.undo is None]
        return mine[-1] if mine else None


def append(path: Path, edit: Edit) -> None:
    """Add one line to the sidecar at `path` and wait until the disk has it."""
    if not edit.changes:
        raise ValueError(f"The edit by {edit.author!r} changes nothing; give at least one of {_CHANGES}.")
    line = json.dumps(_encode(edit), ensure_ascii=False, allow_nan=False).encode() + b"\n"
    with _locked(path) as file:
        written = file.read()
        ids = [earlier.edit_id for earlier in _parse(written)]
        if edit.undo is not None and edit.undo not in ids:
            raise KeyError(f"No edit {edit.undo!r} to take back in {path.name}; it has {ids}.")
        _write(file, line if written.endswith(b"\n") or not written else b"\n" + line)


def read(path: Path, version: int | None = None) -> Edits:
    """The folded sidecar at `path`, empty where there is none; `version` gives an earlier state."""
    history = _parse(_read_whole(path))
    if version is not None and not 0 <= version <= len(history):
        raise ValueError(f"{path.name} has no version {version}; it has 0 to {len(history)}.")
    return fold(history[:version])


def merge(source: Path, target: Path) -> None:
    """Append the lines of `source` that `target` lacks. Safe to repeat."""
    lines = _read_whole(source)
    with _locked(target) as file:
        written = file.read()
        known = {edit.edit_id for edit in _parse(written)}
        missing = [_encode(edit) for edit in _parse(lines) if edit.edit_id not in known]
        added = "".join(json.dumps(line, ensure_ascii=False) + "\n" for line in missing).encode()
        _write(file, added if written.endswith(b"\n") or not written else b"\n" + added)


def fold(history: Sequence[Edit]) -> Edits:
    """The state after `history`, oldest first."""
    scalars: dict[str, Any] = {}
    flags: set[str] = set()
    segments: dict[str, Segment] = {}
    more: dict[str, Any] = {}
    for edit in _in_force(history):
        given = {name: getattr(edit, name) for name in CLEARABLE}
        scalars |= {name: value for name, value in given.items() if value is not None}
        for name in edit.clear:
            scalars.pop(name, None)
        flags = (flags | set(edit.add_flags)) - set(edit.remove_flags)
        segments |= {segment.segment_id: segment for segment in edit.put_segments}
        for segment_id in edit.remove_segments:
            segments.pop(segment_id, None)
        more |= edit.more
    return Edits(
        **scalars,
        flags=tuple(sorted(flags)),
        segments=tuple(sorted(segments.values(), key=lambda s: (s.start, s.end, s.segment_id))),
        more=more,
        history=tuple(history),
    )


def _in_force(history: Sequence[Edit]) -> list[Edit]:
    """Without the edits that were taken back. Read backwards, so that an undone undo takes nothing back."""
    taken_back: set[str] = set()
    kept = []
    for edit in reversed(history):
        if edit.edit_id in taken_back:
            continue
        kept.append(edit)
        if edit.undo is not None:
            taken_back.add(edit.undo)
    return kept[::-1]


# The file: lines that are not a whole JSON object (a torn tail, damage) do not count.


def _parse(lines: bytes) -> list[Edit]:
    edits: dict[str, Edit] = {}  # the first line of an id counts, so that merging twice changes nothing
    repeats: Counter[bytes] = Counter()
    for line in lines.split(b"\n"):
        try:
            fields = json.loads(line)
        except ValueError:  # also what is not UTF-8
            continue
        if isinstance(fields, dict):
            repeats[line] += 1
            edit = _decode(fields, f"{hashlib.sha1(line).hexdigest()[:12]}-{repeats[line]}")
            edits.setdefault(edit.edit_id, edit)
    return list(edits.values())


def _encode(edit: Edit) -> dict[str, Any]:
    line: dict[str, Any] = {"id": edit.edit_id, "author": edit.author, "time": edit.time}
    for name in _CHANGES:
        value = getattr(edit, name)
        if name == "put_segments":
            value = tuple(dataclasses.asdict(segment) for segment in value)
        if value not in (None, ()):
            line[name] = value
    return line | dict(edit.more)


def _decode(fields: dict[str, Any], default_id: str) -> Edit:
    """An Edit of a JSON object. What this version does not know or would refuse goes to `more`."""
    known: dict[str, Any] = {"author": "unknown", "time": 0.0, "edit_id": default_id}
    more: dict[str, Any] = {}
    for key, value in fields.items():
        name = "edit_id" if key == "id" else key
        if value is None and name in _CHECKS:
            continue
        try:
            known[name] = _checked(name, value)
        except (KeyError, TypeError, ValueError):
            more[key] = value
    for name in set(known.get("clear", ())) & set(known):
        del known[name]
    return Edit(**known, more=more)


def _checked(name: str, value: Any) -> Any:
    if name == "put_segments":
        value = [Segment(**segment) for segment in value]
    if isinstance(value, list):
        value = tuple(value)
    _CHECKS[name](value)
    return value


def _read_whole(path: Path) -> bytes:
    try:
        with path.open("rb") as file:
            fcntl.flock(file, fcntl.LOCK_SH)
            return file.read()
    except FileNotFoundError:
        return b""


@contextmanager
def _locked(path: Path) -> Iterator[IO[bytes]]:
    with path.open("a+b", buffering=0) as file:
        fcntl.flock(file, fcntl.LOCK_EX)
        file.seek(0)
        yield cast("IO[bytes]", file)


def _write(file: IO[bytes], added: bytes) -> None:
    """All of it on disk, or an OSError and the file as it was."""
    size = file.seek(0, os.SEEK_END)
    rest = memoryview(added)
    try:
        while rest:
            rest = rest[file.write(rest) :]
        os.fsync(file.fileno())
        if not size:
            sync_folder(Path(file.name).parent)
    except OSError:
        file.truncate(size)
        raise


def sync_folder(folder: Path) -> None:
    """Wait until the names in `folder` are on disk."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


# What each field may hold.


def _is_time(value: object) -> bool:
    return (
        isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value) and value >= 0
    )


def _is_word(value: object) -> bool:
    return isinstance(value, str) and bool(value.strip())


def _check_word(value: object) -> None:
    if not _is_word(value):
        raise ValueError(f"An edit needs an author and an id of at least one letter, not {value!r}.")


def _check_time(value: object) -> None:
    if not _is_time(value):
        raise ValueError(f"The time of an edit is seconds since 1970, not {value!r}.")


def _check_outcome(value: object) -> None:
    if value not in OUTCOMES:
        raise ValueError(f"Unknown outcome {value!r}; possible are {', '.join(OUTCOMES)}.")


def check_quality(value: object) -> None:
    if isinstance(value, bool) or not isinstance(value, int) or value not in QUALITIES:
        raise ValueError(f"Quality {value!r} is not a whole number from 1 (poor) to 5 (excellent).")


def _check_note(value: object) -> None:
    if not isinstance(value, str):
        raise ValueError(f"A note is text, not {value!r}.")


def _check_trim(value: object) -> None:
    if not (
        isinstance(value, tuple) and len(value) == 2 and all(map(_is_time, value)) and value[0] < value[1]
    ):
        raise ValueError(f"Trim needs two times 0 <= in < out in seconds, not {value!r}.")


def _check_words(value: object) -> None:
    if not (isinstance(value, tuple) and all(map(_is_word, value))):
        raise ValueError(f"Flags and segment ids are given as a tuple of words, not {value!r}.")


def _check_flags(value: object) -> None:
    _check_words(value)
    spaced = [flag for flag in cast("tuple[str, ...]", value) if len(flag.split()) != 1]
    if spaced:
        raise ValueError(f"Flag {spaced[0]!r} has spaces; write it as one word, like {FLAGS[2]!r}.")


def _check_segments(value: object) -> None:
    if not (isinstance(value, tuple) and all(isinstance(segment, Segment) for segment in value)):
        raise ValueError(f"put_segments is a tuple of Segment, not {value!r}.")


def _check_clear(value: object) -> None:
    if not (isinstance(value, tuple) and set(value) <= set(CLEARABLE)):
        raise ValueError(f"Cannot clear {value!r}; possible are {', '.join(CLEARABLE)}.")


_CHECKS = {
    "author": _check_word,
    "time": _check_time,
    "edit_id": _check_word,
    "outcome": _check_outcome,
    "quality": check_quality,
    "note": _check_note,
    "trim": _check_trim,
    "add_flags": _check_flags,
    "remove_flags": _check_flags,
    "put_segments": _check_segments,
    "remove_segments": _check_words,
    "clear": _check_clear,
    "undo": _check_word,
}
_CHANGES = tuple(name for name in _CHECKS if name not in ("author", "time", "edit_id"))
