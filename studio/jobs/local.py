"""Runs jobs on this machine: a keeper for each, which outlives whoever starts it."""

from __future__ import annotations

import fcntl
import os
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path

import psutil

from studio.jobs.job import CANCEL, LOCK, LOG, Job, Standing, last_lines
from studio.jobs.runner import Found

YOUNG = 10.0  # [s] between the start of a process and what its keeper noted, on a busy machine


class LocalRunner:
    """Implements `studio.jobs.runner.JobRunner`."""

    def submit(self, job: Job, folder: Path, standing: Standing) -> None:
        """Returns as soon as the command has been started. Raises RuntimeError where it has not."""
        with (folder / LOG).open("ab") as log:
            keeper = subprocess.run(
                [sys.executable, "-m", "studio.jobs.keeper", str(folder)],
                stdin=subprocess.DEVNULL,
                stdout=log,
                stderr=log,
                start_new_session=True,
                check=False,
            )
        if keeper.returncode:
            told = last_lines(folder, 1)
            raise RuntimeError(f"It could not be started: {told[0] if told else 'nobody knows why'}")

    def status(self, job: Job, folder: Path, standing: Standing) -> Found:
        """Its lock tells: whatever kills a process frees it."""
        try:
            descriptor = os.open(folder / LOCK, os.O_RDWR | os.O_CLOEXEC)
        except FileNotFoundError:
            return "ended"
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return "running"
        finally:
            os.close(descriptor)
        return "ended"

    def cancel(self, job: Job, folder: Path, standing: Standing) -> None:
        """The keeper asks the command to end, and kills it after a while; without a keeper it is killed."""
        (folder / CANCEL).touch()
        if not _is_same(standing.pid, standing) and _is_same(standing.command_pid, standing):
            with suppress(ProcessLookupError):
                os.killpg(standing.command_pid or 0, signal.SIGKILL)

    def log(self, job: Job, folder: Path, standing: Standing) -> str:
        return (folder / LOG).read_text(errors="replace") if (folder / LOG).exists() else ""


def _is_same(pid: int | None, standing: Standing) -> bool:
    """Whether a process lives, and began when the job did: numbers are given away again."""
    if pid is None or standing.started is None:
        return False
    with suppress(psutil.Error):
        process = psutil.Process(pid)
        is_dead = process.status() == psutil.STATUS_ZOMBIE
        return not is_dead and abs(process.create_time() - standing.started) < YOUNG
    return False
