"""All jobs of a data folder, and who runs next.

There is no process that owns the queue: whoever submits a job, whoever ends one, and every server calls
`Jobs.advance`, one at a time under a lock. So a queue goes on without a server, and after a crash of all of
them the next one who opens the data folder carries it on.

DATA/jobs/<id>/       a job, see `studio.jobs.job`
DATA/jobs/slots       how many may run at a time on this machine; 1 where the file is missing
DATA/jobs/.lock       held while the queue changes
"""

from __future__ import annotations

import dataclasses
import fcntl
import logging
import os
import secrets
import shutil
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from studio.jobs.cluster import RayRunner
from studio.jobs.job import (
    CANCEL,
    JOB,
    LOCAL,
    LOG,
    RUN,
    STATE,
    TAIL,
    Job,
    Progress,
    Standing,
    State,
    last_lines,
    read_job,
    read_progress,
    read_standing,
    write_json,
)
from studio.jobs.local import LocalRunner
from studio.jobs.runner import Found, JobRunner

PERIOD = 1.0  # [s] between two looks at the queue

log = logging.getLogger(__name__)


class JobBusyError(ValueError):
    """A job is not where it would have to be for this: it runs, or it has ended."""


@dataclass(frozen=True, slots=True)
class JobNow:
    """A job as it stands."""

    job: Job
    standing: Standing
    progress: Progress | None = None
    seconds_left: float | None = None
    last_lines: tuple[str, ...] = ()  # of the log, where it did not end well


