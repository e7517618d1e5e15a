"""A person's hands as an agent: targets from a gizmo or keys, kept until the next one, or tracked hands.

A tracked hand leads its arm through a clutch and must keep talking. Silence holds the arm; where the silence
lasts or the hand is lost, the arm stops pressing and waits for the clutch. The other arm goes on.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from controller.stiffness import StiffnessTable, stiffness_of
from controller.types import (
    Action,
    ArmAction,
    Array,
    CartesianTarget,
    Hold,
    InputTiming,
    Observation,
    Pose,
    Release,
    Target,
    multiply_quaternions,
    quaternion_from_rotation_vector,
)
from studio.inputs.clutch import Clutch, Fader
from studio.inputs.stream import WATCHDOG
from studio.messages import Hands, HandSample, HandStatus
from studio.tasks import ArmSetup

LOST = 0.5  # [s] of silence after which a tracked hand counts as lost


class HandOfOperator:
    """What the operator wants of one arm. A still hand keeps its target; a parked one holds."""

    def __init__(self, setup: ArmSetup, now: Callable[[], float]) -> None:
        self.modes = setup.modes
        self.mode = setup.modes[0]
        self.gripper = 0.0 if setup.grasp else setup.gripper
        self.clutch = Clutch()
        self._target: Pose | None = None  # base_from_target; None while parked
        self._released = False
        self._moved_at: float | None = None
        self._tracked: _Tracked | None = None
        self._fader = Fader()
        self._now = now

    @property
    def engaged(self) -> bool:
        """Whether the arm follows this hand."""
        return self._target is not None

    @property
    def target(self) -> Pose | None:
        """base_from_target; None while parked."""
        return self._target

    @property
    def input_age(self) -> float | None:
        """[s] since the operator last moved this hand; None before the first time."""
        if self.clutch.engaged and self._tracked:
            return self._now() - self._tracked.sampled
        return None if self._moved_at is None else self._now() - self._moved_at

    @property
    def timing(self) -> InputTiming | None:
        """Of the tracked hand; None where none has been heard of for a while."""
        tracked = self._tracked
        if tracked is None or self._silence > LOST:
            return None
        return InputTiming(self._now() - tracked.sampled, tracked.latency, tracked.jitter)

    @property
    def status(self) -> HandStatus | None:
        """Of the tracked hand; None where there is none, and nothing to tell of an earlier one."""
        timing, why = self.timing, self.clutch.why
        if timing is None:
            return HandStatus(False, why, None, 0.0, 0.0) if why else None
        return HandStatus(self.clutch.engaged, why, timing.age, timing.latency, timing.jitter)

    def engage(self, base_from_target: Pose) -> None:
        """Take over from where the servo's target is: nothing moves."""
        self._open_clutch()
        self._target, self._released = base_from_target, False

    def park(self) -> None:
        """Leave the arm where it is."""
        self._open_clutch("The arm was parked.")
        self._target = None

    def release(self, why: str = "The arm was let go.") -> None:
        """Stop pressing; the hand must be engaged anew."""
        self._open_clutch(why)
        self._target, self._released = None, True

    def move_to(self, base_from_target: Pose) -> None:
        """Set the target, unless parked or led by a tracked hand."""
        if self.engaged and not self.clutch.engaged:
            self._target, self._moved_at = base_from_target, self._now()

    def switch_mode(self) -> None:
        one, other = self.modes
        self.mode = other if self.mode == one else one

    # A tracked hand

    def track(self, sample: HandSample, told: Hands) -> None:
        """Hear where the hand is; the arm follows while the clutch is engaged."""
        pose = Pose(np.array(sample.position), np.array(sample.wxyz))
        heard = self._now()
        sampled = min(told.sampled, heard)  # the other's idea of our clock may be off
        self._tracked = _Tracked(pose, sample.scale, sampled, heard, told.latency, told.jitter)
        if not self.clutch.engaged:
            return
        target = self.clutch.follow(pose, sampled, sample.scale)
        if target is None:
            self.release(self.clutch.why)
        else:
            self._target = target
            if sample.opening is not None:
                self.gripper = self._fader.opening(sample.opening, self.gripper)

    def close_clutch(self, base_from_target: Pose) -> None:
        """Let the tracked hand lead, from where the servo's target is: nothing moves."""
        tracked = self.check_tracked()
        self.clutch.engage(tracked.pose, base_from_target, tracked.sampled, tracked.scale)
        self._fader = Fader()
        self._target, self._released = base_from_target, False

    def check_tracked(self) -> _Tracked:
        """The newest sample of the tracked hand. Raises ValueError where there is none."""
        if self._tracked is None or self._silence > WATCHDOG:
            raise ValueError("The controller is not tracked; hold it where the headset sees it.")
        return self._tracked

    def open_clutch(self) -> None:
        """Hold, as long as the operator wants."""
        if self.clutch.engaged:
            self._open_clutch()
            self._target = None

    def lose(self, why: str) -> None:
        """The tracked hand is not to be trusted any more."""
        if self.clutch.engaged:
            self.release(why)

    def _open_clutch(self, why: str = "") -> None:
        if self.clutch.engaged:
            self.clutch.release(why)

    @property
    def _silence(self) -> float:
        """[s] since the tracked hand was heard of."""
        return math.inf if self._tracked is None else self._now() - self._tracked.heard

    def take_step(self, translation: Array, rotation: Array) -> None:
        """Move the target by a translation [m] and a rotation (wxyz), both in base axes."""
        if self._target is not None:
            wxyz = multiply_quaternions(rotation, self._target.wxyz)
            self.move_to(Pose(self._target.position + translation, wxyz / np.linalg.norm(wxyz)))

    def action(self, table: StiffnessTable) -> ArmAction:
        """What to request now."""
        if self.clutch.engaged and self._silence > LOST:
            self.lose(f"Nothing was heard of the controller for {LOST:g} s.")
        target: Target
        if self._target is None:
            target = Release() if self._released else Hold()
        elif self.clutch.engaged and self._silence > WATCHDOG:
            target = Hold()
        else:
            target = CartesianTarget(self._target, stiffness_of(self.mode, table))
        return ArmAction(target, self.gripper)


