"""Laws of the fast loop: what is refused, what is limited, what hold, release and engaging do."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from controller.model import FLANGE, ur5e
from controller.servo import ArmServo, ServoConfig
from controller.stiffness import nearest_mode, stiffness_of
from controller.types import (
    ArmAction,
    Array,
    CartesianTarget,
    Hold,
    JointTarget,
    Pose,
    Release,
    Stiffness,
    StiffnessMode,
    Target,
    Wrench,
    multiply_quaternions,
    quaternion_from_rotation_vector,
)

TOOL = Pose(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0]))
ARM = ur5e(TOOL)
HOME = np.array([0.0, -1.2, 1.9, -2.27, -1.57, 0.0])
AT_HOME = ARM.forward_kinematics(HOME)
WORKSPACE = (AT_HOME.position - 0.3, AT_HOME.position + 0.3)
LOW, HIGH = stiffness_of(StiffnessMode.LOW), stiffness_of(StiffnessMode.HIGH)
CONFIG = ServoConfig()
DOWN = np.array([0.0, 0.0, -1.0])


class Rig:
    """A servo on a robot that is where it is commanded, above a floor of springs [N/m], if there is one."""

    def __init__(self, config: ServoConfig = CONFIG, floor: float = -np.inf, spring: float = 5000.0) -> None:
        self.servo = ArmServo(0, ARM, config, WORKSPACE, HOME, LOW)
        self.floor, self.spring = floor, spring

    @property
    def pose(self) -> Pose:
        return ARM.forward_kinematics(self.servo.q_command)

    @property
    def force(self) -> float:
        """[N] with which the floor pushes up."""
        return self.spring * max(0.0, self.floor - float(self.pose.position[2]))

    def wrench(self) -> Wrench:
        return Wrench(np.array([0.0, 0.0, self.force]), np.zeros(3))

    def run(self, target: Target, periods: int = 1, gripper: float = 0.0) -> ArmAction:
        """Some control periods with one target; what was applied in the last."""
        for _ in range(periods):
            applied = self.servo.begin(ArmAction(target, gripper), self.pose, self.wrench())
            for _ in range(CONFIG.fast_steps):
                self.servo.step(self.servo.q_command, self._sensed())
        return applied

    def _sensed(self) -> Array:
        """(6,) the floor's push about the flange, in its axes."""
        base_from_flange = ARM.forward_kinematics(self.servo.q_command, FLANGE)
        force = np.array([0.0, 0.0, self.force])
        torque = np.cross(self.pose.position - base_from_flange.position, force)
        return np.concatenate((force @ base_from_flange.rotation, torque @ base_from_flange.rotation))

    @property
    def kinds(self) -> list[str]:
        return [limit.kind for limit in self.servo.limits]


def moved(offset: Array, turn: Array | None = None, start: Pose = AT_HOME) -> Pose:
    wxyz = quaternion_from_rotation_vector(np.zeros(3) if turn is None else turn)
    return Pose(start.position + offset, multiply_quaternions(wxyz, start.wxyz))


def towards(offset: Array, turn: Array | None = None, stiffness: Stiffness = LOW) -> CartesianTarget:
    return CartesianTarget(moved(np.asarray(offset), turn), stiffness)


def target_of(applied: ArmAction) -> CartesianTarget:
    assert isinstance(applied.target, CartesianTarget)
    return applied.target


def position_of(applied: ArmAction) -> Array:
    return target_of(applied).base_from_target.position


def bits_of(applied: ArmAction) -> bytes:
    return target_of(applied).base_from_target.vector.tobytes()


NAN_POSE = Pose(np.array([0.4, np.nan, 0.2]), AT_HOME.wxyz)


