"""The part of the HTTP API that is about takes: finding, reading, annotating, collecting, grading."""

from __future__ import annotations

import dataclasses
from typing import Annotated, Literal

from fastapi import APIRouter, Query
from fastapi import Path as InPath
from starlette.responses import FileResponse, Response

from studio import edits
from studio.api import Studio
from studio.collections import Collection
from studio.edits import edits_path
from studio.episode import Episode
from studio.http_dataset import health_router, page_router
from studio.http_wire import (
    REFUSED,
    Asked,
    AskedPage,
    Changes,
    CollectionDetails,
    CollectionIn,
    Details,
    ManyChanges,
    Page,
    as_json,
    refusals,
)
from studio.index import EpisodeRow
from studio.messages import TakeRestored, TakeTrashed
from studio.reading import Reader, columns_arrow, columns_json, columns_npz, jpeg, jpeg_at
from studio.ui.remote import Remote

UNCHANGING = {"Cache-Control": "private, max-age=86400, immutable"}  # of recordings, which nobody edits

Number = Annotated[int, InPath(ge=0, le=10**9)]
Time = Annotated[float, InPath(ge=0, le=1e9, allow_inf_nan=False)]


def takes_router(studio: Studio, remote: Remote, reader: Reader) -> APIRouter:
    """`remote` hears which takes are deleted and restored; `reader` does what is heavy."""
    router = APIRouter(responses=REFUSED)
    router.include_router(_catalog_router(studio, remote), tags=["takes"])
    router.include_router(_content_router(studio, reader), tags=["content of takes"])
    router.include_router(_collections_router(studio), tags=["collections"])
    router.include_router(health_router(studio, reader), tags=["health"])
    router.include_router(page_router(studio, reader), tags=["dataset page"])
    return router


def _catalog_router(studio: Studio, remote: Remote) -> APIRouter:
    router, catalog = APIRouter(), studio.catalog

    @router.get("/episodes", response_model=Page)
    def list_episodes(asked: AskedPage) -> Response:
        """One page of the takes that match every filter."""
        with refusals():
            filters = asked.filters()
            rows = catalog.episodes(
                sort=asked.sort,
                descending=asked.descending,
                limit=asked.limit,
                offset=asked.offset,
                **filters,
            )
            return as_json(Page(catalog.count(**filters), rows))

    @router.get("/facets", response_model=dict[str, dict[str, int]])
    def count_facets(asked: Asked) -> Response:
        """How many matching takes have each task, operator, agent, outcome, quality and flag."""
        with refusals():
            return as_json(catalog.facets(**asked.filters()))

    @router.post("/refresh")
    def refresh() -> Response:
        """Look for takes that other processes recorded or edited."""
        with refusals():
            found = catalog.refresh()
        unreadable = {path.name: why for path, why in found.unreadable.items()}
        return as_json({"indexed": found.indexed, "removed": found.removed, "unreadable": unreadable})

    @router.get("/trash", response_model=list[EpisodeRow])
    def list_trash() -> Response:
        """The deleted takes, the newest first."""
        return as_json(catalog.trash())

    @router.post("/annotations", response_model=list[EpisodeRow])
    def annotate_many(body: ManyChanges) -> Response:
        """The same said about several takes, or about none of them."""
        with refusals():
            return as_json(catalog.annotate_all(body.episode_ids, **body.fields()))

    @router.post("/episodes/{episode_id}/annotations", response_model=EpisodeRow)
    def annotate(episode_id: str, body: Changes) -> Response:
        """Say something about a take; what was said before is kept."""
        with refusals():
            return as_json(catalog.annotate(episode_id, **body.fields()))

    @router.post("/episodes/{episode_id}/undo", response_model=EpisodeRow)
    def undo(episode_id: str, author: Annotated[str, Query(max_length=200)] = "program") -> Response:
        """Take back the newest edit of this author that still counts."""
        with refusals():
            return as_json(catalog.undo(episode_id, author=author))

    @router.delete("/episodes/{episode_id}", response_model=EpisodeRow)
    def delete(episode_id: str, even_if_used: bool = False) -> Response:
        """Move a take to the trash; one in a collection only if insisted."""
        with refusals():
            row = catalog.delete(episode_id, even_if_used=even_if_used)
        remote.post(TakeTrashed(episode_id=row.episode_id))
        return as_json(row)

    @router.post("/episodes/{episode_id}/restore", response_model=EpisodeRow)
    def restore(episode_id: str) -> Response:
        """Bring a take back from the trash."""
        with refusals():
            row = catalog.restore(episode_id)
        remote.post(TakeRestored(episode_id=row.episode_id))
        return as_json(row)

    return router


