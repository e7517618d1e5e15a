"""Runs jobs on a Ray cluster through its Jobs API, which is HTTP: the same keepers, started by Ray.

Every node needs this installation and the data folder at the same paths as here. Ray waits for free cores and
GPUs by itself. Nothing of Ray is needed on this machine.
https://docs.ray.io/en/latest/cluster/running-applications/job-submission/rest.html
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from http import HTTPStatus
from pathlib import Path
from shlex import join
from typing import Any

import httpx

from studio.jobs.job import CANCEL, LOG, Job, Standing
from studio.jobs.runner import Found

TIMEOUT = 5.0  # [s] for an answer, after which a head counts as gone
PATIENCE = 60.0  # [s] of one that was there a moment ago, and has just begun, to take a job
TOKEN = "RAY_AUTH_TOKEN"  # environment variable of a cluster that wants one, as Ray's own programs read it
FOUND: dict[str, Found] = {"PENDING": "waiting", "RUNNING": "running"}
WAITED_TOO_LONG = "JOB_SUPERVISOR_ACTOR_START_TIMEOUT"  # 15 min, for free cores


class UnknownJobError(RuntimeError):
    """The head has no such job."""


class RayRunner:
    """Implements `studio.jobs.runner.JobRunner` for the cluster at an address, e.g. http://head:8265."""

    def __init__(self, address: str) -> None:
        self._address = address.rstrip("/")

    def check(self) -> None:
        """Raises RuntimeError where no cluster answers."""
        if "ray_version" not in self._ask("GET", "version"):
            raise RuntimeError(f"What answers at {self._address} is no Ray cluster.")

    def submit(self, job: Job, folder: Path, standing: Standing) -> None:
        keeper = [sys.executable, "-m", "studio.jobs.keeper", str(folder), "--stay"]
        asked = {
            "entrypoint": f"{join(keeper)} >> {join([str(folder / LOG)])} 2>&1",
            "submission_id": standing.handle,
            "entrypoint_num_cpus": job.threads * job.processes,
            "entrypoint_num_gpus": job.gpus,  # Ray hides the GPUs that nobody asked for
            "metadata": {"studio": job.title},
        }
        self._ask("POST", "jobs/", json=asked, timeout=PATIENCE)

    def status(self, job: Job, folder: Path, standing: Standing) -> Found:
        """lost: the head does not answer. One that it does not know, since it began anew, is ended."""
        try:
            told = self._ask("GET", f"jobs/{standing.handle}")
        except UnknownJobError:
            return "ended"
        except RuntimeError:
            return "lost"
        if told.get("error_type") == WAITED_TOO_LONG:
            return "dropped"
        return FOUND.get(told.get("status", ""), "ended")

    def cancel(self, job: Job, folder: Path, standing: Standing) -> None:
        """The keeper sees it; where none has begun, Ray takes the job out of its queue, if it hears us."""
        (folder / CANCEL).touch()
        if standing.started is None:
            with suppress(RuntimeError):
                self._ask("POST", f"jobs/{standing.handle}/stop")

    def log(self, job: Job, folder: Path, standing: Standing) -> str:
        """What Ray kept, where the keeper could not write to the folder."""
        try:
            return str(self._ask("GET", f"jobs/{standing.handle}/logs")["logs"]) if standing.handle else ""
        except (RuntimeError, KeyError):
            return ""

    def _ask(self, method: str, path: str, json: Any = None, timeout: float | None = None) -> dict[str, Any]:
        """Raises RuntimeError with what is wrong, UnknownJobError where that is the job."""
        headers = {"Authorization": f"Bearer {token}"} if (token := os.environ.get(TOKEN)) else {}
        try:
            answer = httpx.request(
                method, f"{self._address}/api/{path}", headers=headers, json=json, timeout=timeout or TIMEOUT
            )
        except httpx.TransportError as error:
            raise RuntimeError(f"The Ray cluster at {self._address} does not answer.") from error
        said = next(reversed(answer.text.strip().splitlines()), answer.reason_phrase)[:300]
        if answer.status_code == HTTPStatus.NOT_FOUND:
            raise UnknownJobError(f"What answers at {self._address} knows no {path}.")
        if answer.is_server_error:  # a head that begins, or ends
            raise RuntimeError(f"The Ray cluster at {self._address} is not ready: {said}")
        if not answer.is_success:
            raise RuntimeError(f"The Ray cluster at {self._address} refuses that: {said}")
        try:
            told = answer.json()
        except ValueError:
            told = None
        return told if isinstance(told, dict) else {}
