"""Motions of one arm for scripted demonstrations: minimum-jerk moves between poses at the control rate."""

from __future__ import annotations

import itertools
from collections.abc import Iterator, Sequence

import numpy as np

from controller.stiffness import StiffnessTable, stiffness_of
from controller.types import (
    Action,
    ArmAction,
    Array,
    CartesianTarget,
    Pose,
    StiffnessMode,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector,
)
from studio.session import CONTROL_PERIOD


class Motion:
    """Remembers where one arm's target is, and yields one action per control period towards the next.

    Poses are base_from_tcp, or world_from_tcp where it is told its `base`. `mode` and `gripper` may be set at
    any time and hold from the next action on.
    """

    def __init__(
        self,
        start: Pose,
        mode: StiffnessMode,
        gripper: float,
        table: StiffnessTable = "tuned",
        speed: float = 1.0,
        base: Array | None = None,
    ) -> None:
        """`base` (3,) [m] is the arm's base in the world, its axes parallel to the world's."""
        self.pose = start
        self.mode = mode
        self.gripper = gripper
        self._table: StiffnessTable = table
        self._speed = speed  # all durations are divided by it
        self._base = np.zeros(3) if base is None else base

    def move(self, goal: Pose, seconds: float, linear: bool = False) -> Iterator[ArmAction]:
        """To `goal` along a straight line: minimum jerk, or at constant speed where `linear`."""
        start = self.pose
        turn = rotation_vector(multiply_quaternions(goal.wxyz, start.inverse().wxyz))
        n = max(1, round(seconds / self._speed / CONTROL_PERIOD))
        for share in np.arange(1, n + 1) / n:
            s = float(share if linear else share**3 * (10 - 15 * share + 6 * share**2))
            self.pose = Pose(
                start.position + s * (goal.position - start.position),
                multiply_quaternions(quaternion_from_rotation_vector(s * turn), start.wxyz),
            )
            yield self.action()

    def follow(self, points: Array, speed: float) -> Iterator[ArmAction]:
        """Along the polyline `points` (n, 3) [m] at `speed` [m/s], orientation unchanged."""
        for point in points:
            distance = float(np.linalg.norm(point - self.pose.position))
            yield from self.move(Pose(point, self.pose.wxyz), distance / speed, linear=True)

    def grip(self, opening: float, seconds: float) -> Iterator[ArmAction]:
        """Open (1) or close (0) the hand evenly: both fingers meet what lies between them softly."""
        start = self.gripper
        n = max(1, round(seconds / self._speed / CONTROL_PERIOD))
        for share in np.arange(1, n + 1) / n:
            self.gripper = float(start + share * (opening - start))
            yield self.action()

    def wait(self, seconds: float) -> Iterator[ArmAction]:
        for _ in range(max(1, round(seconds / self._speed / CONTROL_PERIOD))):
            yield self.action()

    def action(self) -> ArmAction:
        """To the present target."""
        target = Pose(self.pose.position - self._base, self.pose.wxyz)
        return ArmAction(CartesianTarget(target, stiffness_of(self.mode, self._table)), self.gripper)


def together(hands: Sequence[Motion], *motions: Iterator[ArmAction]) -> Iterator[Action]:
    """Actions of all `hands` while `motions` of some of them run side by side; the others stay."""
    for _ in itertools.zip_longest(*motions):
        yield Action(tuple(hand.action() for hand in hands))
