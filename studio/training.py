"""From recorded takes to a trained policy: which takes, read once into a cache, and where the run lies.

    DATA/cache/<key>/    pictures and tracks of the takes, see `policy.dataset`; may be deleted
    DATA/runs/<name>/    takes.json: what the run learns from
                         origin.json: who asked for it, how the takes were chosen, with which code, where
                         config.json: its settings; metrics.jsonl: one line a step; checkpoints/

A run keeps learning from the takes as they were when it began, whatever is edited meanwhile.
"""

from __future__ import annotations

import dataclasses
import fcntl
import hashlib
import json
import os
import platform
import re
import subprocess
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict, Unpack

from controller.stiffness import StiffnessTable
from controller.types import Array
from policy.cache import Size, build
from policy.checkpoint import CONFIG, read_spec
from policy.config import TrainConfig
from policy.dataset import FORMAT, Dataset
from policy.recording import ArmTrack, Recording
from studio import collections
from studio.catalog import Catalog
from studio.episode import Episode, open_episode
from studio.index import EpisodeRow, Filters
from studio.recorder import versions
from studio.references import REFERENCES

if TYPE_CHECKING:
    from policy.train import TrainResult

EVALUATION = "evaluation"  # operator of rollouts, which are not demonstrations
CACHE_TIMEOUT = 3600.0  # [s] that a process of a run waits for the one that reads the takes
TAKES, ORIGIN, LOCK = "takes.json", "origin.json", ".lock"  # in the folder of a run
DEMONSTRATORS = ("operator", "scripted", "nobody")  # agents that are no policy

_NAME = re.compile(r"[A-Za-z0-9][\w.-]*", re.ASCII)


@dataclass(frozen=True, slots=True)
class Chosen:
    """One take to learn from, as it was when the run began."""

    episode_id: str
    trim: tuple[float, float] | None = None  # [s] since the take's start
    edit_version: int | None = None  # see `studio.edits.read`; None in runs that did not note it

    @staticmethod
    def from_json(fields: Mapping[str, Any]) -> Chosen:
        trim = fields["trim"]
        version = fields.get("edit_version")
        return Chosen(fields["episode_id"], None if trim is None else (trim[0], trim[1]), version)


class Choice(TypedDict, total=False):
    """Which of a task's takes to learn from, see `prepare`."""

    episodes: int | None
    filters: Filters | None
    collection: str | None


@dataclass(frozen=True, slots=True)
class Run:
    """Where a run lies and what it learns from; `prepare` makes one, `train` lets it learn."""

    folder: Path
    task: str
    config: TrainConfig
    takes: tuple[Chosen, ...]
    done: int = 0  # steps
    rollouts: tuple[str, ...] = ()  # takes of a new run that are no demonstrations, but were asked for

    @property
    def is_begun(self) -> bool:
        return self.done > 0


def prepare(
    catalog: Catalog,
    task: str,
    config: TrainConfig,
    *,
    name: str | None = None,
    **choice: Unpack[Choice],
) -> Run:
    """A new run of successful demonstrations of a task, or of those that `filters` ask for.

    What a policy drove, all of it or a part, counts only where `filters` ask for that agent, or for
    evaluations. `episodes` takes the first so many recorded. A `collection` tells the takes instead: all of
    them, as they were annotated when it was made. Raises ValueError where none matches, or one is of another
    task.
    """
    name = name or f"{task}-{config.policy}-{time.strftime('%Y%m%d-%H%M%S')}"
    if not _NAME.fullmatch(name):
        raise ValueError(f"{name!r} cannot name a run; use letters, digits, - _ .")
    if name in REFERENCES or name in DEMONSTRATORS:
        raise ValueError(f"{name!r} cannot name a run: takes and evaluations know another agent by it.")
    folder = catalog.data_dir / "runs" / name
    if folder.exists() and leads():
        raise ValueError(f"There is a run {name} already; resume it, or give another name.")
    rows = choose(catalog, task, **choice)
    takes = tuple(Chosen(row.episode_id, row.trim, row.edit_version) for row in rows)
    rollouts = tuple(row.episode_id for row in rows if not is_demonstration(row))
    return Run(folder, task, config, takes, rollouts=rollouts)


def choose(
    catalog: Catalog,
    task: str,
    *,
    episodes: int | None = None,
    filters: Filters | None = None,
    collection: str | None = None,
) -> list[EpisodeRow]:
    """What a run would learn from, see `prepare`."""
    catalog.refresh()
    rows = (
        _named(catalog, task, collection, filters)
        if collection is not None
        else _asked(catalog, task, {"outcome": "success", **(filters or {})})
    )
    if episodes is not None and not 1 <= episodes <= len(rows):
        raise ValueError(f"{len(rows)} takes match, so that many or fewer can be asked for, not {episodes}.")
    return rows[:episodes]


