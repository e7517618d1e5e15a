"""What jobs cost those who work meanwhile, and how soon they get to work."""

from __future__ import annotations

import dataclasses
import os
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager

import httpx
from fastapi import FastAPI

from policy.config import PRESETS
from studio import training
from studio.api import Studio
from studio.benchmarks import live
from studio.benchmarks.episodes import made_up_header, write_take
from studio.http_jobs import jobs_router
from studio.jobs import plans
from studio.jobs.job import Job
from studio.jobs.plans import Where
from studio.server import FrontServer

TASK = "peg-cylinder"  # two arms, three cameras: as the made-up takes
N_TAKES, TAKE_SECONDS = 30, 4.0
N_LISTED = 10
WATCHED = 20.0  # [s] for which a page looks, and a session is driven
PATIENCE = 120.0  # [s] for a first step on a busy machine


def measure() -> dict[str, float]:
    """A training job on all cores from asking to its first step; beside it a page that looks, and a session.

    The takes are in the training cache already. Refreshing is what `GET /api/v1/jobs` and the queue cost the
    process that serves them, its client included, once a second each.
    """
    with tempfile.TemporaryDirectory() as folder, Studio(folder) as studio:
        _record(studio)
        where = Where(author="bench", threads=os.cpu_count() or 1)
        config = dataclasses.replace(PRESETS["small"], steps=1_000_000)
        run = training.prepare(studio.catalog, TASK, config)
        training.dataset_of(studio.catalog, run)
        for _ in range(N_LISTED - 1):
            request = plans.demo(studio.catalog, where, TASK, episodes=1)
            studio.jobs.slots = 0
            studio.jobs.cancel(studio.submit(request).job.job_id)
        studio.jobs.slots = 1
        begun = time.monotonic()
        job = studio.submit(plans.train(studio.catalog, where, TASK, config, name="measured")).job
        with _cancelled_at_end(studio, job):
            metrics = studio.data_dir / "runs" / "measured" / "metrics.jsonl"
            while not (metrics.exists() and metrics.stat().st_size):
                if time.monotonic() - begun > PATIENCE:
                    raise TimeoutError(f"No step after {PATIENCE:.0f} s: {studio.jobs.log(job.job_id)[0]}")
                time.sleep(0.02)
            first = time.monotonic() - begun
            share = _refreshing(studio)
            driven = live.measure(WATCHED)
    return {
        "first_step_s": first,
        "refresh_share_of_core": share,
        "late_share": driven["late_share"],
        "longest_stall_ms": driven["longest_stall_ms"],
        "target_latency_p95_ms": driven["target_latency_p95_ms"],
    }


def _record(studio: Studio) -> None:
    """Demonstrations of noise, all successful."""
    for _ in range(N_TAKES):
        header = dataclasses.replace(made_up_header(), task=TASK)
        write_take(studio.data_dir / "episodes" / TASK / f"{header.episode_id}.mcap", header, TAKE_SECONDS)
    rows = studio.episodes()
    studio.annotate_all([row.episode_id for row in rows], author="bench", outcome="success")


def _refreshing(studio: Studio) -> float:
    app = FastAPI()
    app.include_router(jobs_router(studio), prefix="/api/v1")
    with FrontServer(app, port=0) as front, studio.jobs.kept_going(), httpx.Client() as client:
        address = f"{front.url}/api/v1/jobs"
        assert len(client.get(address).json()) == N_LISTED
        begun, cpu, tag = time.monotonic(), time.process_time(), ""
        while time.monotonic() - begun < WATCHED:
            tag = client.get(address, headers={"If-None-Match": tag}).headers["ETag"]
            time.sleep(1.0)
        return (time.process_time() - cpu) / (time.monotonic() - begun)


@contextmanager
def _cancelled_at_end(studio: Studio, job: Job) -> Iterator[None]:
    try:
        yield
    finally:
        studio.jobs.cancel(job.job_id)
        while not studio.jobs.get(job.job_id).standing.is_over:
            time.sleep(0.1)
