"""The runs of a data folder: what each learned from, how far it is, its curves; whatever has become of it.

DATA/runs/<name>/        see `studio.training`
DATA/trash/runs/<name>/  deleted
"""

from __future__ import annotations

import json
import shutil
import threading
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from controller.types import Array
from policy import checkpoint
from policy.checkpoint import CHECKPOINTS, CONFIG
from studio.training import LOCK, ORIGIN, TAKES, is_held

METRICS = "metrics.jsonl"
POINTS = 400  # of a curve, for a page
MOST_POINTS = 5_000


@dataclass(frozen=True, slots=True)
class RunInfo:
    """A run as it lies there; parts that somebody removed or damaged are empty, and `problem` says so."""

    name: str
    task: str
    steps: int  # that it shall do
    step: int  # of its last checkpoint
    checkpoints: tuple[str, ...]  # last, best, and their folders
    is_learning: bool  # in a process that lives
    changed: float  # [s] unix time
    best: float | None = None  # least loss on the takes kept aside
    config: dict[str, Any] = field(default_factory=dict)
    takes: tuple[dict[str, Any], ...] = ()  # episode_id, edit_version, trim
    origin: dict[str, Any] = field(default_factory=dict)  # see `studio.training.lay_out`
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Curve:
    """One metric over the steps; where there were more than asked for, each point is the mean of some."""

    step: list[float]
    value: list[float]


@dataclass(frozen=True, slots=True)
class Metrics:
    """What a run told while it learned."""

    curves: dict[str, Curve]
    last: dict[str, float]  # the newest of each
    step: int
    damaged: int  # lines that could not be read


def folder_of(data_dir: Path, name: str) -> Path:
    """Of a run by its name. Raises KeyError, also for what would lead elsewhere."""
    folder = data_dir / "runs" / name
    if not name or name.startswith(".") or folder.parent != data_dir / "runs" or not folder.is_dir():
        raise KeyError(f"No run {name!r}; there are {', '.join(names(data_dir)) or 'none'}.")
    return folder


def names(data_dir: Path) -> list[str]:
    """The newest first."""
    folders = sorted((data_dir / "runs").glob("[!.]*/"), key=_changed, reverse=True)
    return [folder.name for folder in folders]


def load(data_dir: Path, name: str) -> RunInfo:
    """Raises KeyError for an unknown one."""
    folder = folder_of(data_dir, name)
    problems: list[str] = []
    told = _json(folder / CONFIG, dict, problems)
    takes = _json(folder / TAKES, list, problems)
    origin = _json(folder / ORIGIN, dict, [])  # older runs have none
    config = told.get("config") or {}
    step, best = 0, None
    with suppress(FileNotFoundError):
        try:
            last = checkpoint.read(checkpoint.find(folder))
            step, best = last.spec.step, last.best
        except ValueError as error:
            problems.append(str(error))
    return RunInfo(
        name=name,
        task=str(told.get("task", "")),
        steps=int(config.get("steps") or 0),
        step=step,
        checkpoints=tuple(sorted(path.name for path in (folder / CHECKPOINTS).glob("[!.]*"))),
        is_learning=is_held(folder / LOCK),
        changed=_changed(folder),
        best=best,
        config=config,
        takes=tuple(take for take in takes if isinstance(take, dict)),
        origin=origin,
        problem=" ".join(problems),
    )


def delete(data_dir: Path, name: str) -> None:
    """Move a run to the trash. Raises ValueError while it learns."""
    folder, target = folder_of(data_dir, name), data_dir / "trash" / "runs" / name
    if is_held(folder / LOCK):
        raise ValueError(f"The run {name} is learning; stop it first.")
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.rmtree(target, ignore_errors=True)  # of an earlier one of that name
    folder.rename(target)


