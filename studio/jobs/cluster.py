"""Runs jobs on a Ray cluster through its Jobs API: the same keepers, started by Ray.

Every node needs this installation, and the data folder at the same path. Ray waits for free cores by itself.
"""

from __future__ import annotations

import sys
import uuid
from importlib.util import find_spec
from pathlib import Path
from shlex import join
from typing import TYPE_CHECKING

from studio.jobs.job import CANCEL, LOG, Job, Standing
from studio.jobs.runner import Found

if TYPE_CHECKING:
    from ray.job_submission import JobSubmissionClient

PACKAGE = "Jobs on a Ray cluster need the package: pip install 'compact-studio[ray]'"


class RayRunner:
    """Implements `studio.jobs.runner.JobRunner` for the cluster at an address, e.g. http://head:8265."""

    def __init__(self, address: str) -> None:
        self._address = address

    def submit(self, job: Job, folder: Path) -> str:
        """Raises RuntimeError where the cluster does not answer or does not want it."""
        keeper = [sys.executable, "-m", "studio.jobs.keeper", str(folder), "--stay"]
        try:
            return str(
                self._client().submit_job(
                    entrypoint=f"{join(keeper)} >> {join([str(folder / LOG)])} 2>&1",
                    submission_id=f"{job.job_id}-{uuid.uuid4().hex[:4]}",  # a resumed job is another for Ray
                    entrypoint_num_cpus=job.threads * job.processes,
                    metadata={"studio": job.title},
                )
            )
        except _no_answer() as error:
            raise RuntimeError(f"The Ray cluster at {self._address} does not answer.") from error

    def status(self, job: Job, folder: Path, standing: Standing) -> Found:
        """lost: the head does not answer. One that it does not know, since it began anew, is ended."""
        if find_spec("ray") is None:
            return "lost"
        try:
            told = str(self._client().get_job_status(standing.handle).value)
        except _no_answer():
            return "lost"
        except RuntimeError:
            return "ended"
        found: dict[str, Found] = {"PENDING": "waiting", "RUNNING": "running"}
        return found.get(told, "ended")

    def cancel(self, job: Job, folder: Path, standing: Standing) -> None:
        """The keeper sees it; where none has begun, Ray takes the job out of its queue."""
        (folder / CANCEL).touch()
        if standing.started is None:
            try:
                self._client().stop_job(standing.handle)
            except _no_answer() as error:
                raise RuntimeError(f"The Ray cluster at {self._address} does not answer.") from error

    def log(self, job: Job, folder: Path, standing: Standing) -> str:
        """What Ray kept, where the keeper could not write to the folder."""
        try:
            return str(self._client().get_job_logs(standing.handle)) if standing.handle else ""
        except RuntimeError:
            return ""
        except _no_answer():
            return ""

    def _client(self) -> JobSubmissionClient:
        try:
            from ray.job_submission import JobSubmissionClient
        except ModuleNotFoundError as error:
            raise RuntimeError(PACKAGE) from error
        return JobSubmissionClient(self._address)


def _no_answer() -> tuple[type[Exception], ...]:
    """What Ray's client raises where nobody listens."""
    try:
        from requests import ConnectionError as NoConnection
        from requests import Timeout
    except ModuleNotFoundError:  # then there is no Ray either
        return (ConnectionError,)
    return (ConnectionError, NoConnection, Timeout)
