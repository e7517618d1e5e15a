"""Collections: named lists of takes, each with the edits that it had then, for runs to name what they saw.

    DATA/collections/<name>.json          written once, never changed
    DATA/trash/collections/<name>.json    deleted; `restore` brings it back

A take in a collection is not deleted unless asked for twice, see `studio.catalog.Catalog.delete`.
"""

from __future__ import annotations

import dataclasses
import logging
import os
import re
import time
import uuid
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import msgspec

from studio import edits
from studio.edits import Edits, edits_path, sync_folder
from studio.index import EpisodeRow, Filters

if TYPE_CHECKING:
    from studio.catalog import Catalog

LONGEST = 100  # characters of a name

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)
_COMPARED = ("outcome", "quality", "flags", "note", "trim", "segments")

log = logging.getLogger(__name__)


@dataclass(frozen=True, slots=True)
class Member:
    """A take as it was annotated then: `studio.edits.read(path, edit_version)`."""

    episode_id: str
    edit_version: int


@dataclass(frozen=True, slots=True)
class Collection:
    """A named selection."""

    name: str
    created: float  # [s] unix time
    author: str
    note: str
    filters: dict[str, Any]  # that it was made with; empty where takes were named one by one
    members: tuple[Member, ...]  # the oldest first, or as they were named


@dataclass(frozen=True, slots=True)
class Change:
    """What became of a take since a collection was made."""

    episode_id: str
    kind: Literal["edited", "deleted", "gone", "new"]  # new: it matches the filters now
    text: str  # a sentence


def create(
    catalog: Catalog,
    name: str,
    *,
    author: str,
    episode_ids: Sequence[str] | None = None,
    filters: Filters | None = None,
    note: str = "",
) -> Collection:
    """Name some takes, or all that match the filters, as they are now.

    Raises ValueError where the name is taken or no take is meant, KeyError for an unknown take.
    """
    if not _NAME.fullmatch(name) or len(name) > LONGEST:
        raise ValueError(
            f"{name!r} cannot name a collection; use at most {LONGEST} letters, digits, - _ . and begin with "
            "a letter or digit."
        )
    asked = {key: value for key, value in (filters or {}).items() if value not in (None, (), [], "")}
    if (episode_ids is None) == (not asked):
        raise ValueError("A collection is made of episode ids, or of filters: give one of them.")
    rows = (
        _matching(catalog, asked)
        if episode_ids is None
        else [catalog.get(i) for i in dict.fromkeys(episode_ids)]
    )
    if not rows:
        raise ValueError(f"No take matches {asked}." if asked else "A collection needs at least one take.")
    members = tuple(Member(row.episode_id, row.edit_version) for row in rows)
    collection = Collection(name, time.time(), author, note, asked, members)
    _write(_path(catalog.data_dir, name), collection)
    return collection


def revision(data_dir: Path) -> int:
    """Another one whenever a collection is made, deleted or restored."""
    try:
        return _path(data_dir, "x").parent.stat().st_mtime_ns
    except FileNotFoundError:
        return 0


def names(data_dir: Path) -> list[str]:
    """Of all collections."""
    return sorted(path.stem for path in _path(data_dir, "x").parent.glob("*.json"))


def load(data_dir: Path, name: str) -> Collection:
    """Raises KeyError for an unknown name, ValueError for a damaged file."""
    path = _path(data_dir, name)
    try:
        if _NAME.fullmatch(name) and len(name) <= LONGEST:
            return msgspec.json.decode(path.read_bytes(), type=Collection)
    except FileNotFoundError:
        pass
    except msgspec.DecodeError as error:
        raise ValueError(f"{path} is no collection: {error}.") from error
    raise KeyError(f"No collection {name!r}; there are {', '.join(names(data_dir)) or 'none'}.")


def load_all(data_dir: Path) -> list[Collection]:
    """The newest first; damaged files are named in the log."""
    found = []
    for name in names(data_dir):
        try:
            found.append(load(data_dir, name))
        except (KeyError, ValueError) as error:
            log.warning("%s", error.args[0])
    return sorted(found, key=lambda collection: -collection.created)


