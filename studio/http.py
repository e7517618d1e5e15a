"""The HTTP API under /api/v1: everything of `studio.api` and the live session; its description at /api/docs.

Whoever comes in at the door may read and annotate. The robot obeys who holds the lease, as on the page, and a
program holds it only as long as its event stream is open: a program that dies lets go of the arms.

What a request reads from the disk is read on a thread, and what is heavy (columns, health) by a process of
its own, `studio.reading`: this process carries the operator's hands.
"""

from __future__ import annotations

import asyncio
import threading
from contextlib import suppress
from typing import Annotated, Any, Literal, get_args

import msgspec
from fastapi import APIRouter, FastAPI, HTTPException, Query, Request
from fastapi.openapi.docs import get_swagger_ui_html
from starlette.responses import HTMLResponse, Response
from starlette.types import Receive, Scope, Send

from studio import messages as m
from studio import tasks
from studio.api import Studio
from studio.channels import Latest
from studio.door import person_of
from studio.http_jobs import jobs_router
from studio.http_runs import runs_router
from studio.http_takes import takes_router
from studio.http_view import Views, view_router
from studio.http_wire import Body, Name, Problem, TaskInfo, as_json, refusals, schema_of
from studio.lease import Lease, NotDriving, PersonId, Seat
from studio.pages import add_pages
from studio.reading import Reader
from studio.ui.remote import Remote

MAX_RATE = 30.0  # [Hz] of frames in an event stream
QUIET = 2.0  # [s] after which an event stream says that it is still there
SWAGGER = "/assets/node_modules/swagger-ui-dist"

Posted = (
    m.Reset
    | m.Drive
    | m.Engage
    | m.MoveTo
    | m.Mirror
    | m.Nudge
    | m.SetMode
    | m.SwitchMode
    | m.SetGripper
    | m.Release
    | m.StartTake
    | m.EndTake
    | m.DiscardTake
    | m.Collect
    | m.RestartCameras
)
"""What a program may tell the session; the rest belongs to headsets, and to the studio itself."""

_commands: msgspec.json.Decoder[Posted] = msgspec.json.Decoder(Posted)
_STREAM = {"content": {"text/event-stream": {"schema": {"type": "string"}}}}
_COMMAND = {"requestBody": {"required": True, "content": {"application/json": {"schema": schema_of(Posted)}}}}
REFUSED: dict[int | str, dict[str, Any]] = {
    404: {"model": Problem, "description": "There is no such thing"},
    409: {"model": Problem, "description": "Not now: it is being recorded, in use, or not yours to drive"},
}


class Streams:
    """The event streams that are open, and the seats at the lease that they keep."""

    def __init__(self, lease: Lease) -> None:
        self._lease, self._lock = lease, threading.Lock()
        self._seats: list[Seat] = []

    def sit(self, person: PersonId, name: str) -> Seat:
        seat = self._lease.sit(person, "program", name)
        with self._lock:
            self._seats.append(seat)
        return seat

    def leave(self, seat: Seat) -> None:
        with self._lock:
            self._seats.remove(seat)
        seat.leave()

    def seat_of(self, person: PersonId) -> Seat:
        """Raises `NotDriving` where this person has no stream open."""
        with self._lock:
            found = next((seat for seat in self._seats if seat.person == person), None)
        if found is None:
            raise NotDriving(
                "Open /api/v1/session/events first, with the same cookie, and keep it open: control lasts as "
                "long as it does."
            )
        return found


class ControlIn(Body):
    """What to do about control."""

    action: Literal["ask", "give up", "keep"]  # ask: take it where it is free, else ask its holder


def add_api(app: FastAPI, studio: Studio, remote: Remote, lease: Lease, views: Views | None = None) -> Reader:
    """Mount the routes and our pages; close the reader that is returned when the server has ended.

    `views` are those of the page, where there is one.
    """
    reader = Reader()
    app.include_router(_session_router(remote, lease), prefix="/api/v1")
    app.include_router(takes_router(studio, remote, reader), prefix="/api/v1")
    app.include_router(view_router(studio, reader, views), prefix="/api/v1")
    app.include_router(_studio_router(studio), prefix="/api/v1")
    app.include_router(jobs_router(studio), prefix="/api/v1")
    app.include_router(runs_router(studio, reader), prefix="/api/v1")
    add_pages(app, reader.start)

    @app.get("/api/docs", include_in_schema=False)
    async def show_docs() -> HTMLResponse:
        return get_swagger_ui_html(
            openapi_url=app.openapi_url or "",
            title=app.title,
            swagger_js_url=f"{SWAGGER}/swagger-ui-bundle.js",
            swagger_css_url=f"{SWAGGER}/swagger-ui.css",
            swagger_favicon_url=f"{SWAGGER}/favicon-32x32.png",
        )

    return reader


def _studio_router(studio: Studio) -> APIRouter:
    router = APIRouter(tags=["studio"], responses=REFUSED)

    @router.get("/tasks", response_model=list[TaskInfo])
    def list_tasks() -> Response:
        """The tasks that can be chosen."""
        return as_json([_task_info(name) for name in tasks.names()])

    return router


def _task_info(name: str) -> TaskInfo:
    task = tasks.load(name)
    arms = {arm.name: [mode.value for mode in arm.modes] for arm in task.arms}
    return TaskInfo(task.name, task.instruction, arms, [view.name for view in task.cameras], task.time_limit)


