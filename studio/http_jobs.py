"""The part of the HTTP API that is about jobs: train, evaluate, export, record in the background."""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from hashlib import sha256
from typing import Annotated, Any, Literal

import msgspec
from fastapi import APIRouter, Header, HTTPException, Query
from fastapi import Path as InPath
from pydantic import Field
from starlette.responses import Response

from policy.config import PRESETS, TrainConfig
from studio.api import Studio
from studio.export import Format, Options
from studio.http_wire import Body, FiltersIn, Name, Problem, as_json, refusals
from studio.jobs import plans
from studio.jobs.job import LOCAL, Job
from studio.jobs.plans import Request, Where
from studio.jobs.queue import JobNow, Jobs

REFUSED: dict[int | str, dict[str, Any]] = {
    404: {"model": Problem, "description": "There is no such job, run, take or collection"},
    409: {"model": Problem, "description": "Not now: it runs, or it is over, or the name is taken"},
}
JobId = Annotated[str, InPath(max_length=200)]
Seed = Annotated[int, Field(ge=0, le=2**31)]
Count = Annotated[int, Field(ge=1, le=100_000)]
Workers = Annotated[int, Field(ge=1, le=64)]


class Asked(Body):
    """What every job is asked for with."""

    author: Name = "program"
    processes: Annotated[int, Field(ge=1, le=64)] = 1
    """That learn together, through torchrun."""
    threads: Annotated[int, Field(ge=0, le=256)] = 0
    """Of the CPU, for each process; 0 leaves one core to others."""
    runner: Name = LOCAL
    """This machine, or a Ray cluster that sees the data folder, by its address: http://head:8265. There a job
    whose device is cuda has a GPU for each process, any other none."""

    def where(self) -> Where:
        return Where(**self.model_dump(include=set(Asked.model_fields)))


class TrainIn(Asked):
    """A run: of successful demonstrations of a task, or of those that match, or of a collection."""

    kind: Literal["train"]
    task: Name
    preset: Literal["small", "paper"] = "small"
    config: dict[str, Any] = Field(default_factory=dict)
    """Settings that differ from the preset, see /api/v1/train-settings."""
    name: Name | None = None
    episodes: Count | None = None
    """The first so many that match."""
    filters: FiltersIn | None = None
    collection: Name | None = None

    def request(self, studio: Studio, where: Where) -> Request:
        return plans.train(
            studio.catalog,
            where,
            self.task,
            config_of(self.preset, self.config),
            name=self.name,
            episodes=self.episodes,
            filters=self.filters.filters() if self.filters else None,
            collection=self.collection,
        )


class EvaluateIn(Asked):
    """Rollouts of a run's checkpoint, or of a reference, over seeds."""

    kind: Literal["evaluate"]
    agent: Name
    """Of a run, or a reference such as `demonstrator`."""
    which: Name = "last"
    """Of the run's checkpoints: last, best, or a folder such as 000500."""
    task: Name | None = None
    seed: Seed = 1000
    episodes: Annotated[int, Field(ge=1, le=1000)] = 20
    workers: Workers = 1
    hide: list[Literal["images", "objects", "wrench"]] = Field(default_factory=list)
    execution: Literal["replan", "ensemble"] = "replan"
    replan_every: Annotated[int, Field(ge=1, le=1000)] | None = None
    latency: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 0.02
    device: Literal["cpu", "cuda"] = "cpu"
    spread: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 1.0
    cameras: bool = False

    def request(self, studio: Studio, where: Where) -> Request:
        return plans.evaluate(
            studio.catalog,
            where,
            plans.known_agent(studio.data_dir, self.agent),
            task=self.task,
            which=self.which,
            seed=self.seed,
            episodes=self.episodes,
            workers=self.workers,
            hide=tuple(self.hide),
            execution=self.execution,
            replan_every=self.replan_every,
            latency=self.latency,
            device=self.device,
            spread=self.spread,
            cameras=self.cameras,
        )


class ExportIn(Asked):
    """Takes for other programs, to DATA/exports/<name>: by ids, of a collection, or all that match."""

    kind: Literal["export"]
    name: Name
    format: Format = "lerobot"
    episode_ids: Annotated[list[Name], Field(min_length=1, max_length=100_000)] | None = None
    collection: Name | None = None
    filters: FiltersIn | None = None
    rate: Annotated[float, Field(ge=1, le=100, allow_inf_nan=False)] = 20.0
    actions: Literal["cartesian", "joints"] = "cartesian"
    cameras: list[Name] | None = None
    """Only these; an empty list leaves out all images."""
    pad: bool = True

    def request(self, studio: Studio, where: Where) -> Request:
        cameras = None if self.cameras is None else tuple(self.cameras)
        return plans.export(
            studio.catalog,
            where,
            self.name,
            self.format,
            Options(self.rate, self.actions, cameras, self.pad),
            episode_ids=self.episode_ids,
            collection=self.collection,
            filters=self.filters.filters() if self.filters else None,
        )


class DemoIn(Asked):
    """Scripted demonstrations."""

    kind: Literal["demo"]
    task: Name
    episodes: Annotated[int, Field(ge=1, le=1000)] = 1
    seed: Seed = 0
    workers: Workers = 1
    cameras: bool = True
    spread: Annotated[float, Field(ge=0, le=10, allow_inf_nan=False)] = 1.0

    def request(self, studio: Studio, where: Where) -> Request:
        return plans.demo(
            studio.catalog,
            where,
            self.task,
            episodes=self.episodes,
            seed=self.seed,
            workers=self.workers,
            cameras=self.cameras,
            spread=self.spread,
        )


