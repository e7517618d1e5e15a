"""Laws of scripted motions."""

from __future__ import annotations

import numpy as np
import pytest

from controller.types import (
    ArmAction,
    Array,
    CartesianTarget,
    Pose,
    StiffnessMode,
    quaternion_from_rotation_vector,
)
from studio.motion import Motion
from studio.session import CONTROL_PERIOD

START = Pose(np.array([0.4, 0.1, 0.2]), quaternion_from_rotation_vector(np.array([0.1, 3.0, 0.2])))
GOAL = Pose(np.array([0.5, -0.1, 0.1]), quaternion_from_rotation_vector(np.array([0.4, 2.8, -0.1])))


def hand(speed: float = 1.0) -> Motion:
    return Motion(START, StiffnessMode.MEDIUM, gripper=0.25, speed=speed)


def positions(actions: list[ArmAction]) -> Array:
    targets = [action.target for action in actions]
    assert all(isinstance(target, CartesianTarget) for target in targets)
    return np.array([target.base_from_target.position for target in targets])


@pytest.mark.parametrize("linear", [False, True])
def test_a_move_ends_at_its_goal_in_time(linear: bool) -> None:
    motion = hand()
    actions = list(motion.move(GOAL, 1.5, linear))
    assert len(actions) == round(1.5 / CONTROL_PERIOD)
    np.testing.assert_allclose(motion.pose.vector, GOAL.vector, atol=1e-12)
    np.testing.assert_allclose(actions[-1].target.base_from_target.vector, GOAL.vector, atol=1e-12)


def test_a_move_starts_and_ends_at_rest_on_a_straight_line() -> None:
    path = np.vstack((START.position, positions(list(hand().move(GOAL, 1.0)))))
    speeds = np.linalg.norm(np.diff(path, axis=0), axis=1)
    assert speeds[[0, -1]].max() < 0.01 * speeds.max()
    assert speeds.max() == pytest.approx(1.875 * speeds.mean(), rel=0.01)  # the peak of minimum jerk
    direction = (GOAL.position - START.position) / np.linalg.norm(GOAL.position - START.position)
    off_line = (path - START.position) - np.outer((path - START.position) @ direction, direction)
    np.testing.assert_allclose(off_line, 0.0, atol=1e-12)


def test_a_path_is_followed_at_its_speed() -> None:
    points = START.position + np.array([[0.1, 0.0, 0.0], [0.1, 0.05, 0.0], [0.0, 0.05, 0.0]])
    motion = hand()
    path = np.vstack((START.position, positions(list(motion.follow(points, speed=0.05)))))
    np.testing.assert_allclose(np.linalg.norm(np.diff(path, axis=0), axis=1), 0.05 * CONTROL_PERIOD)
    np.testing.assert_allclose(motion.pose.position, points[-1])


def test_a_quicker_hand_takes_less_time_for_everything() -> None:
    assert len(list(hand(speed=2.0).move(GOAL, 1.0))) == 50
    assert len(list(hand(speed=2.0).wait(1.0))) == 50


def test_a_hand_opens_evenly_where_it_is() -> None:
    motion = hand()
    actions = list(motion.grip(1.0, 0.5))
    np.testing.assert_allclose([action.gripper for action in actions], 0.25 + 0.75 * np.arange(1, 51) / 50)
    np.testing.assert_array_equal(positions(actions), np.tile(START.position, (50, 1)))
    assert motion.gripper == 1.0


def test_mode_and_gripper_hold_from_the_next_action_on() -> None:
    motion = hand()
    (first,) = motion.wait(CONTROL_PERIOD)
    motion.mode, motion.gripper = StiffnessMode.LOW, 0.75
    (second,) = motion.wait(CONTROL_PERIOD)
    assert [first.gripper, second.gripper] == [0.25, 0.75]
    assert [first.target.stiffness.diagonals[0], second.target.stiffness.diagonals[0]] == [500.0, 250.0]
