"""Jobs, runs and evaluations through the HTTP API: `Client.jobs`.

with Client("http://127.0.0.1:8080") as studio:
    job = studio.jobs.submit(kind="train", task="wiping", preset="small", config={"steps": 500})
    job = studio.jobs.wait(job.job.job_id)
    loss = studio.jobs.metrics(job.job.subject).curves["loss"]
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any
from urllib.parse import quote

from studio.http_jobs import LogPart
from studio.http_runs import Estimate, EvaluationDetails, Paired
from studio.jobs.job import Job
from studio.jobs.queue import JobNow
from studio.runs import POINTS, Metrics, RunInfo

if TYPE_CHECKING:
    from studio.client import Client


class JobsClient:
    """What `studio.client.Client` can do with jobs."""

    def __init__(self, client: Client) -> None:
        self._client = client

    def submit(self, **asked: Any) -> JobNow:
        """`kind` is train, evaluate, export or demo; the rest is what that kind takes."""
        return self._client._post("/jobs", JobNow, {"author": self._client.author, **asked})

    def sweep(self, fields: Mapping[str, Sequence[Any]], name: str = "", **asked: Any) -> list[JobNow]:
        """A job for each combination of the values of `fields`."""
        body = {"job": {"author": self._client.author, **asked}, "fields": fields, "name": name}
        return self._client._post("/sweeps", list[JobNow], body)

    def all(self, kind: str | None = None, sweep: str | None = None) -> list[JobNow]:
        """The newest first."""
        return self._client._get("/jobs", list[JobNow], kind=kind, sweep=sweep)

    def get(self, job_id: str) -> JobNow:
        return self._client._get(_job(job_id), JobNow)

    def log(self, job_id: str, start: int = -1) -> LogPart:
        """From byte `start` on, or, from -1, its end."""
        return self._client._get(f"{_job(job_id)}/log", LogPart, start=start)

    def cancel(self, job_id: str) -> JobNow:
        return self._client._post(f"{_job(job_id)}/cancel", JobNow)

    def resume(self, job_id: str) -> JobNow:
        return self._client._post(f"{_job(job_id)}/resume", JobNow)

    def delete(self, job_id: str) -> None:
        self._client._ask("DELETE", _job(job_id))

    def restore(self, job_id: str) -> JobNow:
        return self._client._post(f"{_job(job_id)}/restore", JobNow)

    def trash(self) -> list[Job]:
        return self._client._get("/jobs-trash", list[Job])

    def wait(self, job_id: str, timeout: float = float("inf"), period: float = 0.5) -> JobNow:
        """Until it is over. Raises TimeoutError after `timeout` [s]."""
        deadline = time.monotonic() + timeout
        while not (now := self.get(job_id)).standing.is_over:
            if time.monotonic() > deadline:
                raise TimeoutError(f"{now.job.title} is {now.standing.state} after {timeout:g} s.")
            time.sleep(period)
        return now

    # Runs, evaluations

    def run(self, name: str) -> RunInfo:
        return self._client._get(f"/runs/{quote(name, safe='')}", RunInfo)

    def metrics(self, name: str, points: int = POINTS, since: int = 0) -> Metrics:
        return self._client._get(f"/runs/{quote(name, safe='')}/metrics", Metrics, points=points, since=since)

    def delete_run(self, name: str) -> None:
        self._client._ask("DELETE", f"/runs/{quote(name, safe='')}")

    def restore_run(self, name: str) -> RunInfo:
        return self._client._post(f"/runs/{quote(name, safe='')}/restore", RunInfo)

    def settings(self) -> dict[str, Any]:
        """Of training, as JSON schema, and the presets."""
        return self._client._get("/train-settings", dict[str, Any])

    def estimate(self, task: str, **asked: Any) -> Estimate:
        """How long a run would take; itself takes seconds."""
        return self._client._post("/train-estimate", Estimate, {"task": task, **asked})

    def references(self) -> list[str]:
        """Agents that can be evaluated besides runs."""
        return self._client._get("/references", list[str])

    def evaluation(self, evaluation_id: str) -> EvaluationDetails:
        return self._client._get(f"/evaluations/{quote(evaluation_id, safe='')}", EvaluationDetails)

    def compare(self, one: str, other: str) -> Paired:
        """Two evaluations by their ids."""
        path = f"/evaluations/{quote(one, safe='')}/against/{quote(other, safe='')}"
        return self._client._get(path, Paired)


def _job(job_id: str) -> str:
    return f"/jobs/{quote(job_id, safe='')}"
