"""Laws of hands and streams: engaging is the identity, silence holds, a lost hand releases."""

import numpy as np
import pytest

from controller.stiffness import stiffness_of
from controller.types import ArmAction, CartesianTarget, Hold, Observation, Pose, Release, StiffnessMode
from studio import tasks
from studio.inputs.operator import OperatorAgent, step_of
from studio.inputs.stream import WATCHDOG, StreamAgent

NOTHING = Observation(0.0, (), {})
POSE = Pose(np.array([0.4, 0.0, 0.2]), np.array([0.0, 1.0, 0.0, 0.0]))


class Now:
    """A clock that a test turns."""

    def __init__(self) -> None:
        self.seconds = 0.0

    def __call__(self) -> float:
        return self.seconds


@pytest.fixture
def operator() -> OperatorAgent:
    return OperatorAgent(tasks.load("wiping").arms)


def target_of(agent: OperatorAgent) -> object:
    return agent.act(NOTHING).arms[0].target


def test_a_hand_that_was_never_engaged_holds(operator: OperatorAgent) -> None:
    operator.hands[0].move_to(POSE)
    assert isinstance(target_of(operator), Hold)


def test_engaging_asks_for_the_target_that_is_there(operator: OperatorAgent) -> None:
    operator.hands[0].engage(POSE)
    target = target_of(operator)
    assert isinstance(target, CartesianTarget)
    assert target.base_from_target is POSE


def test_a_still_hand_keeps_its_target(operator: OperatorAgent) -> None:
    operator.hands[0].engage(POSE)
    assert all(target_of(operator).base_from_target is POSE for _ in range(1000))  # type: ignore[attr-defined]


def test_a_nudge_moves_in_base_axes_and_turns_in_tool_axes(operator: OperatorAgent) -> None:
    operator.hands[0].engage(POSE)
    operator.hands[0].nudge(step_of((0.0, 0.0, -0.01), (0.0, 0.0, 0.1)))
    moved = target_of(operator).base_from_target  # type: ignore[attr-defined]
    assert moved.position == pytest.approx([0.4, 0.0, 0.19])
    # Tool z points down (-z): a turn about it lowers the yaw in base axes.
    turn = POSE.rotation.T @ moved.rotation
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(0.1)


def test_modes_switch_the_stiffness_and_nothing_else(operator: OperatorAgent) -> None:
    operator.hands[0].engage(POSE)
    operator.hands[0].mode = StiffnessMode.LOW
    target = target_of(operator)
    assert isinstance(target, CartesianTarget)
    assert target.stiffness.translational[2, 2] == 250.0
    assert target.base_from_target is POSE


def test_release_lasts_until_engaged_again(operator: OperatorAgent) -> None:
    operator.hands[0].engage(POSE)
    operator.hands[0].release()
    operator.hands[0].move_to(POSE)
    assert isinstance(target_of(operator), Release)
    operator.hands[0].engage(POSE)
    assert isinstance(target_of(operator), CartesianTarget)


def test_a_silent_stream_holds_and_goes_on_when_heard_again() -> None:
    now = Now()
    stream = StreamAgent(2, now)
    wish = ArmAction(Release(), 0.3)
    assert isinstance(stream.act(NOTHING).arms[0].target, Hold)  # before the first word
    stream.set(0, wish)
    now.seconds = WATCHDOG
    assert stream.act(NOTHING).arms[0] is wish
    now.seconds = WATCHDOG + 1e-6
    held, other = stream.act(NOTHING).arms
    assert isinstance(held.target, Hold)
    assert held.gripper == 0.3  # the grip does not open
    assert isinstance(other.target, Hold)
    stream.set(0, wish)
    assert stream.act(NOTHING).arms[0] is wish


def test_a_lost_hand_releases_its_arm_only() -> None:
    now = Now()
    stream = StreamAgent(2, now)
    wish = ArmAction(CartesianTarget(POSE, stiffness_of(StiffnessMode.MEDIUM)), 0.0)
    stream.set(0, wish)
    stream.set(1, wish)
    stream.lose(0)
    lost, other = stream.act(NOTHING).arms
    assert isinstance(lost.target, Release)
    assert other is wish