def restore(data_dir: Path, name: str) -> None:
    """Bring it back. Raises KeyError where it is not there, FileExistsError where its name is taken."""
    trash = data_dir / "trash" / "runs"
    source, target = trash / name, data_dir / "runs" / name
    if not name or source.parent != trash or not source.is_dir():
        raise KeyError(f"No run {name!r} in the trash.")
    if target.exists():
        raise FileExistsError(f"There is a run {name} by now; delete that first.")
    source.rename(target)


class MetricsReader:
    """Reads what runs tell as they learn; what it has read before it keeps. Any thread may ask."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._known: dict[Path, _Told] = {}

    def read(self, folder: Path, points: int = POINTS, since: int = 0) -> Metrics:
        """Curves of the steps after `since`, at most `points` each."""
        path = folder / METRICS
        with self._lock:
            told = self._known.setdefault(path, _Told())
            if not told.follow(path):
                self._known[path] = told = _Told()
                told.follow(path)
            if not path.exists():
                del self._known[path]
            curves = {name: _thinned(*told.after(name, since), points) for name in told.values}
            last = {name: values[-1] for name, values in told.values.items()}
            return Metrics(curves, last, int(told.step), told.damaged)


class _Told:
    """The lines of one file so far."""

    def __init__(self) -> None:
        self.steps: dict[str, list[float]] = {}
        self.values: dict[str, list[float]] = {}
        self.step, self.damaged, self._offset = 0.0, 0, 0

    def follow(self, path: Path) -> bool:
        """Read what was added; False where the file is another one by now, as of a resumed run."""
        try:
            with path.open("rb") as file:
                if file.seek(0, 2) < self._offset:
                    return False
                file.seek(self._offset)
                content = file.read()
        except FileNotFoundError:
            return self._offset == 0
        whole = content[: content.rfind(b"\n") + 1]
        self._offset += len(whole)
        return all(self._add(line) for line in whole.splitlines())

    def after(self, name: str, since: int) -> tuple[Array, Array]:
        steps = np.asarray(self.steps[name])
        first = int(np.searchsorted(steps, since, "right"))
        return steps[first:], np.asarray(self.values[name])[first:]

    def _add(self, line: bytes) -> bool:
        try:
            told = msgspec.json.decode(line)
            step = float(told["step"])
        except (msgspec.DecodeError, KeyError, TypeError, ValueError):
            self.damaged += 1
            return True
        if step <= self.step:
            return False
        self.step = step
        for name, value in told.items():
            if name != "step" and isinstance(value, int | float):
                self.steps.setdefault(name, []).append(step)
                self.values.setdefault(name, []).append(float(value))
        return True


def _thinned(steps: Array, values: Array, points: int) -> Curve:
    """Means over equally many neighbours."""
    if len(steps) > points:
        bounds = np.linspace(0, len(steps), points + 1).astype(int)
        counts = np.diff(bounds)
        steps = np.add.reduceat(steps, bounds[:-1]) / counts
        values = np.add.reduceat(values, bounds[:-1]) / counts
    return Curve(np.round(steps, 1).tolist(), [float(f"{value:.6g}") for value in values])


def settings_that_differ(runs: Sequence[RunInfo]) -> dict[str, list[Any]]:
    """Name and value of each setting in which runs differ, in their order."""
    fields = dict.fromkeys(name for run in runs for name in run.config)
    found: Mapping[str, list[Any]] = {name: [run.config.get(name) for run in runs] for name in fields}
    return {name: values for name, values in found.items() if any(value != values[0] for value in values)}


def _json(path: Path, kind: type[Any], problems: list[str]) -> Any:
    try:
        found = json.loads(path.read_text())
        if isinstance(found, kind):
            return found
        problems.append(f"{path.name} is damaged.")
    except FileNotFoundError:
        problems.append(f"{path.name} is missing.")
    except (OSError, ValueError):
        problems.append(f"{path.name} is damaged.")
    return kind()


def _changed(folder: Path) -> float:
    """[s] when it learned last."""
    for path in (folder / METRICS, folder / CONFIG, folder):
        with suppress(OSError):
            return path.stat().st_mtime
    return 0.0