@pytest.mark.parametrize(
    ("target", "kind"),
    [
        (CartesianTarget(NAN_POSE, LOW), "not_finite"),
        (JointTarget(np.array([0.0, np.inf, 0, 0, 0, 0])), "not_finite"),
        (towards(0.6 * DOWN), "target_step"),
        (towards(np.zeros(3), np.array([0.0, 0.0, 2.5])), "target_step"),
        (JointTarget(HOME + np.array([1.1, 0, 0, 0, 0, 0])), "target_step"),
    ],
)
def test_what_cannot_be_meant_is_refused_and_the_arm_holds(target: Target, kind: str) -> None:
    rig = Rig()
    before = rig.run(towards([0.02, 0.0, 0.0]), periods=300)
    q = rig.servo.q_command
    after = rig.run(target, periods=100)
    (limit,) = rig.servo.limits
    assert (limit.kind, limit.refused) == (kind, True)
    assert "the arm holds" in limit.why
    assert bits_of(after) == bits_of(before)
    np.testing.assert_allclose(rig.servo.q_command, q, atol=1e-6)


def test_a_gripper_command_that_is_not_finite_leaves_the_gripper() -> None:
    rig = Rig()
    rig.run(Hold(), gripper=0.7)
    applied = rig.run(Hold(), gripper=float("nan"))
    assert applied.gripper == 0.7
    assert rig.kinds == ["not_finite"]
    assert rig.run(Hold(), gripper=3.0).gripper == 1.0


def test_feedback_that_is_not_finite_stays_and_says_so() -> None:
    rig = Rig(replace(CONFIG, feedback="measured"))
    rig.servo.begin(ArmAction(towards(0.001 * DOWN), 0.0), rig.pose, rig.wrench())
    for _ in range(CONFIG.fast_steps):
        assert rig.servo.step(np.full(6, np.nan), np.zeros(6)).tobytes() == HOME.tobytes()
    assert rig.kinds == ["not_finite"]


def test_the_workspace_clamps_a_target_and_names_the_side() -> None:
    rig = Rig()
    applied = rig.run(towards([0.1, 0.4, 0.0]), periods=300)
    (limit,) = rig.servo.limits
    assert (limit.kind, limit.refused) == ("workspace", False)
    assert f"y at {WORKSPACE[1][1]:.2f} m" in limit.why
    np.testing.assert_allclose(position_of(applied), AT_HOME.position + np.array([0.1, 0.3, 0.0]))


def test_a_far_target_is_followed_at_the_speed_limit() -> None:
    rig, goal = Rig(), towards([0.2, 0.0, 0.0])
    positions = [position_of(rig.run(goal))[0] for _ in range(60)]
    steps = np.diff([AT_HOME.position[0], *positions])
    assert steps.max() <= CONFIG.max_speed * CONFIG.control_period * (1 + 1e-9)
    assert positions[-1] == goal.base_from_target.position[0]  # 0.2 m at 0.5 m/s: 40 periods
    assert np.count_nonzero(steps) == 40


