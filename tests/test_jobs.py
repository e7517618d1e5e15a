"""Jobs: what becomes of them when they are cancelled, killed, edited, or nobody watches; real commands."""

from __future__ import annotations

import dataclasses
import os
import shutil
import signal
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest
from test_training import QUICK
from visitor import wait_for

from studio.api import DemoReport, Studio
from studio.jobs import plans
from studio.jobs.plans import Request, Where
from studio.jobs.queue import JobBusyError, JobNow

ANN = Where(author="ann", threads=1)
LONG = 60.0  # [s] for a command to load its libraries on a busy machine


@pytest.fixture
def studio(tmp_path: Path, recorded: tuple[Path, DemoReport]) -> Iterator[Studio]:
    """On a copy of the folder with two takes. Whatever still runs at the end is killed."""
    with Studio(shutil.copytree(recorded[0], tmp_path / "data")) as studio:
        yield studio
        studio.jobs.slots = 0
        for now in studio.jobs.all():
            for pid in (now.standing.pid, now.standing.command_pid):
                if not now.standing.is_over and pid is not None and psutil.pid_exists(pid):
                    os.kill(pid, signal.SIGKILL)


def export(studio: Studio, name: str = "out") -> Request:
    return plans.export(studio.catalog, ANN, name, "act-hdf5", filters={"task": "wiping"})


def demo(studio: Studio, episodes: int = 50) -> Request:
    """Long enough to be caught at work."""
    return plans.demo(studio.catalog, ANN, "wiping", episodes=episodes, cameras=False)


def training(studio: Studio, **changes: object) -> Request:
    config = dataclasses.replace(QUICK, **changes)  # type: ignore[arg-type]
    return plans.train(studio.catalog, ANN, "wiping", config, name="learner")


def over(studio: Studio, job_id: str) -> JobNow:
    return wait_for(lambda: (now := studio.jobs.get(job_id)).standing.is_over and now, LONG)


def at_work(studio: Studio, job_id: str, done: float = 0.0) -> JobNow:
    """As soon as the command tells how far it is."""

    def found() -> JobNow | None:
        now = studio.jobs.get(job_id)
        assert not now.standing.is_over, now
        return now if now.progress is not None and now.progress.done >= done else None

    return wait_for(found, LONG)


def test_jobs_run_one_after_the_other_and_tell_what_came_of_them(studio: Studio) -> None:
    first = studio.submit(export(studio, "first"))
    second = studio.submit(export(studio, "second"))
    assert (first.standing.state, second.standing.state) == ("running", "queued")
    # The one that ends starts the next: nobody else looks after the queue meanwhile.
    ended = [over(studio, now.job.job_id) for now in (first, second)]
    assert [now.standing.state for now in ended] == ["done", "done"]
    assert ended[1].standing.started >= ended[0].standing.ended  # type: ignore[operator]
    result = ended[0].progress.result  # type: ignore[union-attr]
    assert result is not None
    assert Path(result["folder"]) == studio.data_dir / "exports" / "first"
    assert (studio.data_dir / "exports" / "first" / "takes.json").exists()
    assert "2 takes" in studio.jobs.log(first.job.job_id)[0]


def test_a_cancelled_export_leaves_nothing_behind(studio: Studio) -> None:
    now = studio.submit(demo(studio))
    waiting = studio.submit(export(studio))
    assert studio.jobs.cancel(waiting.job.job_id).standing.state == "cancelled"
    at_work(studio, now.job.job_id)
    studio.jobs.cancel(now.job.job_id)
    ended = over(studio, now.job.job_id)
    assert ended.standing.state == "cancelled"
    assert not psutil.pid_exists(ended.standing.command_pid or 0)
    assert not (studio.data_dir / "exports").exists()
    with pytest.raises(JobBusyError, match="cancelled already"):
        studio.jobs.cancel(now.job.job_id)
