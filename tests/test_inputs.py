"""Laws of hands and streams: engaging is the identity, silence holds, a lost hand releases."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.stiffness import stiffness_of
from controller.types import ArmAction, CartesianTarget, Hold, Observation, Pose, Release, StiffnessMode
from studio import tasks
from studio.inputs.operator import OperatorAgent, step_of
from studio.inputs.stream import WATCHDOG, StreamAgent
from studio.messages import Hands, HandSample

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
    operator.nudge(0, step_of((0.0, 0.0, -0.01), (0.0, 0.0, 0.1)))
    moved = target_of(operator).base_from_target  # type: ignore[attr-defined]
    assert moved.position == pytest.approx([0.4, 0.0, 0.19])
    # Tool z points down (-z): a turn about it lowers the yaw in base axes.
    turn = POSE.rotation.T @ moved.rotation
    assert np.arctan2(turn[1, 0], turn[0, 0]) == pytest.approx(0.1)


def reflected(pose: Pose) -> Pose:
    """As a mirror between the arms shows it, axis by axis."""
    mirror = np.diag([1.0, -1.0, 1.0])
    return Pose.of(mirror @ pose.rotation @ mirror, mirror @ pose.position)


def vectors(most: float) -> st.SearchStrategy[tuple[float, float, float]]:
    return st.tuples(*(st.floats(-most, most) for _ in range(3)))


@given(steps=st.lists(st.tuples(st.integers(0, 1), vectors(0.05), vectors(0.5)), max_size=8))
def test_mirrored_arms_stay_mirror_images_whichever_is_moved(
    steps: list[tuple[int, tuple[float, float, float], tuple[float, float, float]]],
) -> None:
    hands = OperatorAgent(tasks.load("peg-cylinder").arms)
    hands.hands[0].engage(POSE)
    hands.hands[1].engage(reflected(POSE))
    hands.mirror(True)
    for arm, translation, rotation in steps:
        hands.nudge(arm, step_of(translation, rotation))
    left, right = hands.hands[0].target, hands.hands[1].target
    assert left is not None
    assert right is not None
    image = reflected(left)
    np.testing.assert_allclose(right.position, image.position, atol=1e-9)
    np.testing.assert_allclose(right.rotation, image.rotation, atol=1e-9)


def test_a_parked_arm_sees_no_mirror(operator: OperatorAgent) -> None:
    hands = OperatorAgent(tasks.load("peg-cylinder").arms)
    hands.mirror(True)
    hands.hands[0].engage(POSE)
    hands.nudge(0, step_of((0.01, 0.0, 0.0), (0.0, 0.0, 0.0)))
    assert hands.hands[1].target is None
    with pytest.raises(ValueError, match="two arms; this task has 1"):
        operator.mirror(True)


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


# Tracked hands


class Wand:
    """A tracked hand and the agent that it leads, both arms of a two-armed task."""

    def __init__(self) -> None:
        self.now = Now()
        self.agent = OperatorAgent(tasks.load("peg-cylinder").arms, now=self.now)

    def show(self, *, x: float = 0.0, arm: int = 0, opening: float = 1.0, scale: float = 1.0) -> None:
        sample = HandSample(
            arm=arm, position=(x, 0.0, 1.2), wxyz=(1.0, 0.0, 0.0, 0.0), opening=opening, scale=scale
        )
        told = Hands(hands=(sample,), sampled=self.now.seconds, latency=0.004, jitter=0.001)
        self.agent.hands[arm].track(sample, told)

    def target(self, arm: int = 0) -> object:
        return self.agent.act(NOTHING).arms[arm].target

    def wait(self, seconds: float) -> None:
        self.now.seconds += seconds


@pytest.fixture
def wand() -> Wand:
    wand = Wand()
    for arm in (0, 1):
        wand.show(arm=arm)
        wand.agent.hands[arm].close_clutch(POSE)
    return wand


def x_of(target: object) -> float:
    assert isinstance(target, CartesianTarget)
    return float(target.base_from_target.position[0])


def test_a_clutched_hand_leads_from_where_the_target_was(wand: Wand) -> None:
    assert x_of(wand.target()) == 0.4
    wand.show(x=0.02)
    assert x_of(wand.target()) == pytest.approx(0.42)
    wand.agent.hands[0].move_to(Pose.identity())  # somebody drags the gizmo meanwhile
    assert x_of(wand.target()) == pytest.approx(0.42)


def test_an_open_clutch_holds_and_closing_it_elsewhere_goes_on_without_a_jump(wand: Wand) -> None:
    hand = wand.agent.hands[0]
    hand.open_clutch()
    assert isinstance(wand.target(), Hold)
    wand.show(x=0.5)
    hand.close_clutch(POSE)
    wand.show(x=0.51)
    assert x_of(wand.target()) == pytest.approx(0.41)


def test_a_silent_hand_holds_then_lets_go_and_the_other_arm_goes_on(wand: Wand) -> None:
    for _ in range(11):  # 0.11 s
        wand.wait(0.01)
        wand.show(arm=1)
    assert isinstance(wand.target(0), Hold)
    assert isinstance(wand.target(1), CartesianTarget)
    wand.show(x=0.01)
    assert x_of(wand.target(0)) == pytest.approx(0.41)  # a gap in the network is no loss
    for _ in range(51):
        wand.wait(0.01)
        wand.show(arm=1)
    assert isinstance(wand.target(0), Release)
    assert isinstance(wand.target(1), CartesianTarget)
    wand.show()
    assert isinstance(wand.target(0), Release)  # until the clutch is closed again
    status = wand.agent.hands[0].status
    assert status is not None
    assert "Nothing was heard" in status.why


def test_a_lost_or_jumping_hand_lets_go_and_says_why(wand: Wand) -> None:
    wand.agent.hands[0].lose("The headset was taken off.")
    wand.show(x=0.3, arm=1)
    for arm, why in ((0, "taken off"), (1, "jumped by 30 cm")):
        assert isinstance(wand.target(arm), Release)
        status = wand.agent.hands[arm].status
        assert status is not None
        assert why in status.why
    assert wand.agent.clutch_changes() == []  # neither was looked at while it led


def test_a_clutch_takes_no_hand_that_is_not_tracked(wand: Wand) -> None:
    wand.wait(1.0)
    with pytest.raises(ValueError, match="not tracked"):
        wand.agent.hands[0].close_clutch(POSE)


def test_engaging_opens_no_gripper_and_the_trigger_takes_it_over(wand: Wand) -> None:
    hand = wand.agent.hands[0]
    start = hand.gripper
    wand.show(opening=1.0 - start)
    assert hand.gripper == start
    wand.show(opening=start)
    wand.show(opening=0.4)
    assert hand.gripper == 0.4


def test_the_way_of_a_hand_is_timed_while_it_leads(wand: Wand) -> None:
    wand.wait(0.02)
    first, second = wand.agent.timings()
    assert first is not None
    assert (first.age, first.latency, first.jitter) == pytest.approx((0.02, 0.004, 0.001))
    assert second is not None
    for hand in wand.agent.hands:
        hand.open_clutch()
    assert wand.agent.timings() == ()
