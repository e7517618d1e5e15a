"""A take at any time: what a page or a report shows of it, as plain numbers."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Literal

import mujoco
import numpy as np

from controller.stiffness import stiffness_of
from controller.types import Array, Limit, Pose, StiffnessMode, Wrench
from studio.episode import Episode
from studio.interpolation import NANOSECOND, between, blend, blend_poses, newest
from studio.messages import Level
from studio.posture import Posture
from studio.session import CONTROL_PERIOD, IMAGE_EVERY
from studio.tasks import Task
from studio.totals import JOINT_CONTROL

TOUCHES = 1.5  # [N] above it a contact begins; swinging the hand through the air feels up to 1 N
PARTS = 1.0  # [N] below it a contact ends
SHORTEST = 0.05  # [s] a phase or a mode that lasts less belongs to the one before
STEP = IMAGE_EVERY * CONTROL_PERIOD  # [s] from one camera image to the next

FREE, CONTACT = "free", "contact"

MarkKind = Literal["mode", "limited", "refused", "event"]


@dataclass(frozen=True, slots=True)
class Span:
    """A stretch of a take in which something stays as it is."""

    start: float  # [s]
    end: float  # [s]
    label: str


@dataclass(frozen=True, slots=True)
class Mark:
    """Something that happened, worth finding again."""

    start: float  # [s]
    end: float  # [s] where it lasts
    kind: MarkKind
    text: str
    arm: str | None = None


@dataclass(frozen=True, slots=True)
class ArmTrack:
    """One arm over a whole take: what was measured at 500 Hz, what was applied at 100 Hz."""

    name: str
    world_from_base: Pose
    time: Array  # (n,) [s]
    q: Array  # (n, 6) [rad]
    base_from_tcp: Array  # (n, 7)
    wrench: Array  # (n, 6) about the TCP, base axes
    force: Array  # (n,) [N] norm
    gripper: Array  # (n,) 0 closed .. 1 open
    action_time: Array  # (m,) [s]
    base_from_target: Array  # (m, 7); NaN under joint control
    stiffness: Array  # (m,) [N/m] mean translational; NaN under joint control
    phases: tuple[Span, ...]  # FREE and CONTACT in turn, over the whole take
    modes: tuple[Span, ...]  # names of stiffness modes, or JOINT_CONTROL

    def path(self) -> Array:
        """(n, 3) [m] of the tool in the world."""
        return self.world_from_base.apply(self.base_from_tcp[:, :3])


@dataclass(frozen=True, slots=True)
class ArmMoment:
    """One arm at one time."""

    base_from_tcp: Pose
    base_from_target: Pose | None  # None under joint control
    wrench: Wrench
    stiffness: float  # [N/m] mean translational; NaN under joint control
    mode: str
    phase: str
    gripper: float  # 0 closed .. 1 open
    level: Level
    why: str  # what was limited; empty where all passed


@dataclass(frozen=True, slots=True)
class Moment:
    """A take at one time."""

    time: float  # [s]
    arms: tuple[ArmMoment, ...]
    qpos: Array | None  # (nq,) of the task's scene; None without a model


class Cursor:
    """Reads an open episode at any time. For one thread; the episode stays its opener's."""

    def __init__(
        self, episode: Episode, model: mujoco.MjModel | None = None, task: Task | None = None
    ) -> None:
        """With the `model` of the episode's task there are positions of the whole scene, with a `task` of
        its own the cursor paints what was painted in it.

        Raise ValueError where the episode is empty, or of another version of the task.
        """
        self.episode = episode
        self.duration = episode.duration
        self.arms = _tracks(episode)
        if not all(len(arm.time) and len(arm.action_time) for arm in self.arms):
            raise ValueError(f"{episode.header.episode_id} holds no states: it was cut off as it began.")
        self._limits = episode.limits()
        self._limit_times = np.array([at for at, _ in self._limits])
        self.marks = tuple(
            sorted((*_switches(self.arms), *self._limit_marks(), *self._events()), key=lambda m: m.start)
        )
        self._image_times = {camera: episode.image_times(camera) for camera in episode.cameras}
        self._state_times = episode.task_state_times()
        self._state = lru_cache(maxsize=4)(self._read_state)
        self._posture = Posture(model, episode.header.arms, episode.snapshots()) if model else None
        self._task = task
        self._painted = lru_cache(maxsize=2)(self._paint)

    def at(self, time: float) -> Moment:
        """Everything but pictures at `time` [s], which is clamped to the take."""
        time = self.clamped(time)
        samples = [between(arm.time, time) for arm in self.arms]
        limits = self._limits_at(time)
        arms = tuple(
            _arm_at(arm, sample, time, [limit for limit in limits if limit.arm == index])
            for index, (arm, sample) in enumerate(zip(self.arms, samples, strict=True))
        )
        return Moment(time, arms, self._qpos(time, samples))

    def task_state(self, time: float) -> dict[str, Array]:
        """What the task itself kept (ink, phases): the newest at or before `time`."""
        if not len(self._state_times):
            return {}
        return self._state(newest(self._state_times, time))

    def picture(self, time: float) -> Array | None:
        """(h, w, 3) uint8 of what is painted in the scene; None without a task that paints."""
        if self._task is None or not len(self._state_times):
            return None
        return self._painted(newest(self._state_times, time))

    def jpegs(self, time: float) -> dict[str, bytes]:
        """The newest image at or before `time` (else the first) of each camera that sent any."""
        return {
            camera: self.episode.jpeg(camera, newest(times, time))
            for camera, times in self._image_times.items()
            if len(times)
        }

    def clamped(self, time: float) -> float:
        return min(max(time, 0.0), self.duration)

    def stepped(self, time: float, steps: int) -> float:
        """[s] so many images further, on their grid; backwards where negative."""
        count = round(time / STEP, 6)  # 2.9999999 is 3
        return self.clamped(STEP * (np.floor(count) if steps > 0 else np.ceil(count)) + STEP * steps)

    def _qpos(self, time: float, samples: Sequence[tuple[int, int, float]]) -> Array | None:
        if self._posture is None:
            return None
        q, openings = [], []
        for arm, (first, second, share) in zip(self.arms, samples, strict=True):
            q.append(blend(arm.q[first], arm.q[second], share))
            openings.append(float(blend(arm.gripper[first], arm.gripper[second], share)))
        return self._posture.at(time, q, openings, self._objects(time))

    def _objects(self, time: float) -> dict[str, Array]:
        """Poses (7,) of the free bodies by name, between those recorded."""
        if not len(self._state_times):
            return {}
        first, second, share = between(self._state_times, time)
        before, after = self._state(first), self._state(second)
        return {
            name.removeprefix("pose/"): blend_poses(pose, after.get(name, pose), share)
            for name, pose in before.items()
            if name.startswith("pose/")
        }

    def _paint(self, number: int) -> Array | None:
        assert self._task is not None
        self._task.restore(self._state(number))
        painted = self._task.texture()
        return painted[1] if painted else None

    def _read_state(self, number: int) -> dict[str, Array]:
        return self.episode.task_state_at(float(self._state_times[number]))

    def _limits_at(self, time: float) -> tuple[Limit, ...]:
        """Those of the control period that `time` lies in."""
        number = int(np.searchsorted(self._limit_times, time + NANOSECOND, side="right")) - 1
        if number < 0 or time - self._limits[number][0] > CONTROL_PERIOD - NANOSECOND:
            return ()
        return self._limits[number][1]

    def _limit_marks(self) -> Iterator[Mark]:
        """One for each stretch in which a limit acted without a break."""
        acting: dict[tuple[int, str, bool], Mark] = {}
        for at, limits in self._limits:
            for limit in limits:
                key = (limit.arm, limit.kind, limit.refused)
                mark = acting.get(key)
                if mark is None or at - mark.end > SHORTEST:
                    if mark is not None:
                        yield mark
                    kind: MarkKind = "refused" if limit.refused else "limited"
                    mark = Mark(at, at, kind, limit.why, self.arms[limit.arm].name)
                acting[key] = replace(mark, end=at + CONTROL_PERIOD)
        yield from acting.values()

    def _events(self) -> Iterator[Mark]:
        return (Mark(e.time, e.time, "event", f"{e.kind}: {e.text}") for e in self.episode.events())


