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
    Target,
    multiply_quaternions,
    quaternion_from_rotation_vector,
)
from studio.tasks import ArmSetup


class HandOfOperator:
    """What the operator wants of one arm. A still hand keeps its target; a parked one holds."""

    def __init__(self, setup: ArmSetup, now: Callable[[], float]) -> None:
        self.mode = setup.modes[0]
        self.gripper = 0.0 if setup.grasp else setup.gripper
        self._target: Pose | None = None  # base_from_target; None while parked
        self._released = False
        self._moved_at: float | None = None
        self._now = now

    @property
    def engaged(self) -> bool:
        """Whether the arm follows this hand."""
        return self._target is not None

    @property
    def input_age(self) -> float | None:
        """[s] since the operator last moved this hand; None before the first time."""
        return None if self._moved_at is None else self._now() - self._moved_at

    def engage(self, base_from_target: Pose) -> None:
        """Take over from where the servo's target is: nothing moves."""
        self._target, self._released = base_from_target, False

    def park(self) -> None:
        """Leave the arm where it is."""
        self._target = None

    def release(self) -> None:
        """Stop pressing; the hand must be engaged anew."""
        self._target, self._released = None, True

    def move_to(self, base_from_target: Pose) -> None:
        """Set the target, unless parked."""
        if self.engaged:
            self._target, self._moved_at = base_from_target, self._now()

    def nudge(self, step: Pose) -> None:
        """Move the target by a step: its position in base axes, its rotation in tool axes."""
        if self._target is not None:
            wxyz = multiply_quaternions(self._target.wxyz, step.wxyz)
            self.move_to(Pose(self._target.position + step.position, wxyz / np.linalg.norm(wxyz)))

    def action(self, table: StiffnessTable) -> ArmAction:
        """What to request now."""
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
        self.hands = tuple(HandOfOperator(setup, now) for setup in setups)
        self._table: StiffnessTable = table

    def reset(self, observation: Observation) -> None:
        """Nothing: hands keep what they want."""

    def act(self, observation: Observation) -> Action:
        return Action(tuple(hand.action(self._table) for hand in self.hands))


def step_of(translation: tuple[float, float, float], rotation: tuple[float, float, float]) -> Pose:
    """A nudge as a pose: translation in base axes [m], rotation vector in tool axes [rad]."""
    return Pose(np.array(translation), quaternion_from_rotation_vector(np.array(rotation)))
