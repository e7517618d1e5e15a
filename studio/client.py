"""The HTTP API from Python, on this machine or another.

with Client("http://127.0.0.1:8080") as studio:
    for take in studio.episodes(task="wiping", outcome="success").episodes:
        force = studio.columns(take.episode_id, "right/state")["right/state/wrench"]
    with studio.session("ana") as session:      # a seat, as long as it is open
        session.control("ask")
        session.post(Reset(seed=7))
"""

from __future__ import annotations

import getpass
import io
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import TracebackType
from typing import Any, Literal, TypeVar, Unpack
from urllib.parse import quote

import httpx
import msgspec
import numpy as np

from controller.types import Array
from studio.channels import Latest
from studio.client_jobs import JobsClient
from studio.collections import Collection
from studio.curves import Curves, Spread, Timeline
from studio.http_wire import CollectionDetails, Details, Graded, Health, Page, TaskInfo
from studio.index import Amount, EpisodeRow, Filters
from studio.lease import Standing
from studio.messages import ArmFrame, Command, Notice, Status, builtins
from studio.runs import RunInfo

API = "/api/v1"
TIMEOUT = 300.0  # [s] on a busy machine, for the health of a long take, its columns, or the time of a run

T = TypeVar("T")


class Refused(RuntimeError):
    """The studio did not do it; the text says why."""

    def __init__(self, status: int, why: str) -> None:
        super().__init__(why)
        self.status = status  # of HTTP: 404 no such thing, 409 not now, 422 wrong use


class LiveFrame(msgspec.Struct, frozen=True):
    """The robot, as an event stream tells it."""

    time: float  # [s] since reset
    resets: int
    arms: tuple[ArmFrame, ...]