def _session_router(remote: Remote, lease: Lease) -> APIRouter:
    router, streams = APIRouter(tags=["session"], responses=REFUSED), Streams(lease)

    @router.get("/session")
    async def read_session() -> Response:
        """How things are: `state` of the session process, its `status`, the robot's `frame`, who drives."""
        return as_json(_now(remote, lease))

    @router.get("/session/events", response_class=Response, responses={200: _STREAM})
    async def stream_session(
        request: Request,
        rate: Annotated[float, Query(ge=0, le=MAX_RATE, allow_inf_nan=False)] = 10.0,
        name: Name = "",
    ) -> Response:
        """Server-sent events `status`, `frame` (at most `rate` a second) and `notice`.

        While it is open you have a seat: you may take control, and command. `name` is yours, for others.
        """
        return EventStream(remote, streams, person_of(request), name, rate)

    @router.get("/me", response_model=dict[str, str])
    def tell_me(request: Request) -> Response:
        """Under which `name` the studio knows who asks; empty where nobody gave one."""
        return as_json({"name": lease.name_of(person_of(request))})

    @router.post("/session/control")
    def control(request: Request, body: ControlIn) -> Response:
        """Take control or ask for it, give it up, or keep it although somebody asks."""
        with refusals():
            seat = streams.seat_of(person_of(request))
            {"ask": seat.ask, "give up": seat.give_up, "keep": seat.keep}[body.action]()
            return as_json(seat.standing)

    @router.post("/session/commands", status_code=202, openapi_extra=_COMMAND)
    async def command(request: Request) -> Response:
        """Tell the session to do something. A free lease is taken; who does not hold it is refused."""
        body = await request.body()
        with refusals():
            given = _commands.decode(body)
            if getattr(given, "operator", None) == "":
                given = msgspec.structs.replace(given, operator=lease.holder_name)
            streams.seat_of(person_of(request)).post(given)
        return as_json({"accepted": type(given).__name__}, 202)

    @router.get("/session/images/{camera}", response_class=JpegResponse)
    async def read_live_image(camera: str) -> Response:
        """The newest image of a camera."""
        if (image := remote.images.get(camera)) is None:
            raise HTTPException(404, f"No image of {camera!r}; there are {sorted(remote.images) or 'none'}.")
        return JpegResponse(image.jpeg)

    return router


class JpegResponse(Response):
    """An image."""

    media_type = "image/jpeg"


def _now(remote: Remote, lease: Lease) -> dict[str, Any]:
    frame, _ = remote.frame.get()
    return {
        "state": remote.state,
        "status": remote.status.get()[0],
        "frame": None if frame is None else _frame(frame),
        "holder": lease.holder,
    }


def _frame(frame: m.Frame) -> dict[str, Any]:
    """Without the positions of the whole scene, whose order only its model knows."""
    return {name: getattr(frame, name) for name in ("time", "resets", "arms")}


class EventStream(Response):
    """Tells the live session until its reader goes away. One seat at the lease, as long as it is open."""

    media_type = "text/event-stream"

    def __init__(self, remote: Remote, streams: Streams, person: PersonId, name: str, rate: float) -> None:
        super().__init__()
        self._remote, self._streams, self._person, self._name = remote, streams, person, name
        self._period = 1 / rate if rate else 0.1
        self._with_frames = rate > 0
        self._told: dict[str, int] = {}

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        seat = self._streams.sit(self._person, self._name)
        gone = asyncio.ensure_future(_wait_until_gone(receive))
        try:
            headers = [(b"content-type", b"text/event-stream"), (b"cache-control", b"no-store")]
            await send({"type": "http.response.start", "status": 200, "headers": headers})
            await send({"type": "http.response.body", "body": b": hello\n\n", "more_body": True})
            quiet = 0.0
            while not gone.done():
                news = b"".join(self._news())
                quiet = 0.0 if news else quiet + self._period
                if quiet >= QUIET:
                    news, quiet = b": still here\n\n", 0.0
                if news:
                    await send({"type": "http.response.body", "body": news, "more_body": True})
                with suppress(TimeoutError):
                    await asyncio.wait_for(asyncio.shield(gone), self._period)
        except OSError:  # the reader is gone
            pass
        finally:
            gone.cancel()
            self._streams.leave(seat)

    def _news(self) -> list[bytes]:
        """Whatever was set since the last look."""
        remote = self._remote
        slots: dict[str, Latest[Any]] = {"status": remote.status, "notice": remote.newest_notice}
        if self._with_frames:
            slots["frame"] = remote.frame
        news = []
        for kind, slot in slots.items():
            value, count = slot.get()
            is_old = kind == "notice" and kind not in self._told  # said before this stream was opened
            if count != self._told.get(kind) and value is not None and not is_old:
                told = _frame(value) if isinstance(value, m.Frame) else value
                news.append(b"event: %s\ndata: %s\n\n" % (kind.encode(), msgspec.json.encode(told)))
            self._told[kind] = count
        return news


async def _wait_until_gone(receive: Receive) -> None:
    while (await receive())["type"] != "http.disconnect":
        pass


assert not set(get_args(Posted)) & {m.Shutdown, m.OperatorLeft}
