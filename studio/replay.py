"""Replaying a take: the requested actions once more through the loop, compared tick by tick."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from controller.fdcc import FdccConfig
from controller.servo import ServoConfig
from controller.types import Action, ArmAction, CartesianTarget, JointTarget, Observation, Step
from studio import tasks
from studio.episode import Episode, EpisodeError
from studio.recorder import versions
from studio.session import CONTROL_PERIOD, Session
from studio.twin import Twin


class ReplayAgent:
    """Requests what was requested in a take, holds and releases included."""

    def __init__(self, actions: Sequence[Action]) -> None:
        self._actions = actions
        self._next = 0

    def reset(self, observation: Observation) -> None:
        self._next = 0

    def act(self, observation: Observation) -> Action | None:
        if self._next == len(self._actions):
            return None
        self._next += 1
        return self._actions[self._next - 1]


@dataclass(frozen=True, slots=True)
class Replay:
    """How a re-simulation compares with its take."""

    episode_id: str
    ticks: int
    first_difference: int | None  # tick at which states or applied actions first differ
    what: str  # of the first difference; empty where there is none
    other_versions: dict[str, tuple[str, str]] = field(default_factory=dict)  # name: (recorded, here)

    @property
    def is_exact(self) -> bool:
        return self.first_difference is None

    def __str__(self) -> str:
        told = f"{self.episode_id}: {self.ticks} ticks replayed, "
        if self.is_exact:
            return told + "every state and applied action equal to the bit."
        told += f"{self.what} at tick {self.first_difference}."
        if self.other_versions:
            other = ", ".join(f"{name} {was} -> {now}" for name, (was, now) in self.other_versions.items())
            told += f" The take was recorded elsewhere ({other}), so the bits may differ."
        return told


def replay(episode: Episode) -> Replay:
    """Re-simulate a take from its first snapshot and compare every tick."""
    header = episode.header
    twin = twin_of(episode)
    comparison = _Comparison(episode)
    actions = episode.actions()
    Session(twin).run(ReplayAgent(actions), [comparison], time_limit=(len(actions) + 1) * CONTROL_PERIOD)
    here = versions()
    other = {
        name: (was, here.get(name, "absent"))
        for name, was in header.versions.items()
        if here.get(name) != was
    }
    return Replay(header.episode_id, len(actions), comparison.tick, comparison.what, other)


def twin_of(episode: Episode) -> Twin:
    """A twin of the take's task with its control settings, in the state in which the take began."""
    header = episode.header
    first = next(episode.snapshots(), None)
    if first is None:
        raise EpisodeError(f"{header.episode_id} holds no snapshot, so it cannot be simulated again.")
    twin = Twin(tasks.load(header.task), _servo_config(header.control.get("servo", {})))
    twin.reset(header.seed or 0, header.spread)
    twin.restore(first[1])
    return twin


def _servo_config(fields: dict[str, Any]) -> ServoConfig:
    if not fields:
        return ServoConfig()
    gains = {name: tuple(value) for name, value in fields["fdcc"].items() if isinstance(value, list)}
    return ServoConfig(**{**fields, "fdcc": FdccConfig(**{**fields["fdcc"], **gains})})


class _Comparison:
    """Subscriber: remembers the first tick that differs from the take."""

    def __init__(self, episode: Episode) -> None:
        self._applied = episode.actions("applied")
        self._digests = episode.digests()
        self._now = 0
        self.tick: int | None = None
        self.what = ""

    def on_step(self, step: Step) -> None:
        tick, self._now = self._now, self._now + 1
        if self.tick is not None:
            return
        if not all(map(_same, step.applied.action.arms, self._applied[tick].arms)):
            self.tick, self.what = tick, "the applied action differs"
        elif step.digest != self._digests[tick]:
            self.tick, self.what = tick, "the state differs"


def _same(one: ArmAction, other: ArmAction) -> bool:
    match one.target, other.target:
        case CartesianTarget() as a, CartesianTarget() as b:
            same = np.array_equal(a.base_from_target.vector, b.base_from_target.vector) and np.array_equal(
                a.stiffness.vector, b.stiffness.vector
            )
        case JointTarget() as c, JointTarget() as d:
            same = np.array_equal(c.q, d.q)
        case _:
            same = type(one.target) is type(other.target)
    return same and one.gripper == other.gripper