class Client:
    """One program at a studio. Threads may share it; close it, or use it in a `with`."""

    def __init__(
        self, url: str, token: str | None = None, *, author: str | None = None, verify: Any = True
    ) -> None:
        """`author` signs annotations; `verify` is httpx's, e.g. an SSL context that knows the certificate."""
        self.author = author or getpass.getuser()
        self._http = httpx.Client(base_url=url, timeout=TIMEOUT, verify=verify)
        # Who shows the token, or asks for a page, gets a cookie: by it the studio knows this program again.
        answer = self._http.get(
            f"{API}/health",
            params={"token": token} if token else {},
            headers={"Accept": "text/html"},
        )
        if answer.status_code not in (200, 303):
            self._http.close()
            raise Refused(answer.status_code, f"{url} lets nobody in without its token.")

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._http.close()

    # Tasks, takes

    def tasks(self) -> list[TaskInfo]:
        return self._get("/tasks", list[TaskInfo])

    @property
    def jobs(self) -> JobsClient:
        """What runs in the background, and what came of it."""
        return JobsClient(self)

    def runs(self, task: str = "") -> list[RunInfo]:
        """All, or those that learn a task; the one that learned last comes first."""
        return self._get("/runs", list[RunInfo], task=task)

    def evaluations(self) -> list[dict[str, Any]]:
        return self._get("/evaluations", list[dict[str, Any]])

    def refresh(self) -> None:
        """Let the studio look for takes that other processes recorded or edited."""
        self._ask("POST", "/refresh")

    def episodes(
        self,
        *,
        sort: str = "started",
        descending: bool = True,
        limit: int = 50,
        offset: int = 0,
        **filters: Unpack[Filters],
    ) -> Page:
        """Some of the takes that match, and how many do."""
        page = {"sort": sort, "descending": descending, "limit": limit, "offset": offset}
        return self._get("/episodes", Page, **page, **filters)

    def facets(self, **filters: Unpack[Filters]) -> dict[str, dict[str, int]]:
        return self._get("/facets", dict[str, dict[str, int]], **filters)

    def amount(self, **filters: Unpack[Filters]) -> Amount:
        """How many takes match, how long they are together, and how they ended."""
        return self._get("/amount", Amount, **filters)

    def revision(self) -> str:
        """Another one after every change of takes and collections; asking is cheap."""
        return self._get("/revision", dict[str, str])["revision"]

    def thumbnail(self, episode_id: str) -> bytes:
        """A small JPEG of the front camera in the middle of the first contact."""
        return self._ask("GET", f"{_take(episode_id)}/thumbnail").content

    def episode(self, episode_id: str) -> Details:
        return self._get(_take(episode_id), Details)

    def trash(self) -> list[EpisodeRow]:
        return self._get("/trash", list[EpisodeRow])

    def columns(self, episode_id: str, *groups: str, every: int = 1) -> dict[str, Array]:
        """As `studio.episode.Episode.columns`; `every` thins the rows."""
        asked = {"group": list(groups), "every": every, "format": "npz"}
        content = self._ask("GET", f"{_take(episode_id)}/columns", params=asked).content
        with np.load(io.BytesIO(content), allow_pickle=False) as archive:
            return dict(archive)

    def table(self, episode_id: str, *groups: str, every: int = 1) -> Any:
        """The same as a `pyarrow.Table`, for groups that have as many rows each."""
        import pyarrow as pa

        asked = {"group": list(groups), "every": every, "format": "arrow"}
        content = self._ask("GET", f"{_take(episode_id)}/columns", params=asked).content
        return pa.ipc.open_stream(content).read_all()

    def timeline(self, episode_id: str) -> Timeline:
        """Phases, stiffness modes, marks and the times of all images."""
        return self._get(f"{_take(episode_id)}/timeline", Timeline)

    def curves(
        self,
        episode_id: str,
        *names: str,
        points: int = 1000,
        start: float | None = None,
        end: float | None = None,
    ) -> Curves:
        """Curves such as "right/force", or all, between two times [s], enough for a plot `points` wide."""
        asked = {"name": list(names), "points": points, "start": start, "end": end}
        return self._get(f"{_take(episode_id)}/curves", Curves, **asked)

    def spread(self, *episode_ids: str, align: Literal["start", "contact"] = "start") -> Spread:
        """Mean and standard deviation over some takes."""
        return self._get("/spread", Spread, episode_id=list(episode_ids), align=align)

    def video(self, episode_id: str, camera: str) -> bytes:
        """A film of one camera, H.264 at 20 Hz."""
        return self._ask("GET", f"{_take(episode_id)}/video/{quote(camera, safe='')}.mp4").content

    def image_times(self, episode_id: str) -> dict[str, list[float]]:
        """[s] since the scene was reset, of each camera."""
        return self._get(f"{_take(episode_id)}/images", dict[str, list[float]])

    def jpeg(self, episode_id: str, camera: str, number: int) -> bytes:
        return self._ask("GET", f"{_take(episode_id)}/images/{quote(camera, safe='')}/{number}").content

    def jpeg_at(self, episode_id: str, camera: str, at: float) -> bytes:
        """The newest image at or before `at` [s], else the first."""
        return self._ask("GET", f"{_take(episode_id)}/images/{quote(camera, safe='')}/at/{at!r}").content

    def download(self, episode_id: str, path: Path) -> None:
        """The take itself, an MCAP file."""
        with self._http.stream("GET", f"{API}{_take(episode_id)}/recording") as answer:
            _check(answer)
            with path.open("xb") as file:
                for part in answer.iter_bytes():
                    file.write(part)

    def annotate(self, episode_id: str, **changes: Any) -> EpisodeRow:
        """`changes` are fields of `studio.edits.Edit`."""
        return self._post(f"{_take(episode_id)}/annotations", EpisodeRow, self._signed(changes))

    def annotate_all(self, episode_ids: Sequence[str], **changes: Any) -> list[EpisodeRow]:
        """The same to all of them, or to none."""
        said = self._signed(changes) | {"episode_ids": list(episode_ids)}
        return self._post("/annotations", list[EpisodeRow], said)

    def undo(self, episode_id: str) -> EpisodeRow:
        """Take back this author's newest edit."""
        return self._post(f"{_take(episode_id)}/undo", EpisodeRow, params={"author": self.author})

    def delete(self, episode_id: str, *, even_if_used: bool = False) -> EpisodeRow:
        answer = self._ask("DELETE", _take(episode_id), params={"even_if_used": even_if_used})
        return _decoded(answer, EpisodeRow)

    def restore(self, episode_id: str) -> EpisodeRow:
        return self._post(f"{_take(episode_id)}/restore", EpisodeRow)

    # Collections, health

    def make_collection(
        self,
        name: str,
        *,
        episode_ids: Sequence[str] | None = None,
        filters: Filters | None = None,
        note: str = "",
    ) -> Collection:
        asked = {"name": name, "note": note, "author": self.author}
        return self._post(
            "/collections", Collection, asked | {"episode_ids": episode_ids, "filters": filters}
        )

    def collections(self) -> list[Collection]:
        return self._get("/collections", list[Collection])

    def collection(self, name: str) -> CollectionDetails:
        return self._get(f"/collections/{quote(name, safe='')}", CollectionDetails)

    def collection_episodes(self, name: str) -> list[EpisodeRow]:
        """As they were annotated when it was made."""
        return self._get(f"/collections/{quote(name, safe='')}/episodes", list[EpisodeRow])

    def delete_collection(self, name: str) -> None:
        self._ask("DELETE", f"/collections/{quote(name, safe='')}")

    def restore_collection(self, name: str) -> Collection:
        return self._post(f"/collections/{quote(name, safe='')}/restore", Collection)

    def health(self, **filters: Unpack[Filters]) -> Health:
        """Of all takes that match; asks until every one was examined."""
        while (found := self._get("/dataset-health", Health, **filters)).unexamined:
            pass
        return found

    def grades(self, *episode_ids: str) -> dict[str, Graded]:
        """Of those that were examined before."""
        return self._get("/grades", dict[str, Graded], episode_id=list(episode_ids))

    def health_of(self, episode_id: str) -> Health:
        return self._get(f"{_take(episode_id)}/health", Health)

    def name(self) -> str:
        """Under which the studio knows this program; empty without a session."""
        return self._get("/me", dict[str, str])["name"]

    # The live session

    def status(self) -> dict[str, Any]:
        """`state` of the session process, its `status`, the robot's `frame`, and the `holder` of control."""
        return self._get("/session", dict[str, Any])

    @contextmanager
    def session(self, name: str = "", rate: float = 10.0) -> Iterator[LiveSession]:
        """A seat at the session, as long as the block lasts; frames come at most `rate` times a second."""
        asked: dict[str, Any] = {"name": name, "rate": rate}
        timeout = httpx.Timeout(TIMEOUT, read=10.0)
        with self._http.stream("GET", f"{API}/session/events", params=asked, timeout=timeout) as answer:
            _check(answer)
            live = LiveSession(self, answer)
            try:
                yield live
            finally:
                live.end()

    def _signed(self, changes: dict[str, Any]) -> dict[str, Any]:
        return {"author": self.author} | changes

    def _get(self, path: str, kind: type[T], /, **params: Any) -> T:
        given = {name: value for name, value in params.items() if value is not None}
        return _decoded(self._ask("GET", path, params=given), kind)

    def _post(self, path: str, kind: type[T], body: Any = None, *, params: dict[str, Any] | None = None) -> T:
        return _decoded(self._ask("POST", path, body=body, params=params), kind)

    def _ask(
        self, method: str, path: str, *, body: Any = None, params: dict[str, Any] | None = None
    ) -> httpx.Response:
        content = None if body is None else msgspec.json.encode(body)
        headers = {} if body is None else {"Content-Type": "application/json"}
        answer = self._http.request(method, API + path, content=content, params=params, headers=headers)
        _check(answer)
        return answer


