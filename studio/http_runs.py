"""The part of the HTTP API that is about what came of jobs: runs with their curves, evaluations, figures."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, Literal

from fastapi import APIRouter, Query
from fastapi import Path as InPath
from pydantic import Field
from starlette.responses import Response

from policy.config import TrainConfig
from studio import evaluation, report, runs, tasks, training
from studio.api import Studio
from studio.benchmarks.policy import step_seconds
from studio.evaluation import Comparison, Evaluation, compare
from studio.http_jobs import config_of
from studio.http_wire import Body, FiltersIn, Name, Problem, as_json, refusals
from studio.index import EpisodeRow
from studio.jobs.form import train_form
from studio.jobs.plans import default_threads
from studio.reading import Reader
from studio.references import REFERENCES
from studio.runs import MOST_POINTS, POINTS, Metrics, MetricsReader, RunInfo

REFUSED: dict[int | str, dict[str, Any]] = {
    404: {"model": Problem, "description": "There is no such run or evaluation"},
    409: {"model": Problem, "description": "Not now: it learns, or the name is taken"},
}
RunName = Annotated[str, InPath(max_length=200)]
EvaluationId = Annotated[str, InPath(max_length=200)]
FOREVER = {"Cache-Control": "private, max-age=31536000, immutable"}  # an evaluation never changes


@dataclass(frozen=True, slots=True)
class EvaluationDetails:
    """An evaluation whole, and its numbers."""

    summary: dict[str, Any]
    evaluation: Evaluation


@dataclass(frozen=True, slots=True)
class Paired:
    """Two evaluations on the same scenes."""

    comparison: Comparison
    text: str
    scenes: list[dict[str, Any]]  # of each seed: what came of it in one and in the other


class TakesIn(Body):
    """Takes that somebody thinks of learning from, as for a job of training."""

    task: Name
    episodes: Annotated[int, Field(ge=1, le=100_000)] | None = None
    filters: FiltersIn | None = None
    collection: Name | None = None


class EstimateIn(Body):
    """A run that somebody thinks of."""

    task: Name
    preset: Literal["small", "paper"] = "small"
    config: dict[str, Any] = Field(default_factory=dict)
    processes: Annotated[int, Field(ge=1, le=64)] = 1
    threads: Annotated[int, Field(ge=0, le=256)] = 0


@dataclass(frozen=True, slots=True)
class Estimate:
    """How long a run would take on this machine as it is now."""

    step_seconds: float
    seconds: float  # of all steps; reading the takes, validation and saving come on top
    threads: int


def runs_router(studio: Studio, reader: Reader) -> APIRouter:
    router = APIRouter(responses=REFUSED)
    router.include_router(_runs_router(studio.data_dir), tags=["runs"])
    router.include_router(_asking_router(studio), tags=["runs"])
    router.include_router(_evaluations_router(studio, reader), tags=["evaluations"])
    return router


def _runs_router(data_dir: Path) -> APIRouter:
    router, reader = APIRouter(), MetricsReader()

    @router.get("/runs", response_model=list[RunInfo])
    def list_runs(task: Annotated[str, Query(max_length=200)] = "") -> Response:
        """All runs, or those that learn a task; the one that learned last comes first."""
        found = [runs.load(data_dir, name) for name in runs.names(data_dir)]
        return as_json([run for run in found if task in ("", run.task)])

    @router.get("/runs/{name}", response_model=RunInfo)
    def read_run(name: RunName) -> Response:
        """What it learns from, with which settings, from whom, and how far it is."""
        with refusals():
            return as_json(runs.load(data_dir, name))

    @router.get("/runs/{name}/metrics", response_model=Metrics)
    def read_metrics(
        name: RunName,
        points: Annotated[int, Query(ge=2, le=MOST_POINTS)] = POINTS,
        since: Annotated[int, Query(ge=0, le=2**40)] = 0,
    ) -> Response:
        """Its curves after the step `since`, thinned to so many points each by means over neighbours."""
        with refusals():
            return as_json(reader.read(runs.folder_of(data_dir, name), points, since))

    @router.delete("/runs/{name}", status_code=204)
    def delete_run(name: RunName) -> Response:
        """Move it to the trash; what it learned from, and its evaluations, stay."""
        with refusals():
            runs.delete(data_dir, name)
        return Response(status_code=204)

    @router.post("/runs/{name}/restore", response_model=RunInfo)
    def restore_run(name: RunName) -> Response:
        """Bring it back from the trash."""
        with refusals():
            runs.restore(data_dir, name)
            return as_json(runs.load(data_dir, name))

    return router


def _asking_router(studio: Studio) -> APIRouter:
    """What somebody wants to know who thinks of a run."""
    router = APIRouter()

    @router.get("/train-settings")
    def read_settings() -> Response:
        """All settings of training as JSON schema, with the help of the command line, and the presets."""
        return as_json(train_form())

    @router.post("/train-takes", response_model=list[EpisodeRow])
    def list_takes(body: TakesIn) -> Response:
        """What a run would learn from: without rollouts, and what else a policy drove. 422 says why none."""
        with refusals():
            found = training.choose(
                studio.catalog,
                body.task,
                episodes=body.episodes,
                filters=body.filters.filters() if body.filters else None,
                collection=body.collection,
            )
            return as_json(found)

    @router.post("/train-estimate", response_model=Estimate)
    def estimate(body: EstimateIn) -> Response:
        """How long a run would take: some steps are made on made-up takes, which itself takes seconds."""
        with refusals():
            task = tasks.load(body.task)
            config = config_of(body.preset, body.config)
            threads = body.threads or default_threads(body.processes)
            cameras = tuple(view.name for view in task.cameras)
            one = _measured(config, tuple(arm.name for arm in task.arms), cameras, threads)
            return as_json(Estimate(one, one * config.steps, threads))

    return router


@lru_cache(maxsize=64)
def _measured(config: TrainConfig, arms: tuple[str, ...], cameras: tuple[str, ...], threads: int) -> float:
    return step_seconds(config, arms, cameras, threads)


def _evaluations_router(studio: Studio, reader: Reader) -> APIRouter:
    router, data_dir = APIRouter(), studio.data_dir

    @router.get("/evaluations", response_model=list[dict[str, Any]])
    def list_evaluations() -> Response:
        """What came of each, the newest first."""
        found = studio.evaluations()
        return as_json([{**one.summary(), "label": one.label, "started": one.started} for one in found])

    @router.get("/references", response_model=list[str])
    def list_references() -> Response:
        """Agents that can be evaluated besides runs: what a policy has to be measured against."""
        return as_json(list(REFERENCES))

    @router.get("/evaluations/{evaluation_id}", response_model=EvaluationDetails)
    def read_evaluation(evaluation_id: EvaluationId) -> Response:
        """Every rollout, the curves of force and stiffness, and what it all comes to."""
        with refusals():
            found = evaluation.named(data_dir, evaluation_id)
            return as_json(EvaluationDetails(found.summary(), found))

    @router.get("/evaluations/{evaluation_id}/against/{other_id}", response_model=Paired)
    def compare_evaluations(evaluation_id: EvaluationId, other_id: EvaluationId) -> Response:
        """The difference on the seeds that both met, with its interval, and what came of each seed."""
        with refusals():
            one, other = (evaluation.named(data_dir, name) for name in (evaluation_id, other_id))
            comparison = compare(one, other)
            others = {rollout.seed: rollout for rollout in other.judged}
            scenes = [
                {"seed": r.seed, "one": r, "other": others[r.seed]} for r in one.judged if r.seed in others
            ]
            return as_json(Paired(comparison, str(comparison), scenes))

    @router.get("/evaluations/{evaluation_id}/figures/{figure}", response_class=PngResponse)
    def draw(
        evaluation_id: EvaluationId,
        figure: Literal["force", "stiffness"],
        against: Annotated[list[Name] | None, Query(max_length=7)] = None,
    ) -> Response:
        """A figure of the report as PNG: of this evaluation, or against others of its task."""
        with refusals():
            image = reader.read(report.picture, data_dir, (evaluation_id, *(against or ())), figure)
        return PngResponse(image, headers=FOREVER)

    return router


class PngResponse(Response):
    """A figure."""

    media_type = "image/png"
