"""What the HTTP API takes and gives: bodies, errors with a sentence, JSON of our own types."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal, cast

import msgspec
from fastapi import HTTPException, Query
from pydantic import BaseModel, ConfigDict, Field
from starlette.responses import Response

from studio.catalog import InUseError, NotFinishedError
from studio.collections import Change, Collection
from studio.edits import Edit, Outcome, Segment
from studio.episode import EpisodeError, Event
from studio.health import Finding, Grade
from studio.index import SORTS, EpisodeRow, Filters
from studio.jobs.queue import JobBusyError
from studio.lease import NotDriving
from studio.survey import DatasetHealth

MOST = 1000  # takes in one answer, or in one request
MOST_IN_3D = 4  # takes in one 3-D view
INT64 = 2**63 - 1  # SQLite's

Text = Annotated[str, Field(max_length=20_000)]
Name = Annotated[str, Field(max_length=200)]
Quality = Annotated[int, Field(ge=1, le=5)]
Shift = Annotated[float, Field(ge=-1e9, le=1e9, allow_inf_nan=False)]
Seconds = Annotated[float, Field(ge=0, le=1e9, allow_inf_nan=False)]


class Body(BaseModel):
    """Of a request; what it does not know it refuses."""

    model_config = ConfigDict(extra="forbid")


class Problem(BaseModel):
    """Why a request was refused."""

    detail: str


class SegmentIn(Body):
    """A labelled stretch; the id of an old one moves or renames it."""

    start: Seconds
    end: Seconds
    label: Name
    segment_id: Name | None = None

    def segment(self) -> Segment:
        return Segment(**self.model_dump(exclude_none=True))


class Changes(Body):
    """What somebody says about takes; whatever is left out stays as it is."""

    author: Name = "program"
    outcome: Outcome | None = None
    quality: Quality | None = None
    note: Text | None = None
    trim: tuple[Seconds, Seconds] | None = None
    add_flags: list[Name] = []
    remove_flags: list[Name] = []
    put_segments: list[SegmentIn] = []
    remove_segments: list[Name] = []
    clear: list[Name] = []
    undo: Name | None = None
    edit_id: Annotated[str, Field(pattern=r"^[\w-]{1,64}$")] | None = None  # a name for it, to undo it by

    def fields(self) -> dict[str, Any]:
        """For `studio.edits.Edit`."""
        given = {name: getattr(self, name) for name in type(self).model_fields if name != "episode_ids"}
        given["put_segments"] = [segment.segment() for segment in self.put_segments]
        return {name: value for name, value in given.items() if value is not None and value != []}


class ManyChanges(Changes):
    """The same said about several takes, or about none of them."""

    episode_ids: Annotated[list[Name], Field(min_length=1, max_length=MOST)]


class FiltersIn(Body):
    """Of takes; null asks for nothing."""

    task: Name | None = None
    operator: Name | None = None
    agent: Name | None = None
    outcome: Outcome | None = None
    min_quality: Quality | None = None
    flags: list[Name] | None = None
    seed: Annotated[int, Field(ge=0, le=INT64)] | None = None
    text: Text | None = None

    def filters(self) -> Filters:
        return cast("Filters", {name: getattr(self, name) for name in FiltersIn.model_fields})


class PageIn(FiltersIn):
    """Which of the takes that match, and in what order."""

    sort: Literal[SORTS] = "started"  # type: ignore[valid-type]
    descending: bool = True
    limit: Annotated[int, Field(ge=0, le=MOST)] = 50
    offset: Annotated[int, Field(ge=0, le=10**9)] = 0


Asked = Annotated[FiltersIn, Query()]
AskedPage = Annotated[PageIn, Query()]


class CollectionIn(Body):
    """Takes to name: by their ids, or by filters."""

    name: Name
    author: Name = "program"
    note: Text = ""
    episode_ids: Annotated[list[Name], Field(max_length=100_000)] | None = None
    filters: FiltersIn | None = None


class ViewIn(Body):
    """What the 3-D view of a page of the studio is to show."""

    view: Name  # the key by which that page knows itself
    episode_ids: Annotated[list[Name], Field(max_length=MOST_IN_3D)] = []  # none: the live scene again
    shifts: list[Shift] = []  # [s] that each take, but the first, is ahead of the first one's time
    time: Seconds = 0.0  # [s] in the first one
    speed: Annotated[float, Field(ge=0, le=16, allow_inf_nan=False)] = 0.0  # 0 stands still
    bar: bool = False  # open the first take as the Episodes tab does, with its own bar


class EpisodeIds(Body):
    """Some takes."""

    episode_ids: Annotated[list[Name], Field(min_length=1, max_length=100_000)]


@dataclass(frozen=True, slots=True)
class Page:
    """Some of the takes that match."""

    total: int  # how many match
    episodes: list[EpisodeRow]


@dataclass(frozen=True, slots=True)
class Details:
    """Everything about a take but its columns and images."""

    row: EpisodeRow
    header: dict[str, Any]
    reason: str  # for how it ended
    events: list[Event]
    ticks_with_limits: int
    images: dict[str, int]  # of each camera
    segments: tuple[Segment, ...]
    history: tuple[Edit, ...]  # every edit, the oldest first


@dataclass(frozen=True, slots=True)
class CollectionDetails:
    """A collection, and what became of its takes since."""

    collection: Collection
    changes: list[Change]


@dataclass(frozen=True, slots=True)
class Health:
    """Of the takes that were examined so far."""

    together: DatasetHealth
    grades: dict[str, Grade]  # of each take
    unexamined: int  # takes that wait for the next request


@dataclass(frozen=True, slots=True)
class Graded:
    """What is wrong with a take that was examined."""

    grade: Grade
    findings: tuple[Finding, ...]


@dataclass(frozen=True, slots=True)
class TaskInfo:
    """A task that can be chosen."""

    task: str
    instruction: str
    arms: dict[str, list[str]]  # stiffness modes of each
    cameras: list[str]
    time_limit: float  # [s]


REFUSED: dict[int | str, dict[str, Any]] = {
    404: {"model": Problem, "description": "There is no such take, column, image or collection"},
    409: {"model": Problem, "description": "Not now: it is still being recorded, or in use"},
}


def as_json(value: Any, status: int = 200) -> Response:
    """Of dataclasses, msgspec structs and plain values; NaN becomes null, a path text."""
    body = msgspec.json.encode(value, enc_hook=_text)
    return Response(body, status, media_type="application/json")


def _text(value: Any) -> str:
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"No JSON for {type(value)}.")


@contextmanager
def refusals() -> Iterator[None]:
    """Around what a request asks for: what is refused becomes an answer with a sentence."""
    try:
        yield
    except (NotFinishedError, InUseError, NotDriving, EpisodeError, FileExistsError, JobBusyError) as error:
        raise HTTPException(409, _words(error)) from error
    except (KeyError, IndexError, FileNotFoundError) as error:
        raise HTTPException(404, _words(error)) from error
    except (ValueError, TypeError, msgspec.DecodeError) as error:
        raise HTTPException(422, _words(error)) from error


def _words(error: Exception) -> str:
    return str(error.args[0]) if len(error.args) == 1 else str(error)


def schema_of(message: Any) -> dict[str, Any]:
    """The JSON schema of a msgspec type, without references."""
    (schema,), parts = msgspec.json.schema_components([message], ref_template="{name}")

    def inlined(node: Any) -> Any:
        if isinstance(node, dict):
            if "$ref" in node:
                return inlined(parts[node["$ref"]])
            return {name: inlined(value) for name, value in node.items() if name != "discriminator"}
        return [inlined(item) for item in node] if isinstance(node, list) else node

    told: dict[str, Any] = inlined(schema)
    return told