@dataclass(frozen=True, slots=True)
class _Tracked:
    """The newest sample of a tracked hand."""

    pose: Pose  # base_from_hand
    scale: float
    sampled: float  # [s] when the pose was taken
    heard: float  # [s] when it came
    latency: float  # [s]
    jitter: float  # [s]


class OperatorAgent:
    """All hands of one operator."""

    def __init__(
        self,
        setups: tuple[ArmSetup, ...],
        table: StiffnessTable = "tuned",
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.hands = tuple(HandOfOperator(setup, now) for setup in setups)
        self._names = tuple(setup.name for setup in setups)
        self.is_mirrored = False  # whether what moves one of two arms moves the other like in a mirror
        self._were_led = [False] * len(setups)
        self._table: StiffnessTable = table

    def mirror(self, is_mirrored: bool) -> None:
        """Let both arms move like in a mirror, or no longer. Raises ValueError where there are not two."""
        if is_mirrored and len(self.hands) != 2:
            raise ValueError(f"A mirror needs two arms; this task has {len(self.hands)}.")
        self.is_mirrored = is_mirrored

    def move_to(self, arm: int, base_from_target: Pose) -> None:
        """Set an arm's target, see `HandOfOperator.move_to`; mirrored, the other takes the same step."""
        hand = self.hands[arm]
        before = hand.target
        hand.move_to(base_from_target)
        if self.is_mirrored and before is not None and hand.target is not None:
            self.hands[1 - arm].take_step(*_reflected_step(before, hand.target))

    def nudge(self, arm: int, step: Pose) -> None:
        """Move an arm's target by a step: its position in base axes, its rotation in tool axes."""
        target = self.hands[arm].target
        if target is not None:
            wxyz = multiply_quaternions(target.wxyz, step.wxyz)
            self.move_to(arm, Pose(target.position + step.position, wxyz / np.linalg.norm(wxyz)))

    def reset(self, observation: Observation) -> None:
        """Nothing: hands keep what they want."""

    def act(self, observation: Observation) -> Action:
        return Action(tuple(hand.action(self._table) for hand in self.hands))

    def timings(self) -> tuple[InputTiming | None, ...]:
        """How the tracked hands that lead an arm reach us; () where none does."""
        if not any(hand.clutch.engaged for hand in self.hands):
            return ()
        return tuple(hand.timing if hand.clutch.engaged else None for hand in self.hands)

    def clutch_changes(self) -> list[str]:
        """Of each tracked hand that began or ceased to lead its arm since the last call: which, and why."""
        told = []
        for arm, (name, hand) in enumerate(zip(self._names, self.hands, strict=True)):
            if hand.clutch.engaged != self._were_led[arm]:
                self._were_led[arm] = hand.clutch.engaged
                what = "engaged" if hand.clutch.engaged else hand.clutch.why or "disengaged"
                told.append(f"{name}: {what}")
        return told


def _reflected_step(before: Pose, after: Pose) -> tuple[Array, Array]:
    """Translation [m] and rotation (wxyz) from one target to the next, in base axes, as a mirror shows them.

    The mirror stands between the arms, upright along x: bases have equal axes and differ along y.
    """
    inverse = before.wxyz * np.array([1.0, -1.0, -1.0, -1.0])
    rotation = multiply_quaternions(after.wxyz, inverse)
    return (after.position - before.position) * [1.0, -1.0, 1.0], rotation * [1.0, -1.0, 1.0, -1.0]


def step_of(translation: tuple[float, float, float], rotation: tuple[float, float, float]) -> Pose:
    """A nudge as a pose: translation in base axes [m], rotation vector in tool axes [rad]."""
    return Pose(np.array(translation), quaternion_from_rotation_vector(np.array(rotation)))
