"""What a page plots of a take: its curves thinned to what a screen can show, and those of several together.

Runs in the process of `studio.reading`, which keeps the takes that it read last: to zoom reads no file.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Literal

import msgspec
import numpy as np

from controller.types import Array
from studio.cursor import CONTACT, ArmTrack, Cursor, Mark, Span
from studio.episode import open_episode

KEPT = 6  # takes; 60 s of two arms are 15 MB
DIGITS = 3  # behind the point, of every unit below: finer than any sensor here
SPREAD_PERIOD = 0.05  # [s] between the points at which takes are averaged

Align = Literal["start", "contact"]

UNITS = {
    "force_x": "N",
    "force_y": "N",
    "force_z": "N",
    "force": "N",
    "torque_x": "N·m",
    "torque_y": "N·m",
    "torque_z": "N·m",
    "torque": "N·m",
    "stiffness": "N/m",
    "gripper": "%",
    "error": "mm",
    "turn": "°",
}
"""Curves of an arm. `force` and `torque` are norms, `stiffness` is the mean translational one, `error` and
`turn` are how far the tool is from its target; under joint control the last three are null."""
AVERAGED = ("force", "torque", "stiffness", "gripper", "error")


@dataclass(frozen=True, slots=True)
class ArmBands:
    """What an arm did, in stretches."""

    name: str
    phases: tuple[Span, ...]  # "free" and "contact" in turn
    modes: tuple[Span, ...]  # names of stiffness modes, or "joint control"


@dataclass(frozen=True, slots=True)
class Timeline:
    """A take in stretches and marks."""

    duration: float  # [s]
    arms: tuple[ArmBands, ...]
    marks: tuple[Mark, ...]  # by start
    first_contact: float | None  # [s] of any arm
    images: dict[str, list[float]]  # [s] when each camera's images were taken


@dataclass(frozen=True, slots=True)
class Curves:
    """Curves over common times."""

    time: list[float]  # [s]
    curves: dict[str, list[float | None]]  # by "arm/name"; null where there is none
    units: dict[str, str]
    is_exact: bool  # every sample; else the least and the greatest of every stretch, in their order


@dataclass(frozen=True, slots=True)
class Spread:
    """Several takes together; times count from what they were aligned at."""

    time: list[float]  # [s]
    mean: dict[str, list[float | None]]  # by "arm/name"
    sd: dict[str, list[float | None]]  # of the takes, not of their mean; 0 where there is one take only
    count: list[int]  # takes that last that long
    left_out: list[str]  # takes that never touch anything, where they are aligned at their first contact


@dataclass(frozen=True, slots=True)
class Resampled:
    """One take for `spread`: (k, n) values every SPREAD_PERIOD, of which number `first` is the first."""

    first: int
    names: tuple[str, ...]
    values: Array


def prepare() -> None:
    """Costs nothing; whoever calls it in another process has this module loaded there."""


def timeline_json(path: Path) -> bytes:
    """A `Timeline`. Raise ValueError where the take holds no states."""
    return msgspec.json.encode(_plot_of(path).timeline)


def curves_json(
    path: Path, names: tuple[str, ...], points: int, start: float | None, end: float | None
) -> bytes:
    """`Curves` between two times, about `points` stretches; no names ask for all."""
    return msgspec.json.encode(curves(path, names, points, start, end))


def curves(
    path: Path,
    names: tuple[str, ...] = (),
    points: int = 1000,
    start: float | None = None,
    end: float | None = None,
) -> Curves:
    """Raise KeyError on unknown names, ValueError on an empty stretch of time."""
    plot = _plot_of(path)
    known = plot.timeline.duration
    start, end = 0.0 if start is None else start, known if end is None else min(end, known)
    if not start < end:
        raise ValueError(f"The take lasts {known:.2f} s; there is nothing from {start:.2f} to {end:.2f} s.")
    if unknown := sorted(set(names) - set(plot.names)):
        raise KeyError(f"No curve {unknown[0]!r}; this take has {', '.join(plot.names)}.")
    chosen = names or plot.names
    rows = plot.values[[plot.names.index(name) for name in chosen]]
    first = max(int(np.searchsorted(plot.time, start, side="right")) - 1, 0)
    last = min(int(np.searchsorted(plot.time, end)) + 1, len(plot.time))
    time, values = thinned(plot.time[first:last], rows[:, first:last], points)
    return Curves(
        time=np.round(time, 4).tolist(),
        curves=dict(zip(chosen, np.round(values, DIGITS).tolist(), strict=True)),
        units={name: UNITS[name.partition("/")[2]] for name in chosen},
        is_exact=len(time) == last - first,
    )


def thinned(time: Array, values: Array, points: int) -> tuple[Array, Array]:
    """(n,) and (k, n) as at most about twice `points` samples: of every stretch the least and the greatest.

    Both stand in the order in which they came, at the start and in the middle of their stretch.
    """
    n = len(time)
    size = -(-n // points)  # samples in a stretch
    if size <= 2:
        return time, values
    padded = np.pad(values, ((0, 0), (0, -n % size)), mode="edge").reshape(len(values), -1, size)
    low = np.where(np.isnan(padded), np.inf, padded).argmin(axis=2)
    high = np.where(np.isnan(padded), -np.inf, padded).argmax(axis=2)
    picked = np.stack((np.minimum(low, high), np.maximum(low, high)), axis=2)
    starts = np.arange(0, n, size)
    times = np.stack((time[starts], time[np.minimum(starts + size // 2, n - 1)]), axis=1)
    return times.ravel(), np.take_along_axis(padded, picked, axis=2).reshape(len(values), -1)


def resample(path: Path, align: Align) -> Resampled | None:
    """Those of AVERAGED on the common grid, for `spread`; None where there is nothing to align at."""
    plot = _plot_of(path)
    zero = plot.timeline.first_contact if align == "contact" else 0.0
    if zero is None:
        return None
    first = int(np.ceil((plot.time[0] - zero) / SPREAD_PERIOD - 1e-6))
    last = int(np.floor((plot.time[-1] - zero) / SPREAD_PERIOD + 1e-6))
    times = zero + SPREAD_PERIOD * np.arange(first, last + 1)
    names = tuple(name for name in plot.names if name.partition("/")[2] in AVERAGED)
    rows = [np.interp(times, plot.time, plot.values[plot.names.index(name)]) for name in names]
    return Resampled(first, names, np.array(rows))


def spread(takes: Sequence[Resampled], left_out: Sequence[str] = ()) -> Spread:
    """Mean and standard deviation at each time over the takes that last that long."""
    if not takes:
        raise ValueError("None of these takes touches anything; align them at their start.")
    names = tuple(name for name in takes[0].names if all(name in take.names for take in takes))
    if not names:
        raise ValueError("These takes have no arm in common.")
    first = min(take.first for take in takes)
    n = max(take.first + take.values.shape[1] for take in takes) - first
    stacked = np.full((len(takes), len(names), n), np.nan)
    for number, take in enumerate(takes):
        rows = take.values[[take.names.index(name) for name in names]]
        stacked[number, :, take.first - first : take.first - first + rows.shape[1]] = rows
    present = np.isfinite(stacked)
    count = present.sum(axis=0)
    mean = np.divide(np.where(present, stacked, 0.0).sum(axis=0), count, where=count > 0, out=_nan(count))
    square = np.where(present, (stacked - mean) ** 2, 0.0).sum(axis=0)
    variance = np.divide(square, np.maximum(count - 1, 1), where=count > 0, out=_nan(count))
    return Spread(
        time=np.round(SPREAD_PERIOD * (first + np.arange(n)), 4).tolist(),
        mean=dict(zip(names, np.round(mean, DIGITS).tolist(), strict=True)),
        sd=dict(zip(names, np.round(np.sqrt(variance), DIGITS).tolist(), strict=True)),
        count=count.max(axis=0).tolist(),
        left_out=list(left_out),
    )


def _nan(like: Array) -> Array:
    return np.full(like.shape, np.nan)


@dataclass(frozen=True, slots=True)
class _Plot:
    """All that is plotted of a take."""

    timeline: Timeline
    names: tuple[str, ...]
    time: Array  # (n,) [s]
    values: Array  # (k, n)


def _plot_of(path: Path) -> _Plot:
    status = path.stat()
    return _read(path, status.st_mtime_ns, status.st_size)


@lru_cache(maxsize=KEPT)
def _read(path: Path, mtime_ns: int, size: int) -> _Plot:
    with open_episode(path) as episode:
        cursor = Cursor(episode)
        images = {name: np.round(episode.image_times(name), 4).tolist() for name in episode.cameras}
    touched = [span.start for arm in cursor.arms for span in arm.phases if span.label == CONTACT]
    timeline = Timeline(
        duration=cursor.duration,
        arms=tuple(ArmBands(arm.name, arm.phases, arm.modes) for arm in cursor.arms),
        marks=cursor.marks,
        first_contact=min(touched, default=None),
        images=images,
    )
    time = cursor.arms[0].time
    names = tuple(f"{arm.name}/{name}" for arm in cursor.arms for name in UNITS)
    return _Plot(timeline, names, time, np.concatenate([_curves_of(arm, time) for arm in cursor.arms]))


def _curves_of(arm: ArmTrack, time: Array) -> Array:
    """(len(UNITS), n) at common times (n,), in the order of UNITS."""
    now = _newest(arm.time, time)
    action = _newest(arm.action_time, time)
    wrench, tcp = arm.wrench[now], arm.base_from_tcp[now]
    target = arm.base_from_target[action]
    facing = np.abs((tcp[:, 3:] * target[:, 3:]).sum(axis=1)).clip(max=1.0)
    rows = [
        *wrench[:, :3].T,
        arm.force[now],
        *wrench[:, 3:].T,
        np.linalg.norm(wrench[:, 3:], axis=1),
        arm.stiffness[action],
        100.0 * arm.gripper[now],
        1e3 * np.linalg.norm(tcp[:, :3] - target[:, :3], axis=1),
        np.degrees(2.0 * np.arccos(facing)),
    ]
    return np.array(rows, dtype=np.float64)


def _newest(known: Array, times: Array) -> Array:
    """(n,) for each time the last of `known` at or before, else the first."""
    if len(known) == len(times) and np.array_equal(known, times):
        return np.arange(len(times))
    return np.maximum(np.searchsorted(known, times + 1e-9, side="right") - 1, 0)
