"""The process that runs one job's command, and writes down how it ended.

`python -m studio.jobs.keeper FOLDER` belongs to nobody: who asked for the job may end meanwhile. As long as
it or its command lives, the job's lock is held. Where it is killed itself, the kernel asks the command to
end, and whoever looks next finds the job interrupted. At its end it starts the next job of the queue.
"""

from __future__ import annotations

import ctypes
import dataclasses
import fcntl
import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from studio.jobs.job import (
    CANCEL,
    LOCK,
    NICE,
    PROGRESS,
    STATE,
    Job,
    Standing,
    last_lines,
    read_job,
    read_progress,
    read_standing,
    write_json,
)

PERIOD = 0.2  # [s] between two looks at the command
PATIENCE = 60.0  # [s] of trying to write down how it ended on a disk that is full
BUSY = 3  # exit status of a keeper whose job has one already
THREADS = ("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMEXPR_NUM_THREADS")
PR_SET_PDEATHSIG = 1


def main(folder: Path, stay: bool) -> int:
    """`stay` keeps the calling process, as a cluster wants it; else it goes on in one that has no parent."""
    folder = folder.absolute()
    job = read_job(folder)
    if job is None:
        raise ValueError(f"{folder} holds no job.")
    lock = os.open(folder / LOCK, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o644)
    if not _lock(lock):
        return BUSY
    if not stay:
        told, tell = os.pipe()
        if os.fork():
            os.close(tell)
            return 0 if os.read(told, 1) else 1
        os.close(told)
    keeper = _Keeper(job, folder, lock)
    keeper.begin()
    if not stay:
        os.write(tell, b".")
        os.close(tell)
    keeper.keep()
    os.close(lock)
    return _carry_on(folder.parent.parent)


class _Keeper:
    def __init__(self, job: Job, folder: Path, lock: int) -> None:
        self._job, self._folder, self._lock = job, folder, lock
        self._stopping = False  # somebody wants the keeper to end
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(number, self._stop)
        before = read_standing(folder)
        self._standing = Standing(
            "running",
            queued=before.queued if before else job.created,
            started=time.time(),
            pid=os.getpid(),
            handle=before.handle if before else "",
        )

    def begin(self) -> None:
        """Start the command, and say so."""
        with suppress(OSError):
            os.nice(max(0, NICE - os.nice(0)))
        (self._folder / PROGRESS).unlink(missing_ok=True)
        self._command = subprocess.Popen(
            command_line(self._job, self._folder),
            cwd=self._folder.parent.parent,
            env=_environment(self._job),
            stdin=subprocess.DEVNULL,
            pass_fds=(self._lock,),
            process_group=0,
            preexec_fn=_end_with_parent,  # safe: this process has one thread
        )
        self._standing = dataclasses.replace(self._standing, command_pid=self._command.pid)
        write_json(self._folder / STATE, self._standing)

    def keep(self) -> None:
        """Until the command has ended, by itself or because somebody wants it to; then write down how."""
        asked: float | None = None  # [s] when it was asked to end
        while (code := self._command.poll()) is None:
            if asked is None and (self._stopping or self._is_cancelled() or not self._folder.exists()):
                asked = time.monotonic()
                self._signal(signal.SIGTERM)
            elif asked is not None and time.monotonic() - asked > self._job.grace:
                self._signal(signal.SIGKILL)
            time.sleep(PERIOD)
        self._signal(signal.SIGKILL)  # what it has left behind
        ended = self._how_it_ended(code)
        deadline = time.monotonic() + PATIENCE
        while self._folder.exists() and time.monotonic() < deadline:
            try:
                write_json(self._folder / STATE, ended)
                return
            except OSError:
                time.sleep(1.0)

    def _how_it_ended(self, code: int) -> Standing:
        progress = read_progress(self._folder)
        result = (progress.result if progress else None) or {}
        end = dataclasses.replace(self._standing, ended=time.time(), exit_code=code)
        if code == 0 and result.get("is_finished", True):
            return dataclasses.replace(end, state="done")
        if self._is_cancelled():
            return dataclasses.replace(end, state="cancelled", why="Somebody cancelled it.")
        if code < 0:
            name = signal.Signals(-code).name
            hint = "; perhaps the memory was not enough" if -code == signal.SIGKILL else ""
            return dataclasses.replace(end, state="interrupted", why=f"{name} ended it{hint}.")
        if code == 0 or self._stopping:
            return dataclasses.replace(end, state="interrupted", why="It was asked to stop.")
        why = next(reversed(last_lines(self._folder, 1)), "It said nothing.")
        return dataclasses.replace(end, state="failed", why=why.removeprefix("studio: "))

    def _is_cancelled(self) -> bool:
        return (self._folder / CANCEL).exists()

    def _signal(self, number: signal.Signals) -> None:
        with suppress(ProcessLookupError, PermissionError):
            os.killpg(self._command.pid, number)

    def _stop(self, *_: object) -> None:
        self._stopping = True


def command_line(job: Job, folder: Path) -> list[str]:
    """What a person would type, with Python's full name."""
    start = [sys.executable, "-m"]
    if job.processes > 1:
        start += ["torch.distributed.run", "--standalone", "--nproc-per-node", str(job.processes), "-m"]
    data = folder.parent.parent
    progress = ["--progress-file", str(folder / PROGRESS)]
    return [*start, "studio", *job.command, "--data", str(data), *progress]


def _environment(job: Job) -> dict[str, str]:
    threads = dict.fromkeys(THREADS, str(job.threads))
    # Nothing is imported from the data folder, in which it runs.
    return {**os.environ, **threads, "PYTHONUNBUFFERED": "1", "PYTHONSAFEPATH": "1"}


def _lock(descriptor: int) -> bool:
    """Also where somebody looks at it just now, which takes microseconds."""
    for _ in range(20):
        with suppress(BlockingIOError):
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
            return True
        time.sleep(0.05)
    return False


def _end_with_parent() -> None:
    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):  # Linux
        libc.prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


def _carry_on(data_dir: Path) -> int:
    from studio.jobs.queue import Jobs

    Jobs(data_dir).advance()
    return 0


if __name__ == "__main__":
    sys.exit(main(Path(sys.argv[1]), stay="--stay" in sys.argv[2:]))