class Jobs:
    """Threads and processes may share a data folder; each change is seen by all of them."""

    def __init__(self, data_dir: Path) -> None:
        self.data_dir = data_dir.absolute()
        self._folder = self.data_dir / "jobs"
        self._over: dict[str, tuple[int, JobNow]] = {}  # those that change no more, by when their state did

    # What there is

    def all(self) -> list[JobNow]:
        """The newest first. Folders that hold no job, or not any more, are left out."""
        found = [self._read(path.parent) for path in self._folder.glob(f"[!.]*/{JOB}")]
        return sorted(filter(None, found), key=lambda now: (now.job.created, now.job.job_id), reverse=True)

    def get(self, job_id: str) -> JobNow:
        """Raises KeyError for an unknown one."""
        now = self._read(self.folder(job_id))
        if now is None:
            raise self._unknown(job_id)
        return now

    def folder(self, job_id: str) -> Path:
        """Of a job. Raises KeyError where there is none."""
        folder = self._folder / job_id
        if not job_id or folder.parent != self._folder or not (folder / JOB).is_file():
            raise self._unknown(job_id)
        return folder

    def log(self, job_id: str, *, start: int = 0, limit: int = TAIL) -> tuple[str, int]:
        """What it said from byte `start` on, or, from -1, at its end; and where to go on."""
        folder = self.folder(job_id)
        if not (folder / LOG).exists():
            now = self.get(job_id)
            text = runner_of(now.job.runner).log(now.job, folder, now.standing).encode()
            return text[max(0, start) :][:limit].decode(errors="replace"), len(text)
        with (folder / LOG).open("rb") as file:
            size = file.seek(0, os.SEEK_END)
            begin = file.seek(max(0, size - limit) if start < 0 else min(start, size))
            content = file.read(limit)
        return content.decode(errors="replace"), begin + len(content)

    def trash(self) -> list[Job]:
        """The deleted ones, the newest first."""
        found = [read_job(path.parent) for path in self._trash.glob(f"*/{JOB}")]
        return sorted(filter(None, found), key=lambda job: job.created, reverse=True)

    @property
    def slots(self) -> int:
        """How many run at a time on this machine."""
        try:
            return max(0, int((self._folder / "slots").read_text()))
        except (OSError, ValueError):
            return 1

    @slots.setter
    def slots(self, n: int) -> None:
        if n < 0:
            raise ValueError(f"There can be no {n} jobs at a time.")
        self._folder.mkdir(parents=True, exist_ok=True)
        (self._folder / "slots").write_text(f"{n}\n")

    # Changes

    def submit(self, job: Job, files: Mapping[str, bytes] | None = None) -> JobNow:
        """Put a job at the end of the queue, with the files it needs in its folder; it may start at once.

        Raises `JobBusyError` where another that is not over learns the same run, or writes the same folder.
        """
        self._folder.mkdir(parents=True, exist_ok=True)
        with self._locked():
            if (other := self._active_on(job)) is not None:
                raise JobBusyError(
                    f"{other.job.title} is {other.standing.state} already ({other.job.job_id})."
                )
            part = self._folder / f".{job.job_id}.part"
            part.mkdir()
            try:
                for name, content in (files or {}).items():
                    (part / name).write_bytes(content)
                write_json(part / STATE, Standing("queued", queued=time.time()))
                write_json(part / JOB, job)
                part.rename(self._folder / job.job_id)
            except OSError:
                shutil.rmtree(part, ignore_errors=True)
                raise
        self._go_on()
        return self.get(job.job_id)

    def cancel(self, job_id: str) -> JobNow:
        """Take it out of the queue, or have it end, which takes a while; `JobBusyError` where it is over."""
        with self._locked():
            now, folder = self.get(job_id), self.folder(job_id)
            if now.standing.is_over:
                raise JobBusyError(f"{now.job.title} is {now.standing.state} already.")
            if now.standing.state != "queued" or now.standing.handle:
                runner_of(now.job.runner).cancel(now.job, folder, now.standing)
            if now.standing.state == "queued":
                self._write(folder, now.standing, state="cancelled", why="Cancelled before it began.")
        return self.get(job_id)

    def resume(self, job_id: str) -> JobNow:
        """Put one that did not finish at the end of the queue again.

        Training goes on where it was; all else begins anew. Raises `JobBusyError` where it is not over yet,
        or done.
        """
        with self._locked():
            now, folder = self.get(job_id), self.folder(job_id)
            if not now.standing.is_over or now.standing.state == "done":
                raise JobBusyError(f"{now.job.title} is {now.standing.state}; there is nothing to resume.")
            if (other := self._active_on(now.job)) is not None:
                raise JobBusyError(f"{other.job.title} is {other.standing.state} already.")
            (folder / CANCEL).unlink(missing_ok=True)
            write_json(folder / STATE, Standing("queued", queued=time.time()))
        self._go_on()
        return self.get(job_id)

    def delete(self, job_id: str) -> Job:
        """Move a job to the trash, with its run; what it exported or evaluated stays."""
        with self._locked():
            now = self.get(job_id)
            if not now.standing.is_over and (now.standing.state != "queued" or now.standing.handle):
                raise JobBusyError(f"{now.job.title} is {now.standing.state}; cancel it first.")
            if now.job.kind == "train" and (users := self._who_evaluate(now.job.subject)):
                raise JobBusyError(f"{users[0].job.title} is {users[0].standing.state}; cancel that first.")
            for source, target in self._places(now.job):
                if source.exists():
                    target.parent.mkdir(parents=True, exist_ok=True)
                    source.rename(target)
        return now.job

    def restore(self, job_id: str) -> JobNow:
        """Bring it back from the trash. Raises KeyError or ValueError where it is not there, or back."""
        job = next((job for job in self.trash() if job.job_id == job_id), None)
        if job is None:
            raise KeyError(f"No job {job_id!r} in the trash.")
        with self._locked():
            places = self._places(job)
            if taken := [source.name for source, target in places if target.exists() and source.exists()]:
                raise ValueError(f"There is a {taken[0]} by now; delete that first.")
            for source, target in reversed(places):
                if target.exists():
                    source.parent.mkdir(parents=True, exist_ok=True)
                    target.rename(source)
        self._go_on()
        return self.get(job_id)

    def advance(self) -> None:
        """Note which jobs are gone, and start those whose turn it is."""
        if not self._folder.is_dir():
            return
        told = self._ask_clusters()
        with self._locked():
            for now in self.all():
                if now.standing.state == "running" or now.standing.handle:
                    self._settle(now, told)
            waiting = [now for now in self.all() if now.standing.state == "queued"]
            for now in sorted(waiting, key=lambda now: (now.standing.queued, now.job.job_id)):
                if now.standing.handle:
                    continue  # the cluster has it
                if now.job.runner != LOCAL or self._n_running() < self.slots:
                    self._start(now)

    @contextmanager
    def kept_going(self) -> Iterator[None]:
        """In it the queue goes on also where a keeper was killed, or a cluster takes its time."""
        ended = threading.Event()

        def look() -> None:
            while not ended.wait(PERIOD):
                self._go_on()

        thread = threading.Thread(target=look, name="jobs", daemon=True)
        thread.start()
        try:
            yield
        finally:
            ended.set()
            thread.join()

    def _go_on(self) -> None:
        """Advance, unless e.g. the disk is full: the next time, perhaps."""
        try:
            self.advance()
        except OSError as error:
            log.warning("The queue of jobs waits: %s", error)

    def _start(self, now: JobNow) -> None:
        job, standing, folder = now.job, now.standing, self._folder / now.job.job_id
        if job.runner != LOCAL:  # noted first, so that it can be found whatever happens next
            standing = dataclasses.replace(standing, handle=f"{job.job_id}-{secrets.token_hex(2)}")
            self._write(folder, standing)
        try:
            runner_of(job.runner).submit(job, folder, standing)
        except (OSError, RuntimeError) as error:
            self._write(folder, standing, state="failed", why=str(error), ended=time.time())

    def _ask_clusters(self) -> dict[str, Found]:
        """What became of each handle. Asked without the lock, as one that is silent takes seconds."""
        told: dict[str, Found] = {}
        silent: set[str] = set()
        for now in self.all():
            job, standing = now.job, now.standing
            if job.runner == LOCAL or standing.is_over or not standing.handle:
                continue
            found: Found = "lost"
            if job.runner not in silent:
                found = runner_of(job.runner).status(job, self._folder / job.job_id, standing)
            if found == "lost":
                silent.add(job.runner)
            told[standing.handle] = found
        return told

    def _settle(self, now: JobNow, told: Mapping[str, Found]) -> None:
        """Write down what became of one whose processes are gone; of a cluster, whether it answers."""
        job, folder = now.job, self._folder / now.job.job_id
        found: Found | None = told.get(now.standing.handle)
        if job.runner == LOCAL:
            found = LocalRunner().status(job, folder, now.standing)
        standing = read_standing(folder) or now.standing  # what a keeper wrote before it went
        if standing.is_over or found is None:
            return
        if found == "ended":
            state: State = "cancelled" if (folder / CANCEL).exists() else "interrupted"
            self._write(folder, standing, state=state, why=_why_gone(now, folder), ended=time.time())
        elif found == "dropped":
            self._write(folder, standing, state="queued", why="", handle="")
        elif found == "lost" and _was_given_up(folder, job):
            why = f"Cancelled while {job.runner} did not answer; it may go on there."
            self._write(folder, standing, state="cancelled", why=why, ended=time.time())
        elif found == "lost" and standing.state != "lost":
            self._write(folder, standing, state="lost", why=f"{job.runner} does not answer.")
        elif found in ("running", "waiting") and standing.state == "lost":
            state = "running" if standing.started else "queued"
            self._write(folder, standing, state=state, why="")

    # Reading

    def _read(self, folder: Path) -> JobNow | None:
        try:
            changed = (folder / STATE).stat().st_mtime_ns
        except OSError:
            changed = 0
        known = self._over.get(folder.name)
        if known and known[0] == changed:
            return known[1]
        job = read_job(folder)
        if job is None or job.job_id != folder.name:
            return None
        standing = read_standing(folder) or self._without_standing(job, folder)
        progress = None if standing.state == "queued" else read_progress(folder)
        lines = last_lines(folder) if standing.state in ("failed", "interrupted", "lost") else []
        left = progress.seconds_left if progress and standing.state == "running" else None
        now = JobNow(job, standing, progress, left, tuple(lines))
        if standing.is_over and changed:
            self._over[folder.name] = changed, now
        return now

    def _without_standing(self, job: Job, folder: Path) -> Standing:
        """Where somebody has edited or removed the file."""
        unknown = Standing("interrupted", job.created, why=f"{folder / STATE} is missing or damaged.")
        found = runner_of(job.runner).status(job, folder, unknown)
        return dataclasses.replace(unknown, state="running") if found == "running" else unknown

    def _active_on(self, job: Job) -> JobNow | None:
        """Another job that is not over and writes to the same place."""
        if job.kind not in ("train", "export"):
            return None
        same = (now for now in self.all() if (now.job.kind, now.job.subject) == (job.kind, job.subject))
        return next((n for n in same if not n.standing.is_over and n.job.job_id != job.job_id), None)

    def _who_evaluate(self, run: str) -> list[JobNow]:
        """Jobs that are not over and need the run."""
        asked = (now for now in self.all() if (now.job.kind, now.job.subject) == ("evaluate", run))
        return [now for now in asked if not now.standing.is_over]

    def _n_running(self) -> int:
        return sum(now.job.runner == LOCAL and now.standing.state == "running" for now in self.all())

    def _places(self, job: Job) -> list[tuple[Path, Path]]:
        """Where it lies, and where in the trash: its run in its folder, as another may get its name."""
        deleted = self._trash / job.job_id
        places = [(self._folder / job.job_id, deleted)]
        if job.kind == "train":
            places.append((self.data_dir / "runs" / job.subject, deleted / RUN))
        return places

    @property
    def _trash(self) -> Path:
        return self.data_dir / "trash" / "jobs"

    def _write(self, folder: Path, standing: Standing, **changes: Any) -> None:
        with suppress(FileNotFoundError):  # somebody removed the folder meanwhile
            write_json(folder / STATE, dataclasses.replace(standing, **changes))

    def _unknown(self, job_id: str) -> KeyError:
        return KeyError(f"No job {job_id!r}; `studio jobs list` tells which there are.")

    @contextmanager
    def _locked(self) -> Iterator[None]:
        """Be the only one who changes the queue."""
        self._folder.mkdir(parents=True, exist_ok=True)
        with (self._folder / ".lock").open("a") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield


def _was_given_up(folder: Path, job: Job) -> bool:
    """Whether somebody cancelled it so long ago that a keeper that lives would have said something."""
    with suppress(FileNotFoundError):
        return time.time() - (folder / CANCEL).stat().st_mtime > 2 * job.grace
    return False


def _why_gone(now: JobNow, folder: Path) -> str:
    """What is known of one that ended without a word from its keeper."""
    if now.job.runner != LOCAL and now.standing.started is None:
        said = runner_of(now.job.runner).log(now.job, folder, now.standing).strip().splitlines()
        return f"{now.job.runner} could not start it{f': {said[-1][:300]}' if said else '.'}"
    return "It is gone, without having said why: perhaps the machine was switched off."


def check_runner(runner: str) -> None:
    """Raises ValueError where no job can be sent there now."""
    if runner != LOCAL:
        try:
            RayRunner(runner).check()
        except RuntimeError as error:
            raise ValueError(str(error)) from error


def runner_of(runner: str) -> JobRunner:
    """The place of that name, which a `Job` has checked."""
    return LocalRunner() if runner == LOCAL else RayRunner(runner)