def _content_router(studio: Studio, reader: Reader) -> APIRouter:
    router, catalog = APIRouter(), studio.catalog

    @router.get("/episodes/{episode_id}", response_model=Details)
    def read_episode(episode_id: str) -> Response:
        """Everything about a take but its columns and images."""
        with refusals():
            row = catalog.get(episode_id)
            said = edits.read(edits_path(row.path))
            with studio.open(episode_id) as episode:
                return as_json(_details(row, said, episode))

    @router.get("/episodes/{episode_id}/columns")
    def read_columns(
        episode_id: str,
        group: Annotated[list[str], Query(max_length=20)] = [],  # noqa: B006
        every: Annotated[int, Query(ge=1, le=10**6)] = 1,
        format: Literal["json", "npz", "arrow"] = "json",
    ) -> Response:
        """Columns of some groups, e.g. `right/state`, `right/applied` and `tick`; by default of all.

        `every` thins the rows. As JSON, NaN is null. An Arrow stream holds groups with as many rows each.
        """
        read, media = {
            "json": (columns_json, "application/json"),
            "npz": (columns_npz, "application/octet-stream"),
            "arrow": (columns_arrow, "application/vnd.apache.arrow.stream"),
        }[format]
        with refusals():
            path = catalog.get(episode_id).path
            return Response(reader.read(read, path, tuple(group), every), media_type=media)

    @router.get("/episodes/{episode_id}/recording")
    def read_recording(episode_id: str) -> Response:
        """The take itself: an MCAP file, which Foxglove and Rerun open."""
        with refusals():
            path = catalog.get(episode_id).path
        return FileResponse(path, media_type="application/octet-stream", filename=path.name)

    @router.get("/episodes/{episode_id}/images", response_model=dict[str, list[float]])
    def list_images(episode_id: str) -> Response:
        """The time of every image of each camera, in seconds since the scene was reset."""
        with refusals(), studio.open(episode_id) as episode:
            return as_json({name: episode.image_times(name).tolist() for name in episode.cameras})

    @router.get("/episodes/{episode_id}/images/{camera}/{number}")
    def read_image(episode_id: str, camera: str, number: Number) -> Response:
        """One image by its number, a JPEG."""
        with refusals():
            image = reader.read(jpeg, catalog.get(episode_id).path, camera, number)
        return Response(image, media_type="image/jpeg", headers=UNCHANGING)

    @router.get("/episodes/{episode_id}/images/{camera}/at/{at}")
    def read_image_at(episode_id: str, camera: str, at: Time) -> Response:
        """The newest image at or before a time, else the first."""
        with refusals():
            image = reader.read(jpeg_at, catalog.get(episode_id).path, camera, at)
        return Response(image, media_type="image/jpeg", headers=UNCHANGING)

    return router


def _details(row: EpisodeRow, said: edits.Edits, episode: Episode) -> Details:
    header = {f.name: getattr(episode.header, f.name) for f in dataclasses.fields(episode.header)}
    return Details(
        row=row,
        header=header,
        reason=episode.outcome.reason,
        events=episode.events(),
        ticks_with_limits=len(episode.limits()),
        images={camera: len(episode.image_times(camera)) for camera in episode.cameras},
        segments=said.segments,
        history=said.history,
    )


def _collections_router(studio: Studio) -> APIRouter:
    router = APIRouter()

    @router.get("/collections", response_model=list[Collection])
    def list_collections() -> Response:
        """The newest first."""
        return as_json(studio.collections())

    @router.post("/collections", response_model=Collection, status_code=201)
    def make_collection(body: CollectionIn) -> Response:
        """Name some takes, or all that match, as they are annotated now."""
        with refusals():
            filters = body.filters.filters() if body.filters else None
            made = studio.make_collection(
                body.name,
                episode_ids=body.episode_ids,
                filters=filters,
                author=body.author,
                note=body.note,
            )
        return as_json(made, 201)

    @router.get("/collections/{name}", response_model=CollectionDetails)
    def read_collection(name: str) -> Response:
        """A collection, and what became of its takes since."""
        with refusals():
            return as_json(CollectionDetails(studio.collection(name), studio.collection_changes(name)))

    @router.get("/collections/{name}/episodes", response_model=list[EpisodeRow])
    def read_collection_rows(name: str) -> Response:
        """Its takes as they were annotated when it was made."""
        with refusals():
            return as_json(studio.collection_rows(name))

    @router.delete("/collections/{name}", status_code=204)
    def delete_collection(name: str) -> Response:
        """Move it to the trash; its takes stay."""
        with refusals():
            studio.delete_collection(name)
        return Response(status_code=204)

    @router.post("/collections/{name}/restore", response_model=Collection)
    def restore_collection(name: str) -> Response:
        """Bring it back from the trash."""
        with refusals():
            return as_json(studio.restore_collection(name))

    return router
