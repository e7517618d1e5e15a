"""Jobs of several processes, and on a Ray cluster: a head with two CPUs, which the test starts and ends."""

from __future__ import annotations

import dataclasses
import importlib.util
import os
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import httpx
import psutil
import pytest
from test_training import QUICK
from visitor import wait_for

from studio import runs
from studio.api import DemoReport, Studio
from studio.jobs import plans
from studio.jobs.plans import Where
from studio.jobs.queue import JobNow

pytestmark = pytest.mark.verify
LONG = 180.0  # [s] for a cluster on a busy machine
needs_ray = pytest.mark.skipif(
    importlib.util.find_spec("ray") is None, reason="needs Ray: pip install 'compact-studio[ray]'"
)


@pytest.fixture
def studio(tmp_path: Path, recorded: tuple[Path, DemoReport]) -> Iterator[Studio]:
    with Studio(shutil.copytree(recorded[0], tmp_path / "data")) as studio:
        yield studio


class Head:
    """A Ray cluster of one node."""

    def __init__(self, folder: Path) -> None:
        self._dashboard = free_port()
        command = [str(Path(sys.executable).parent / "ray"), "start", "--head", "--block", "--num-cpus", "2"]
        command += ["--port", str(free_port()), "--dashboard-port", str(self._dashboard)]
        command += ["--include-dashboard", "true", "--temp-dir", str(folder), "--disable-usage-stats"]
        command += ["--object-store-memory", str(100 * 2**20)]
        self._process = subprocess.Popen(
            command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, start_new_session=True
        )
        self.address = f"http://127.0.0.1:{self._dashboard}"
        wait_for(self._answers, LONG)

    def end(self) -> None:
        """All at once, as a machine that is switched off."""
        for process in (
            [*psutil.Process(self._process.pid).children(recursive=True)] if self._is_there() else []
        ):
            if "studio" not in " ".join(process.cmdline()):  # a job's processes go by themselves
                process.kill()
        if self._is_there():
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()

    def _is_there(self) -> bool:
        return self._process.poll() is None

    def _answers(self) -> bool:
        try:
            return httpx.get(f"{self.address}/api/jobs/", timeout=5.0).status_code == 200
        except httpx.HTTPError:
            return False


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])


def over(studio: Studio, job_id: str) -> JobNow:
    def found() -> JobNow | None:
        studio.jobs.advance()
        now = studio.jobs.get(job_id)
        return now if now.standing.is_over else None

    return wait_for(found, LONG)


@needs_ray
def test_jobs_run_on_a_cluster_until_it_is_gone(studio: Studio) -> None:
    folder = Path("/tmp") / f"ray-{os.getpid()}"  # short: sockets lie in it
    head = Head(folder)
    try:
        there = Where(author="ann", threads=1, runner=head.address)
        job = studio.submit(plans.demo(studio.catalog, there, "wiping", episodes=1, cameras=False)).job
        export = plans.export(studio.catalog, there, "out", "act-hdf5", filters={"task": "wiping"})
        second = studio.submit(export).job
        assert (now := over(studio, job.job_id)).standing.state == "done", now
        assert over(studio, second.job_id).standing.state == "done"
        assert (studio.data_dir / "exports" / "out" / "takes.json").exists()
        assert "succeeded" in studio.jobs.log(job.job_id)[0]
        long = plans.demo(studio.catalog, there, "wiping", episodes=500, cameras=False)
        cancelled = studio.submit(long).job.job_id
        wait_for(lambda: studio.jobs.get(cancelled).standing.state == "running", LONG)
        studio.jobs.cancel(cancelled)
        assert over(studio, cancelled).standing.state == "cancelled"
        lost = studio.submit(
            plans.demo(studio.catalog, there, "wiping", episodes=500, cameras=False)
        ).job.job_id
        wait_for(lambda: studio.jobs.get(lost).standing.state == "running", LONG)
    finally:
        head.end()
        shutil.rmtree(folder, ignore_errors=True)
    studio.jobs.advance()
    now = studio.jobs.get(lost)
    assert (now.standing.state, now.standing.why) == ("lost", f"{head.address} does not answer.")
    # The keeper may well live on where it was; it sees in the folder that it shall end, and says that it did.
    studio.jobs.cancel(lost)
    assert over(studio, lost).standing.state == "cancelled"
    here = Where(author="ann", threads=1)  # others go on
    local = studio.submit(plans.demo(studio.catalog, here, "wiping", episodes=1, cameras=False))
    assert over(studio, local.job.job_id).standing.state == "done"
    with pytest.raises(ValueError, match="does not answer"):
        studio.submit(plans.demo(studio.catalog, there, "wiping", episodes=1, cameras=False))


def test_processes_learn_one_run_together(studio: Studio) -> None:
    two = Where(author="ann", threads=1, processes=2)
    config = dataclasses.replace(QUICK, steps=4)
    job = studio.submit(plans.train(studio.catalog, two, "wiping", config, name="learner")).job
    ended = over(studio, job.job_id)
    assert ended.standing.state == "done", studio.jobs.log(job.job_id)
    assert runs.load(studio.data_dir, "learner").step == 4