def reopen(catalog: Catalog, name: str) -> Run:
    """A run that was stopped, by its name or folder."""
    runs = catalog.data_dir / "runs"
    folder = next((path for path in (runs / name, Path(name)) if (path / CONFIG).exists()), None)
    if folder is None:
        raise KeyError(
            f"No run {name!r}; there are {sorted(p.parent.name for p in runs.glob(f'*/{CONFIG}'))}."
        )
    told = json.loads((folder / CONFIG).read_text())
    takes = chosen_in(folder / TAKES)
    try:
        done = read_spec(folder).step
    except FileNotFoundError:
        done = 0  # stopped before its first checkpoint
    return Run(folder, told["task"], TrainConfig.from_json(told["config"]), takes, done)


def chosen_in(path: Path) -> tuple[Chosen, ...]:
    """Which takes a file names that `lay_out` wrote. Raises ValueError where it cannot be read."""
    try:
        return tuple(map(Chosen.from_json, json.loads(path.read_text())))
    except (json.JSONDecodeError, KeyError, TypeError) as error:
        raise ValueError(f"{path} names no takes: {error!r}.") from error


def lay_out(run: Run, asked: Mapping[str, Any]) -> None:
    """Write down what a new run is, so that `reopen` finds it; `asked` tells how its takes were chosen."""
    run.folder.mkdir(parents=True, exist_ok=True)
    takes = [dataclasses.asdict(take) for take in run.takes]
    (run.folder / TAKES).write_text(json.dumps(takes, indent=1))
    origin = {"created": time.time(), **asked, "versions": {**versions(), **_commit()}, "machine": _machine()}
    (run.folder / ORIGIN).write_text(json.dumps(origin, indent=1, default=str))
    names = [take.episode_id for take in run.takes]
    told = {"task": run.task, "takes": names, "config": dataclasses.asdict(run.config)}
    (run.folder / CONFIG).write_text(json.dumps(told, indent=1))


def check_device(run: Run) -> None:
    """Raise RuntimeError where a run asks for a GPU and there is none, before it begins. Loads torch."""
    from policy.machine import device_of

    device_of(run.config.device)


def dataset_of(catalog: Catalog, run: Run, on_take: Callable[[str], None] = lambda name: None) -> Dataset:
    """The cache of a run's takes, read once; `on_take` hears of each take as it is read.

    One process on each machine reads, the others wait. Raises ValueError, naming the take, where takes are
    not alike, KeyError where one is gone.
    """
    size = (run.config.max_height, run.config.max_width) if run.config.images else None
    folder = catalog.data_dir / "cache" / _key(run.takes, size)
    if (folder / "index.json").exists():
        return Dataset(folder)
    if int(os.environ.get("LOCAL_RANK", 0)) == 0:
        paths = [(catalog.get(take.episode_id).path, take.trim) for take in run.takes]
        recordings = [lambda p=path, t=trim: recording_of(p, t) for path, trim in paths]
        build(folder, recordings, max_size=size, on_take=on_take)
    deadline = time.monotonic() + CACHE_TIMEOUT
    while not (folder / "index.json").exists():
        if time.monotonic() > deadline:
            raise TimeoutError(f"The process that reads the takes has not finished {folder}.")
        time.sleep(0.2)
    return Dataset(folder)


def train(
    run: Run,
    dataset: Dataset,
    *,
    on_step: Callable[[Mapping[str, float]], None] = lambda metrics: None,
) -> TrainResult:
    """Let a run learn, or go on, until it is finished or SIGTERM comes. Loads torch.

    `on_step` hears the metrics of each step. Under `torchrun` each process calls this. Raises RuntimeError
    where another process lets the run learn.
    """
    from policy.train import train as learn

    if not leads():
        return learn(run.config, dataset, run.folder, resume=run.is_begun, tell=on_step)
    if not (run.folder / TAKES).exists():
        lay_out(run, {})
    with _alone(run.folder):
        return learn(run.config, dataset, run.folder, resume=run.is_begun, tell=on_step)


def is_held(lock: Path) -> bool:
    """Whether a process that lives holds a lock file."""
    try:
        with lock.open("r") as file:
            fcntl.flock(file, fcntl.LOCK_SH | fcntl.LOCK_NB)
    except FileNotFoundError:
        return False
    except BlockingIOError:
        return True
    return False


@contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Be the only one that lets a run learn; the lock dies with its process."""
    with (folder / LOCK).open("a") as lock:
        for _ in range(20):  # who looks whether it is held (`is_held`) holds it for a moment
            with suppress(BlockingIOError):
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            time.sleep(0.05)
        else:
            raise RuntimeError(f"Another process lets {folder.name} learn already.")
        yield


def _commit() -> dict[str, str]:
    """Which code, where this is a checkout, which is only looked at: `git describe` would lock its index."""

    def ask(*words: str) -> str:
        command = ["git", "--no-optional-locks", "-C", str(Path(__file__).parent), *words]
        return subprocess.run(command, capture_output=True, text=True, timeout=5.0, check=True).stdout.strip()

    with suppress(OSError, subprocess.SubprocessError):
        if Path(ask("rev-parse", "--show-toplevel")) != Path(__file__).parent.parent.resolve():
            return {}  # somebody else's, in which we are installed
        changed = ask("status", "--porcelain", "--untracked-files=no")
        return {"commit": ask("rev-parse", "--short=12", "HEAD") + ("-dirty" if changed else "")}
    return {}


def _machine() -> dict[str, Any]:
    return {"name": platform.node(), "system": platform.platform(), "cores": os.cpu_count()}


def leads() -> bool:
    """Whether this process is the only one of a run, or the one that tells and saves."""
    return int(os.environ.get("RANK", 0)) == 0


@contextmanager
def recording_of(path: Path, trim: tuple[float, float] | None) -> Iterator[Recording]:
    """A take as training reads it."""
    with open_episode(path) as episode:
        yield _TakeRecording(episode, trim)


class _TakeRecording:
    """Implements `policy.recording.Recording`."""

    def __init__(self, episode: Episode, trim: tuple[float, float] | None) -> None:
        header = episode.header
        self.name = header.episode_id
        self.task = header.task
        self.arms = header.arms
        self.stiffness_table: StiffnessTable = header.control.get("servo", {}).get("stiffness_table", "tuned")
        self.cameras: Mapping[str, Size] = {
            name: (height, width) for name, (width, height) in header.cameras.items()
        }
        self._episode = episode
        start = float(episode.columns(f"{self.arms[0]}/state")[f"{self.arms[0]}/state/time"][0])
        self.span = (start, float("inf")) if trim is None else (start + trim[0], start + trim[1])

    def track(self, arm: str) -> ArmTrack:
        columns = self._episode.columns(f"{arm}/state", f"{arm}/applied")
        state = {name: columns[f"{arm}/state/{name}"] for name in _STATE}
        return ArmTrack(
            state_time=columns[f"{arm}/state/time"],
            action_time=columns[f"{arm}/applied/time"],
            base_from_target=columns[f"{arm}/applied/base_from_target"],
            stiffness=columns[f"{arm}/applied/stiffness"],
            gripper_command=columns[f"{arm}/applied/gripper"],
            **state,
        )

    def image_times(self, camera: str) -> Array:
        return self._episode.image_times(camera)

    def image(self, camera: str, index: int) -> Array:
        return self._episode.image(camera, index)


_STATE = ("base_from_tcp", "q", "q_command", "wrench", "gripper")


def _asked(catalog: Catalog, task: str, asked: Filters) -> list[EpisodeRow]:
    rows = _select(catalog, {**asked, "task": task})
    if not rows:
        raise ValueError(_why_none(catalog, task, asked))
    return rows


def _named(catalog: Catalog, task: str, name: str, filters: Filters | None) -> list[EpisodeRow]:
    if any((filters or {}).values()):
        raise ValueError(f"The collection {name!r} tells which takes; leave out all filters.")
    rows = collections.rows_of(catalog, collections.load(catalog.data_dir, name))
    others = sorted({row.task for row in rows} - {task})
    if others:
        raise ValueError(
            f"The collection {name!r} has takes of {', '.join(others)}, too, not only of {task}."
        )
    return rows


def _select(catalog: Catalog, filters: Filters) -> list[EpisodeRow]:
    """Those that match, as they were recorded; other than demonstrations only where they are asked for."""
    rows = catalog.episodes(sort="started", descending=False, limit=None, **filters)
    agent = filters.get("agent")
    if filters.get("operator") == EVALUATION or (agent is not None and agent not in DEMONSTRATORS):
        return rows
    return [row for row in rows if is_demonstration(row)]


def is_demonstration(row: EpisodeRow) -> bool:
    """Whether a take is no rollout, and no policy drove any part of it."""
    return row.operator != EVALUATION and not _has_policy(row.path)


@lru_cache(maxsize=100_000)
def _has_policy(path: Path) -> bool:
    """Whether a policy began the recording or was handed over to; recordings never change."""
    with open_episode(path) as episode:
        handed = (event.text for event in episode.events() if event.kind == "driver")
        return "run" in episode.header.provenance or any(text.startswith("policy ") for text in handed)


def _why_none(catalog: Catalog, task: str, filters: Filters) -> str:
    rows = _select(catalog, {"task": task})
    asked = ", ".join(f"{name} {value}" for name, value in filters.items() if value)
    if not rows:
        known = ", ".join(catalog.facets()["task"]) or "none at all"
        return (
            f"No demonstration of {task!r} in {catalog.data_dir}; there are takes of {known}. "
            f"Record some: studio demo {task} --episodes 30"
        )
    outcomes = ", ".join(
        f"{sum(row.outcome == outcome for row in rows)} {outcome}"
        for outcome in ("success", "failure", "unmarked")
    )
    return f"Of the {len(rows)} demonstrations of {task!r} ({outcomes}) none has {asked}."


def _key(takes: Sequence[Chosen], size: Size | None) -> str:
    """Names a cache by all that decides what is in it; recordings never change."""
    told = [FORMAT, size, [(take.episode_id, take.trim) for take in takes]]
    return hashlib.sha256(json.dumps(told).encode()).hexdigest()[:16]