class LiveSession:
    """An open event stream: what it told last, and commands, which need control."""

    def __init__(self, client: Client, answer: httpx.Response) -> None:
        self.status: Latest[Status] = Latest()
        self.frame: Latest[LiveFrame] = Latest()
        self.notice: Latest[Notice] = Latest()
        self._client, self._answer = client, answer
        self._ending = False
        self._thread = threading.Thread(target=self._read, name="session events", daemon=True)
        self._thread.start()

    @property
    def is_open(self) -> bool:
        return self._thread.is_alive()

    def post(self, command: Command) -> None:
        """Raises `Refused` where somebody else drives; a free lease is taken."""
        self._client._ask("POST", "/session/commands", body=builtins(command))

    def control(self, action: Literal["ask", "give up", "keep"]) -> Standing:
        """Ask for control, or take it where it is free; give it up; keep it although somebody asks."""
        return self._client._post("/session/control", Standing, {"action": action})

    def wait_for(self, slot: Latest[T], seconds: float = 10.0) -> T:
        """The next of `status`, `frame` or `notice`. Raises TimeoutError."""
        _, before = slot.get()
        deadline = time.monotonic() + seconds
        while time.monotonic() < deadline:
            value, count = slot.get()
            if value is not None and count > before:
                return value
            time.sleep(0.01)
        raise TimeoutError(f"The studio said nothing of that for {seconds} s.")

    def end(self) -> None:
        """Leave the seat; the arms hold."""
        self._ending = True
        self._answer.close()
        self._thread.join()

    def _read(self) -> None:
        kind = ""
        slots: dict[str, tuple[Latest[Any], Any]] = {
            "status": (self.status, Status),
            "frame": (self.frame, LiveFrame),
            "notice": (self.notice, Notice),
        }
        try:
            for line in self._answer.iter_lines():
                name, _, value = line.partition(": ")
                if name == "event":
                    kind = value
                elif name == "data" and kind in slots:
                    slot, told = slots[kind]
                    slot.set(msgspec.json.decode(value, type=told))
        except (httpx.HTTPError, httpx.StreamError):
            if not self._ending:
                return  # `is_open` tells


def _take(episode_id: str) -> str:
    return f"/episodes/{quote(episode_id, safe='')}"


def _check(answer: httpx.Response) -> None:
    if answer.is_error:
        answer.read()
        try:
            told = answer.json()["detail"]
        except (ValueError, KeyError, TypeError):
            told = answer.text
        raise Refused(answer.status_code, told if isinstance(told, str) else str(told))


def _decoded(answer: httpx.Response, kind: type[T]) -> T:
    return msgspec.json.decode(answer.content, type=kind, dec_hook=_path)


def _path(kind: type, value: Any) -> Any:
    if issubclass(kind, Path):
        return Path(value)
    raise TypeError(f"No {kind} of {value!r}.")
