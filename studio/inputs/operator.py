"""A person's hands as an agent: targets from a gizmo or keys, kept until the next one comes."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from controller.stiffness import StiffnessTable, stiffness_of
from controller.types import (
    Action,
    ArmAction,
    CartesianTarget,
    Hold,
    Observation,
    Pose,
    Release,
    StiffnessMode,
    Target,
    multiply_quaternions,
    quaternion_from_rotation_vector,
)
from studio.tasks import ArmSetup

CLOSED_AT_START = 0.0  # gripper command of an arm that holds a part from the start


class HandOfOperator:
    """What the operator wants of one arm. A still hand keeps its target; a parked one holds."""

    def __init__(self, setup: ArmSetup) -> None:
        self.setup = setup
        self.mode = setup.modes[0]
        self.gripper = CLOSED_AT_START if setup.grasp else setup.gripper
        self.engaged = False
        self.moved_at: float | None = None  # [s] monotonic time of the newest target
        self._target: Pose | None = None  # base_from_target; None until the first
        self._released = False

    def engage(self, base_from_target: Pose) -> None:
        """Take over from where the servo's target is: nothing moves."""
        self._target = base_from_target
        self.engaged = True
        self._released = False

    def park(self) -> None:
        self.engaged = False
        self._target = None

    def release(self) -> None:
        """Stop pressing; the hand must be engaged anew."""
        self.park()
        self._released = True

    def move_to(self, base_from_target: Pose, now: float) -> None:
        if self.engaged:
            self._target, self.moved_at = base_from_target, now

    def nudge(self, translation: Pose, now: float) -> None:
        """A step: `translation.position` in base axes, its rotation in tool axes."""
        if self.engaged and self._target is not None:
            target = self._target
            wxyz = multiply_quaternions(target.wxyz, translation.wxyz)
            self.move_to(Pose(target.position + translation.position, wxyz / (wxyz @ wxyz) ** 0.5), now)

    def action(self, table: StiffnessTable) -> ArmAction:
        target: Target
        if self._target is not None:
            target = CartesianTarget(self._target, stiffness_of(self.mode, table))
        else:
            target = Release() if self._released else Hold()
        return ArmAction(target, self.gripper)


class OperatorAgent:
    """All hands of one operator."""

    def __init__(
        self,
        setups: tuple[ArmSetup, ...],
        table: StiffnessTable = "tuned",
        now: Callable[[], float] = time.monotonic,
    ) -> None:
        self.hands = tuple(HandOfOperator(setup) for setup in setups)
        self._table: StiffnessTable = table
        self._now = now

    def reset(self, observation: Observation) -> None:
        """Nothing: hands keep what they want."""

    def act(self, observation: Observation) -> Action:
        return Action(tuple(hand.action(self._table) for hand in self.hands))

    def move_to(self, arm: int, base_from_target: Pose) -> None:
        self.hands[arm].move_to(base_from_target, self._now())

    def nudge(self, arm: int, step: Pose) -> None:
        self.hands[arm].nudge(step, self._now())

    def set_mode(self, arm: int, mode: StiffnessMode) -> None:
        self.hands[arm].mode = mode

    def input_age(self, arm: int) -> float | None:
        """[s] since the operator last moved this hand."""
        moved_at = self.hands[arm].moved_at
        return None if moved_at is None else self._now() - moved_at


def step_of(translation: tuple[float, float, float], rotation: tuple[float, float, float]) -> Pose:
    """A nudge as a pose: translation in base axes [m], rotation vector in tool axes [rad]."""
    return Pose(np.array(translation), quaternion_from_rotation_vector(np.array(rotation)))