def holding(data_dir: Path, episode_id: str) -> list[str]:
    """Names of the collections that a take is in."""
    return sorted(
        collection.name
        for collection in load_all(data_dir)
        if any(member.episode_id == episode_id for member in collection.members)
    )


def rows_of(catalog: Catalog, collection: Collection) -> list[EpisodeRow]:
    """Its takes as they were annotated then. Raises KeyError where one is deleted or gone."""
    return [catalog.get_as_of(member.episode_id, member.edit_version) for member in collection.members]


def changes(catalog: Catalog, collection: Collection) -> list[Change]:
    """What became of its takes since, and which takes match its filters by now."""
    catalog.refresh()
    trash = {row.episode_id for row in catalog.trash()}
    found = [change for member in collection.members if (change := _change(catalog, member, trash))]
    if collection.filters:
        known = {member.episode_id for member in collection.members}
        found += [
            Change(row.episode_id, "new", "It matches by now.")
            for row in _matching(catalog, collection.filters)
            if row.episode_id not in known
        ]
    return found


def delete(data_dir: Path, name: str) -> None:
    """Move a collection to the trash, from where `restore` brings it back; its takes stay."""
    load(data_dir, name)
    _move(_path(data_dir, name), _path(data_dir / "trash", name))


def restore(data_dir: Path, name: str) -> Collection:
    """Bring back a collection from the trash. Raises ValueError where its name is taken by now."""
    load(data_dir / "trash", name)
    if _path(data_dir, name).exists():
        raise ValueError(f"There is a collection {name} by now; delete that first.")
    _move(_path(data_dir / "trash", name), _path(data_dir, name))
    return load(data_dir, name)


def _matching(catalog: Catalog, filters: Mapping[str, Any]) -> list[EpisodeRow]:
    catalog.refresh()
    return catalog.episodes(sort="started", descending=False, limit=None, **filters)


def _change(catalog: Catalog, member: Member, trash: set[str]) -> Change | None:
    if member.episode_id in trash:
        return Change(member.episode_id, "deleted", "It is in the trash.")
    row = next(iter(catalog.known([member.episode_id])), None)
    if row is None:
        return Change(member.episode_id, "gone", "It is in the data folder no more.")
    if row.edit_version == member.edit_version:
        return None
    now = edits.read(edits_path(row.path))
    if now.version < member.edit_version:
        return Change(member.episode_id, "edited", "Edits of then are missing in its sidecar.")
    then = edits.fold(now.history[: member.edit_version])
    told = "; ".join(_differences(then, now)) or "edited, and as it was"
    return Change(member.episode_id, "edited", told)


def _differences(then: Edits, now: Edits) -> Iterator[str]:
    for name in _COMPARED:
        before, after = getattr(then, name), getattr(now, name)
        if name == "segments":
            before, after = (tuple(s.label for s in segments) for segments in (before, after))
        if before != after:
            yield f"{name} {_told(before)} → {_told(after)}"


def _told(value: object) -> str:
    if isinstance(value, tuple):
        return ", ".join(map(str, value)) or "none"
    return "as recorded" if value is None else str(value) or "none"


def _path(data_dir: Path, name: str) -> Path:
    return data_dir / "collections" / f"{name}.json"


def _write(path: Path, collection: Collection) -> None:
    """Whole, or not at all, and never over another."""
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(f".{collection.name}.{uuid.uuid4().hex[:8]}.part")
    try:
        with part.open("wb") as file:
            file.write(msgspec.json.format(msgspec.json.encode(dataclasses.asdict(collection)), indent=1))
            file.flush()
            os.fsync(file.fileno())
        try:
            os.link(part, path)
        except FileExistsError:
            raise ValueError(f"There is a collection {collection.name} already.") from None
    finally:
        part.unlink(missing_ok=True)
    sync_folder(path.parent)


def _move(source: Path, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    source.rename(target)
    for folder in (source.parent, target.parent):
        sync_folder(folder)