class SweepIn(Body):
    """A job for each combination of the values of some fields: settings of training, or fields of the job."""

    job: TrainIn | EvaluateIn = Field(discriminator="kind")
    fields: dict[Name, Annotated[list[Any], Field(min_length=1, max_length=64)]]
    name: Name = ""

    def requests(self, studio: Studio) -> list[Request]:
        def make(swept: Mapping[str, Any], where: Where) -> Request:
            told = self.job.model_dump()
            known = {name: value for name, value in swept.items() if name in type(self.job).model_fields}
            others = {name: value for name, value in swept.items() if name not in known}
            if isinstance(self.job, TrainIn):
                count = next(numbers)
                name = f"{self.job.name or where.sweep}-{count}"
                body = TrainIn.model_validate(
                    {**told, "name": name, **known, "config": {**self.job.config, **others}}
                )
                return body.request(studio, where)
            if others:
                raise ValueError(f"An evaluation has no {', '.join(others)}.")
            return EvaluateIn.model_validate({**told, **known}).request(studio, where)

        numbers = itertools.count(1)
        where = dataclasses.replace(self.job.where(), sweep=self.name)
        return plans.sweep(make, where, self.fields)


JobIn = Annotated[TrainIn | EvaluateIn | ExportIn | DemoIn, Field(discriminator="kind")]


@dataclass(frozen=True, slots=True)
class LogPart:
    """Some of what a job said."""

    text: str
    next: int  # byte to go on from


def config_of(preset: Literal["small", "paper"], changes: dict[str, Any]) -> TrainConfig:
    """A preset with changes, checked for types and values."""
    fields = {name: getattr(PRESETS[preset], name) for name in TrainConfig.__dataclass_fields__}
    if unknown := sorted(changes.keys() - fields.keys()):
        raise ValueError(f"There is no setting {', '.join(unknown)}; there are {', '.join(fields)}.")
    return msgspec.convert({**fields, **changes, "preset": preset}, TrainConfig)


@contextmanager
def written() -> Iterator[None]:
    """As `refusals`, around what writes: a disk that is full is told, too."""
    with refusals():
        try:
            yield
        except (FileExistsError, FileNotFoundError):
            raise
        except OSError as error:
            raise HTTPException(507, f"It cannot be written: {error.strerror}.") from error


def jobs_router(studio: Studio) -> APIRouter:
    router = APIRouter(responses=REFUSED, tags=["jobs"])
    router.include_router(_queue_router(studio))
    router.include_router(_job_router(studio.jobs))
    return router


def _queue_router(studio: Studio) -> APIRouter:
    router, jobs = APIRouter(), studio.jobs

    @router.get("/jobs", response_model=list[JobNow])
    def list_jobs(
        kind: Literal["train", "evaluate", "export", "demo"] | None = None,
        sweep: Annotated[str, Query(max_length=200)] = "",
        if_none_match: Annotated[str, Header(max_length=200)] = "",
    ) -> Response:
        """The newest first, with how far they are; 304 where nothing changed since the ETag that is given."""
        found = [now for now in jobs.all() if kind in (None, now.job.kind) and sweep in ("", now.job.sweep)]
        answer = as_json(found)
        answer.headers["ETag"] = tag = f'"{sha256(answer.body).hexdigest()[:24]}"'
        answer.headers["Cache-Control"] = "no-cache"  # ask each time, with the tag
        return Response(status_code=304, headers={"ETag": tag}) if if_none_match == tag else answer

    @router.post("/jobs", response_model=JobNow, status_code=201)
    def submit(body: JobIn) -> Response:
        """Put a job at the end of the queue; it may start at once. What cannot work is refused here."""
        with written():
            return as_json(studio.submit(body.request(studio, body.where())), 201)

    @router.post("/sweeps", response_model=list[JobNow], status_code=201)
    def submit_sweep(body: SweepIn) -> Response:
        """A job for each combination of some values; all of them are checked before the first is queued."""
        with written():
            return as_json([studio.submit(request) for request in body.requests(studio)], 201)

    @router.get("/jobs-trash", response_model=list[Job])
    def list_trash() -> Response:
        """The deleted jobs, the newest first."""
        return as_json(jobs.trash())

    return router


def _job_router(jobs: Jobs) -> APIRouter:
    router = APIRouter()

    @router.get("/jobs/{job_id}", response_model=JobNow)
    def read_job(job_id: JobId) -> Response:
        """Where it stands, and how far it is."""
        with refusals():
            return as_json(jobs.get(job_id))

    @router.get("/jobs/{job_id}/log", response_model=LogPart)
    def read_log(job_id: JobId, start: Annotated[int, Query(ge=-1, le=2**40)] = -1) -> Response:
        """What it said from byte `start` on, at most 64 KiB; from -1 the end of it."""
        with refusals():
            return as_json(LogPart(*jobs.log(job_id, start=start)))

    @router.post("/jobs/{job_id}/cancel", response_model=JobNow)
    def cancel(job_id: JobId) -> Response:
        """Take it out of the queue; or ask it to end, which may take it some seconds, and then kill it."""
        with refusals():
            return as_json(jobs.cancel(job_id))

    @router.post("/jobs/{job_id}/resume", response_model=JobNow)
    def resume(job_id: JobId) -> Response:
        """Queue one again that did not finish: training goes on where it was, all else begins anew."""
        with refusals():
            return as_json(jobs.resume(job_id))

    @router.delete("/jobs/{job_id}", response_model=Job)
    def delete(job_id: JobId) -> Response:
        """Move it to the trash, with the run that it learned; exports and evaluations stay."""
        with refusals():
            return as_json(jobs.delete(job_id))

    @router.post("/jobs/{job_id}/restore", response_model=JobNow)
    def restore(job_id: JobId) -> Response:
        """Bring it back from the trash."""
        with refusals():
            return as_json(jobs.restore(job_id))

    return router