def test_a_far_turn_is_followed_at_the_turn_rate_limit() -> None:
    rig, goal = Rig(), towards(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    rig.run(goal, periods=49)
    assert rig.kinds == ["target_speed"]
    rig.run(goal, periods=2)  # 1 rad at 2 rad/s: 50 periods
    assert rig.kinds == []


def test_contact_force_limits_how_deep_a_target_goes() -> None:
    rig, deep = Rig(), towards(0.2 * DOWN, stiffness=HIGH)
    rig.run(deep, periods=100)
    action, push = ArmAction(deep, 0.0), np.array([0.0, 0.0, 10.0])
    rig.servo.begin(action, AT_HOME, Wrench(4 * push, np.zeros(3)))
    assert rig.kinds == []
    applied = rig.servo.begin(action, AT_HOME, Wrench(6 * push, np.zeros(3)))
    assert rig.kinds == ["contact_force"]
    assert "60 N" in rig.servo.limits[0].why
    depth = AT_HOME.position[2] - position_of(applied)[2]
    assert depth == pytest.approx(CONFIG.max_force / 750.0)  # 67 mm, not 200 mm


def test_contact_torque_limits_how_far_a_target_turns() -> None:
    rig, turned = Rig(), towards(np.zeros(3), np.array([0.0, 0.0, 0.5]), HIGH)
    rig.run(turned, periods=100)
    push = Wrench(np.zeros(3), np.array([0.0, 0.0, -12.0]))
    applied = rig.servo.begin(ArmAction(turned, 0.0), AT_HOME, push)
    assert rig.kinds == ["contact_torque"]
    angle = 2 * np.arccos(target_of(applied).base_from_target.wxyz @ AT_HOME.wxyz)
    assert angle == pytest.approx(CONFIG.max_torque / 50.0)  # 0.2 rad, not 0.5


numbers = st.floats(-1.0, 1.0) | st.just(float("nan"))
triples = st.lists(numbers, min_size=3, max_size=3).map(np.array)
finite = st.lists(st.floats(-3.0, 3.0), min_size=3, max_size=3).map(np.array)
requests = (
    st.builds(lambda p, turn: CartesianTarget(moved(p, turn), HIGH), triples, finite)
    | st.builds(lambda a, b: JointTarget(HOME + np.concatenate((a, b))), triples, triples)
    | st.sampled_from([Hold(), Release()])
)


@settings(max_examples=30, deadline=None)
@given(st.lists(st.tuples(requests, st.integers(1, 8)), max_size=12))
def test_whatever_is_requested_the_joints_stay_within_their_limits(asked: list[tuple[Target, int]]) -> None:
    rig = Rig(floor=AT_HOME.position[2] - 0.05)
    fastest = CONFIG.max_joint_speed * CONFIG.fast_period * (1 + 1e-9)
    for target, periods in asked:
        for _ in range(periods):
            rig.servo.begin(ArmAction(target, 0.5), rig.pose, rig.wrench())
            for _ in range(CONFIG.fast_steps):
                before = rig.servo.q_command
                q = rig.servo.step(before, rig._sensed())
                assert np.isfinite(q).all()
                assert np.abs(q - before).max() <= fastest
                assert (q >= ARM.lower).all()
                assert (q <= ARM.upper).all()


def test_hold_freezes_target_and_stiffness() -> None:
    rig = Rig()
    moving = rig.run(towards([0.1, 0.0, 0.0], stiffness=HIGH), periods=10)  # halfway there
    for _ in range(50):
        held = rig.run(Hold(), gripper=0.3)
        assert bits_of(held) == bits_of(moving)
        assert target_of(held).stiffness is HIGH
    assert held.gripper == 0.3


def test_hold_keeps_a_press_and_release_relieves_it() -> None:
    rig = Rig(floor=AT_HOME.position[2] - 0.02)
    rig.run(towards(0.03 * DOWN, stiffness=HIGH), periods=400)
    pressed = rig.force
    assert pressed == pytest.approx(6.5, abs=0.2)  # 750 and 5000 N/m in series over 10 mm
    rig.run(Hold(), periods=200)
    assert rig.force == pytest.approx(pressed, rel=1e-3)
    measured = rig.pose
    applied = rig.run(Release(), periods=400)
    np.testing.assert_allclose(position_of(applied), measured.position)
    assert rig.force < 0.2 * pressed


def test_release_runs_to_the_pose_of_the_moment_and_stays_there() -> None:
    # A target that chased the measured pose would let the arm be pushed away for ever.
    rig = Rig()
    first = rig.run(Release())
    rig.floor = AT_HOME.position[2] + 0.01  # something lifts the arm
    last = rig.run(Release(), periods=100)
    assert rig.force > 0.0
    assert bits_of(last) == bits_of(first)


def test_joint_targets_are_followed_exactly_at_the_speed_limit() -> None:
    rig, goal = Rig(), HOME + np.array([0.5, -0.2, 0.1, 0.0, 0.3, 0.0])
    rig.run(JointTarget(goal), periods=24)
    assert rig.kinds == ["joint_speed"]
    rig.run(JointTarget(goal), periods=2)  # 0.5 rad at 2 rad/s: 25 periods
    assert rig.servo.q_command.tobytes() == goal.tobytes()
    assert rig.kinds == []


def test_joint_control_reports_a_force_that_it_cannot_yield_to() -> None:
    rig = Rig()
    rig.servo.begin(
        ArmAction(JointTarget(HOME), 0.0), AT_HOME, Wrench(np.array([0.0, 0.0, 80.0]), np.zeros(3))
    )
    assert "cannot yield" in rig.servo.limits[0].why


def test_engaging_compliance_from_joint_control_moves_nothing() -> None:
    rig, q = Rig(), HOME + np.array([0.3, 0.1, -0.2, 0.1, 0.2, 0.5])
    rig.run(JointTarget(q), periods=40)
    applied = rig.run(CartesianTarget(ARM.forward_kinematics(q), HIGH), periods=50)
    np.testing.assert_allclose(rig.servo.q_command, q, atol=1e-9)
    np.testing.assert_allclose(position_of(applied), ARM.forward_kinematics(q).position)
    rig.run(JointTarget(q), periods=10)
    rig.run(CartesianTarget(moved(0.02 * DOWN, start=ARM.forward_kinematics(q)), HIGH))
    assert np.abs(rig.servo.q_command - q).max() < 1e-3  # it sets out from here: no jump to the last target


@pytest.mark.parametrize("last", [towards([0.1, 0.0, -0.1]), JointTarget(HOME + 0.2), Hold(), Release()])
def test_a_restored_servo_goes_on_to_the_bit(last: Target) -> None:
    def rest(rig: Rig) -> bytes:
        for target in (last, towards([0.05, 0.02, 0.0]), Hold(), Release(), last):
            rig.run(target, periods=7)
        return rig.servo.state().tobytes()

    floor = AT_HOME.position[2] - 0.01
    one, other = Rig(floor=floor), Rig(floor=floor)
    one.run(towards([0.1, 0.1, -0.05], stiffness=HIGH), periods=33)
    one.run(last, periods=3)
    other.servo.restore(one.servo.state())
    assert rest(other) == rest(one)


def test_a_source_of_20_hz_becomes_a_smooth_path() -> None:
    rig, targets = Rig(), []
    for tick in range(60):
        sent = tick // 5 * 5  # the source speaks every fifth period
        targets.append(position_of(rig.run(towards([0.001 * sent, 0.0, 0.0])))[0])
    steps = np.diff(targets[10:])
    np.testing.assert_allclose(steps, 0.001, rtol=1e-6)  # not 0, 0, 0, 0, 5 mm


def test_a_target_after_a_pause_is_taken_at_once() -> None:
    rig = Rig()
    rig.run(Hold(), periods=50)
    applied = rig.run(towards([0.003, 0.0, 0.0]))
    assert position_of(applied)[0] == AT_HOME.position[0] + 0.003


def test_stiffness_is_kept_within_its_bounds() -> None:
    rig = Rig()
    applied = rig.run(towards(np.zeros(3), stiffness=Stiffness.diagonal((5000, 500, 10, 35, 1, 3000))))
    assert rig.kinds == ["stiffness"]
    np.testing.assert_allclose(target_of(applied).stiffness.diagonals, (1200, 500, 50, 35, 2, 1200))


def test_bounding_stiffness_keeps_its_axes() -> None:
    turn = Pose(np.zeros(3), quaternion_from_rotation_vector(np.array([0.3, -0.5, 0.2]))).rotation
    block = turn @ np.diag([5000.0, 500.0, 300.0]) @ turn.T
    applied = Rig().run(towards(np.zeros(3), stiffness=Stiffness((block + block.T) / 2, np.eye(3) * 35)))
    np.testing.assert_allclose(
        turn.T @ target_of(applied).stiffness.translational @ turn, np.diag([1200.0, 500.0, 300.0]), atol=1e-9
    )


@pytest.mark.parametrize("mode", StiffnessMode)
@pytest.mark.parametrize("table", ["tuned", "literal"])
def test_the_modes_are_within_the_bounds_and_found_again(mode: StiffnessMode, table: str) -> None:
    config = ServoConfig.for_table(table)  # type: ignore[arg-type]
    rig, stiffness = Rig(config), stiffness_of(mode, config.stiffness_table)
    assert target_of(rig.run(towards(np.zeros(3), stiffness=stiffness))).stiffness is stiffness
    assert rig.kinds == []
    assert nearest_mode(stiffness, config.stiffness_table) is mode
    assert stiffness.diagonals[0] == {"low": 250, "medium": 500, "high": 750}[mode.value]


@pytest.mark.parametrize("name", ["fast_period", "max_speed", "max_force"])
@pytest.mark.parametrize("value", [0.0, -1.0, float("nan")])
def test_a_limit_that_means_nothing_is_refused(name: str, value: float) -> None:
    with pytest.raises(ValueError, match=name):
        ServoConfig(**{name: value})
