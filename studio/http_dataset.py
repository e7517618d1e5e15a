"""The part of the HTTP API that the dataset page lives on: pictures, sums, grades, and what has changed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Annotated, Any

from fastapi import APIRouter, Header, Query
from starlette.responses import Response

from studio import survey, thumbnails
from studio.api import Studio
from studio.http_wire import MOST, Asked, EpisodeIds, Graded, Health, Name, as_json, refusals
from studio.index import Amount, EpisodeRow
from studio.reading import Reader

FRESH = 3600  # [s] for which a browser need not ask again for a picture: a recording never changes
PATIENCE = 5.0  # [s] of reading after which a request for the health of many takes answers with those it has
PICTURE: dict[int | str, dict[str, Any]] = {200: {"content": {"image/jpeg": {}}}}


def page_router(studio: Studio, reader: Reader) -> APIRouter:
    """`reader` makes pictures, aside."""
    router, catalog = APIRouter(), studio.catalog

    @router.get("/revision", response_model=dict[str, str])
    def read_revision() -> Response:
        """Another `revision` after every change of takes and collections; asking is cheap."""
        return as_json({"revision": catalog.revision()})

    @router.get("/amount", response_model=Amount)
    def read_amount(asked: Asked) -> Response:
        """How many takes match, how long they are together, and how they ended."""
        with refusals():
            return as_json(catalog.amount(**asked.filters()))

    @router.get("/episodes/{episode_id}/thumbnail", response_class=Response, responses=PICTURE)
    def read_thumbnail(
        episode_id: str, if_none_match: Annotated[str | None, Header(max_length=200)] = None
    ) -> Response:
        """A small JPEG of the front camera in the middle of the first contact."""
        with refusals():
            path = catalog.get(episode_id).path
            status = path.stat()
            tag = f'"{status.st_mtime_ns:x}-{status.st_size:x}"'
            headers = {"ETag": tag, "Cache-Control": f"private, max-age={FRESH}"}
            if if_none_match == tag:
                return Response(status_code=304, headers=headers)
            picture = thumbnails.kept(studio.data_dir, path)
            if picture is None:
                picture = reader.aside.read(thumbnails.thumbnail, studio.data_dir, path)
        return Response(picture, media_type="image/jpeg", headers=headers)

    return router


def health_router(studio: Studio, reader: Reader) -> APIRouter:
    """`reader` examines takes, aside."""
    router, catalog = APIRouter(), studio.catalog

    @router.get("/episodes/{episode_id}/health", response_model=Health)
    def grade_episode(episode_id: str) -> Response:
        """What is wrong with a take, and its grade."""
        with refusals():
            return as_json(_health(studio, reader, [catalog.get(episode_id)]))

    @router.get("/dataset-health", response_model=Health)
    def grade_all(asked: Asked) -> Response:
        """What is wrong with the matching takes, each and together.

        Those that nobody examined yet may need several requests: `unexamined` says how many wait.
        """
        with refusals():
            return as_json(_health(studio, reader, catalog.episodes(limit=None, **asked.filters())))

    @router.post("/dataset-health", response_model=Health)
    def grade_some(body: EpisodeIds) -> Response:
        """The same of takes by their ids."""
        with refusals():
            rows = [catalog.get(episode_id) for episode_id in dict.fromkeys(body.episode_ids)]
            return as_json(_health(studio, reader, rows))

    @router.get("/grades", response_model=dict[str, Graded])
    def list_grades(
        episode_id: Annotated[list[Name], Query(min_length=1, max_length=MOST)],
    ) -> Response:
        """The health of those of some takes that were examined before, each by itself."""
        found = {}
        for row in catalog.known(episode_id):
            told = survey.examined(studio.data_dir, row)
            if told is not None:
                told = told.within(row.trim)
                found[row.episode_id] = Graded(told.grade, told.findings)
        return as_json(found)

    return router


def _health(studio: Studio, reader: Reader, rows: Sequence[EpisodeRow]) -> Health:
    told = reader.aside.read(survey.examine_some, studio.data_dir, rows, PATIENCE)
    together = survey.survey(list(zip(rows, told, strict=False)))
    grades = {take.episode_id: take.grade for take in together.takes}
    return Health(together, grades, len(rows) - len(told))