def steps(*curves: Array) -> Array:
    """Rising indices of the samples around every change of some (m,) curves that stay level in between."""
    levels = np.nan_to_num(np.stack(curves))
    before = np.flatnonzero((levels[:, 1:] != levels[:, :-1]).any(axis=0))
    return np.unique([0, *before, *(before + 1), levels.shape[1] - 1])


def peaks(values: Array, n: int) -> Array:
    """Rising indices of about `n` of (m,) `values`: the least and the greatest of every stretch."""
    if len(values) <= n:
        return np.arange(len(values))
    edges = np.linspace(0, len(values), n // 2 + 1).astype(int)
    low = [start + int(values[start:end].argmin()) for start, end in itertools.pairwise(edges)]
    high = [start + int(values[start:end].argmax()) for start, end in itertools.pairwise(edges)]
    return np.unique([0, *low, *high, len(values) - 1])


def _tracks(episode: Episode) -> tuple[ArmTrack, ...]:
    header, end = episode.header, episode.duration
    groups = [f"{arm}/{group}" for arm in header.arms for group in ("state", "applied")]
    columns = episode.columns(*groups)
    bases = [Pose.from_vector(np.array(pose)) for pose in header.world_from_base]
    table = header.control.get("servo", {}).get("stiffness_table", "tuned")
    tracks = []
    for arm, base in zip(header.arms, bases or [Pose.identity()] * len(header.arms), strict=True):
        state = {name: columns[f"{arm}/state/{name}"] for name in ("time", "q", "base_from_tcp", "gripper")}
        wrench = columns[f"{arm}/state/wrench"]
        force = np.linalg.norm(wrench[:, :3], axis=1)
        # Rows of the upper triangle: xx, yy, zz.
        stiffness = columns[f"{arm}/applied/stiffness"][:, [0, 3, 5]].mean(axis=1)
        times = columns[f"{arm}/applied/time"]
        tracks.append(
            ArmTrack(
                name=arm,
                world_from_base=base,
                **state,
                wrench=wrench,
                force=force,
                action_time=times,
                base_from_target=columns[f"{arm}/applied/base_from_target"],
                stiffness=stiffness,
                phases=phases_of(state["time"], wrench, end),
                modes=_spans(times, _mode_names(stiffness, table), end),
            )
        )
    return tuple(tracks)


def phases_of(time: Array, wrench: Array, end: float) -> tuple[Span, ...]:
    """FREE and CONTACT in turn until `end` [s], of (n,) [s] and (n, 6)."""
    return _spans(time, _touching(np.linalg.norm(wrench[:, :3], axis=1)), end)


def _touching(force: Array) -> Array:
    """(n,) FREE or CONTACT, with hysteresis; a dead sensor's NaN changes nothing."""
    decided = np.where(force > TOUCHES, 1, np.where(force < PARTS, 0, -1))
    newest = np.maximum.accumulate(np.where(decided >= 0, np.arange(len(force)), -1))
    return np.where((newest >= 0) & (decided[newest] == 1), CONTACT, FREE)


def _mode_names(stiffness: Array, table: Literal["tuned", "literal"]) -> Array:
    """(m,) the mode nearest to each mean translational stiffness."""
    names = [mode.value for mode in StiffnessMode]
    values = [stiffness_of(mode, table).translational[0, 0] for mode in StiffnessMode]
    nearest = np.abs(stiffness[:, None] - values).argmin(axis=1)
    return np.where(np.isnan(stiffness), JOINT_CONTROL, np.array(names)[nearest])


def _spans(times: Array, labels: Array, end: float) -> tuple[Span, ...]:
    """Equal labels joined, those that last less than SHORTEST with the one before."""
    if not len(times):
        return ()
    first = np.concatenate(([0], np.flatnonzero(labels[1:] != labels[:-1]) + 1))  # samples of new labels
    starts: list[float] = []
    told: list[str] = []
    for start, stop, label in zip(times[first], [*times[first[1:]], end], labels[first], strict=True):
        if not told or (stop - start >= SHORTEST and label != told[-1]):
            starts.append(float(start))
            told.append(str(label))
    return tuple(Span(*span) for span in zip(starts, [*starts[1:], end], told, strict=True))


def _switches(arms: Sequence[ArmTrack]) -> Iterator[Mark]:
    for arm in arms:
        for before, after in itertools.pairwise(arm.modes):
            yield Mark(after.start, after.start, "mode", f"{before.label} to {after.label}", arm.name)


def _arm_at(arm: ArmTrack, sample: tuple[int, int, float], time: float, limits: Sequence[Limit]) -> ArmMoment:
    first, second, share = sample
    tcp = blend_poses(arm.base_from_tcp[first], arm.base_from_tcp[second], share)
    wrench = blend(arm.wrench[first], arm.wrench[second], share)
    action = newest(arm.action_time, time)
    target = arm.base_from_target[action]
    refused = any(limit.refused for limit in limits)
    return ArmMoment(
        base_from_tcp=Pose.from_vector(tcp),
        base_from_target=None if np.isnan(target[0]) else Pose.from_vector(target),
        wrench=Wrench.from_vector(wrench),
        stiffness=float(arm.stiffness[action]),
        mode=_label_at(arm.modes, time),
        phase=_label_at(arm.phases, time),
        gripper=float(blend(arm.gripper[first], arm.gripper[second], share)),
        level="refused" if refused else "limited" if limits else "ok",
        why="; ".join(limit.why for limit in limits),
    )


def _label_at(spans: Sequence[Span], time: float) -> str:
    return next((span.label for span in reversed(spans) if span.start <= time + NANOSECOND), "")
