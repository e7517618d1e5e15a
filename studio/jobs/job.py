"""What a job is, and how it lies on the disk. All that is known of one is in its folder.

DATA/jobs/<id>/job.json        what was asked; written once
               takes.json      the takes of an export, as they were when it was asked for
               state.json      where it stands, see `Standing`; replaced whole
               progress.json   how far it has come, see `studio.jobs.progress`
               log.txt         what the command said
               cancel          somebody asked to stop it
               lock            held as long as its keeper or its command lives
DATA/trash/jobs/<id>/          deleted; `restore` brings it back
               run/            that it learned
"""

from __future__ import annotations

import os
import secrets
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeVar, get_args
from urllib.parse import urlsplit

import msgspec

T = TypeVar("T")
Kind = Literal["train", "evaluate", "export", "demo"]
State = Literal["queued", "running", "done", "failed", "cancelled", "interrupted", "lost"]
KINDS: tuple[Kind, ...] = get_args(Kind)
# interrupted: its processes are gone without having said how it ended. lost: its cluster does not answer.
ENDED: tuple[State, ...] = ("done", "failed", "cancelled", "interrupted")

JOB, STATE, PROGRESS, LOG, CANCEL, LOCK, RUN = (
    *("job.json", "state.json", "progress.json", "log.txt", "cancel", "lock", "run"),
)
LOCAL = "local"  # the runner on this machine
GRACE = 20.0  # [s] that a command has to end by itself, e.g. to save a checkpoint
NICE = 10  # behind the live session and the page
LAST_LINES = 12  # of the log, told of a job that failed
TAIL = 64 * 1024  # [bytes] of a log that are looked at for its last lines


@dataclass(frozen=True, slots=True, kw_only=True)
class Job:
    """A command line of `studio`, and what it is about."""

    job_id: str
    kind: Kind
    title: str  # for people
    command: tuple[str, ...]  # after `studio`, without --data and --progress-file
    subject: str  # the run that learns, the agent that is evaluated, the folder of an export, the task shown
    author: str
    created: float  # [s] unix time
    settings: dict[str, Any] = field(default_factory=dict)  # as they were asked for
    runner: str = LOCAL  # or the address of a Ray cluster, e.g. http://head:8265
    processes: int = 1  # that learn together, through torchrun
    threads: int = 1  # of the CPU, for each process
    gpus: int = 0  # that a cluster shall keep free for it; on this machine nobody counts them
    sweep: str = ""  # names the jobs that were asked for together
    swept: dict[str, Any] = field(default_factory=dict)  # what tells this one from the others
    grace: float = GRACE

    def __post_init__(self) -> None:
        told = urlsplit(self.runner)
        is_address = told.scheme in ("http", "https") and told.hostname and not told.path.strip("/")
        if self.runner != LOCAL and not is_address:
            raise ValueError(
                f"Jobs run on {LOCAL!r}, or on a Ray cluster told like http://head:8265, not {self.runner!r}."
            )


@dataclass(frozen=True, slots=True)
class Standing:
    """Where a job stands."""

    state: State
    queued: float  # [s] unix time at which it was (last) put into the queue
    started: float | None = None
    ended: float | None = None
    why: str = ""  # a sentence, where it did not end well
    exit_code: int | None = None
    pid: int | None = None  # of the keeper
    command_pid: int | None = None  # leads a process group of its own
    handle: str = ""  # under which the cluster knows it, as soon as it is asked

    @property
    def is_over(self) -> bool:
        return self.state in ENDED


@dataclass(frozen=True, slots=True)
class Progress:
    """How far a command has come; in steps, rollouts, or percent."""

    done: float
    total: float
    what: str = ""  # is being done
    first: float = 0.0  # what was done already when it began
    began: float = 0.0  # [s] unix time
    updated: float = 0.0
    rollouts: tuple[dict[str, Any], ...] = ()  # of an evaluation, in the order in which they ended
    result: dict[str, Any] | None = None  # what the command prints with --json

    @property
    def seconds_left(self) -> float | None:
        """At the pace so far; None before there is one."""
        if self.done <= self.first or self.done >= self.total:
            return None
        return (self.updated - self.began) / (self.done - self.first) * (self.total - self.done)


def new_job_id(kind: Kind) -> str:
    """Sorts by time (UTC), and is unique across processes."""
    return f"{datetime.now(UTC):%Y%m%d-%H%M%S}-{kind}-{secrets.token_hex(3)}"


def read_job(folder: Path) -> Job | None:
    """None where the folder holds none that this version reads, e.g. since somebody edited it."""
    return _read(folder / JOB, Job)


def read_standing(folder: Path) -> Standing | None:
    """None where it cannot be read."""
    return _read(folder / STATE, Standing)


def read_progress(folder: Path) -> Progress | None:
    return _read(folder / PROGRESS, Progress)


def write_json(path: Path, value: Any) -> None:
    """Whole or not at all."""
    part = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        with part.open("wb") as file:
            file.write(msgspec.json.format(msgspec.json.encode(value, enc_hook=str), indent=1))
            file.flush()
            os.fsync(file.fileno())
        part.replace(path)
    except OSError:
        part.unlink(missing_ok=True)
        raise


def last_lines(folder: Path, n: int = LAST_LINES) -> list[str]:
    """Of what the command said; empty ones are left out."""
    try:
        with (folder / LOG).open("rb") as file:
            file.seek(max(0, file.seek(0, os.SEEK_END) - TAIL))
            lines = file.read().decode(errors="replace").splitlines()
    except OSError:
        return []
    return [line for line in lines if line.strip()][-n:]


def _read(path: Path, kind: type[T]) -> T | None:
    try:
        return msgspec.json.decode(path.read_bytes(), type=kind)
    except (OSError, msgspec.DecodeError):
        return None
