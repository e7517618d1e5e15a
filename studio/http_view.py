"""The part of the HTTP API behind the view of a take: its timeline and curves, films, and the 3-D view."""

from __future__ import annotations

from typing import Annotated, Any, Literal, Protocol

from fastapi import APIRouter, Query, Request
from starlette.responses import FileResponse, Response

from studio import curves, videos
from studio.api import Studio
from studio.curves import Curves, Spread, Timeline
from studio.door import person_of
from studio.http_wire import Name, Problem, ViewIn, as_json, refusals
from studio.lease import PersonId
from studio.reading import Reader

MOST_TOGETHER = 50  # takes that are averaged

REFUSED: dict[int | str, dict[str, Any]] = {
    404: {"model": Problem, "description": "There is no such take, curve, camera or view"},
    409: {"model": Problem, "description": "Not now: it is still being recorded"},
}
_FILM = {"content": {"video/mp4": {"schema": {"type": "string", "format": "binary"}}}}
At = Annotated[float | None, Query(ge=0, le=1e9, allow_inf_nan=False)]


class Views(Protocol):
    """The 3-D views that are open, whoever they belong to."""

    def show_in(self, person: PersonId, asked: ViewIn) -> None:
        """Raise KeyError where this person has no such view."""


def view_router(studio: Studio, reader: Reader, views: Views | None) -> APIRouter:
    """`reader` does what is heavy, what takes seconds aside."""
    router, catalog = APIRouter(tags=["view of takes"], responses=REFUSED), studio.catalog

    @router.get("/episodes/{episode_id}/timeline", response_model=Timeline)
    def read_timeline(episode_id: str) -> Response:
        """Phases, stiffness modes, marks and the times of all images."""
        with refusals():
            told = reader.read(curves.timeline_json, catalog.get(episode_id).path)
        return Response(told, media_type="application/json")

    @router.get("/episodes/{episode_id}/curves", response_model=Curves)
    def read_curves(
        episode_id: str,
        name: Annotated[list[Name], Query(max_length=100)] = [],  # noqa: B006
        points: Annotated[int, Query(ge=10, le=5000)] = 1000,
        start: At = None,
        end: At = None,
    ) -> Response:
        """Curves such as `right/force`, by default all, between two times; enough for a plot `points` wide.

        A longer stretch is told by the least and the greatest of each of `points` parts, so that no peak is
        lost.
        """
        with refusals():
            path = catalog.get(episode_id).path
            told = reader.read(curves.curves_json, path, tuple(name), points, start, end)
        return Response(told, media_type="application/json")

    @router.get("/spread", response_model=Spread)
    def read_spread(
        episode_id: Annotated[list[Name], Query(min_length=1, max_length=MOST_TOGETHER)],
        align: Literal["start", "contact"] = "start",
    ) -> Response:
        """Mean and standard deviation over some takes, aligned at their start or at their first contact."""
        with refusals():
            paths = {each: catalog.get(each).path for each in episode_id}
            read = {each: reader.read(curves.resample, path, align) for each, path in paths.items()}
            left_out = [each for each, take in read.items() if take is None]
            return as_json(curves.spread([take for take in read.values() if take is not None], left_out))

    @router.get(
        "/episodes/{episode_id}/video/{camera}.mp4", response_class=FileResponse, responses={200: _FILM}
    )
    def read_video(episode_id: str, camera: str) -> FileResponse:
        """A film of one camera, H.264 at 20 Hz from the take's time zero; parts of it by `Range`.

        It is made at the first request, which takes seconds.
        """
        with refusals():
            path = catalog.get(episode_id).path
            film = reader.aside.read(videos.video, studio.data_dir, path, camera)
        return FileResponse(
            film, media_type="video/mp4", filename=film.name, content_disposition_type="inline"
        )

    @router.put("/view", status_code=204)
    def show(request: Request, body: ViewIn) -> Response:
        """Show takes in the 3-D view of a page that the same person has open."""
        with refusals():
            if views is None:
                raise KeyError("This studio has no 3-D view.")
            views.show_in(person_of(request), body)
        return Response(status_code=204)

    return router
