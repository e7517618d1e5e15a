"""FDCC against recorded runs of the reference program, and its laws."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pinocchio as pin
import pytest
from check_fdcc_vectors import compare_scenario, main, read
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from controller.fdcc import Fdcc, FdccConfig, virtual_arm
from controller.model import FLANGE, TCP, ArmModel, Segment, ur5e
from controller.types import (
    Array,
    Pose,
    Stiffness,
    multiply_quaternions,
    quaternion_from_rotation_vector,
    rotation_vector,
)
from studio.benchmarks.fdcc import measure

VECTORS = read(Path(__file__).parent / "data" / "fdcc_vectors.json.gz")
HOME = np.array([0.0, -1.6, 1.8, -1.8, -1.57, 0.0])
TOOL = Pose(np.array([0.0, 0.0, 0.2]), np.array([1.0, 0.0, 0.0, 0.0]))
ARM = ur5e(TOOL)
AT_HOME = ARM.forward_kinematics(HOME)
STIFFNESS = Stiffness.diagonal((250.0, 500.0, 750.0, 20.0, 35.0, 50.0))
PUSH = np.array([3.0, -2.0, 5.0, 0.3, 0.2, -0.4])


def _moved(pose: Pose, translation: Array, turn: Array) -> Pose:
    """Moved and turned in the axes of the pose's parent."""
    wxyz = multiply_quaternions(quaternion_from_rotation_vector(turn), pose.wxyz)
    return Pose(pose.position + translation, wxyz)


def _settle(fdcc: Fdcc, steps: int, *arguments: Any) -> Array:
    for _ in range(steps):
        fdcc.step(fdcc.q, *arguments)
    return fdcc.q


def _random_inputs(seed: int, steps: int) -> list[tuple[Array, Pose, Stiffness, Array, Array]]:
    """Measured joints near home, targets, stiffness, sensed and target wrenches."""
    rng = np.random.default_rng(seed)
    inputs = []
    for _ in range(steps):
        root = rng.normal(size=(3, 3))
        block = root @ root.T
        inputs.append(
            (
                HOME + rng.normal(scale=1e-3, size=6),
                _moved(AT_HOME, rng.normal(scale=0.05, size=3), rng.normal(scale=0.3, size=3)),
                Stiffness((block + block.T) * 100.0 + 50.0 * np.eye(3), block + block.T + 5.0 * np.eye(3)),
                rng.normal(scale=5.0, size=6),
                rng.normal(scale=2.0, size=6),
            )
        )
    return inputs


@pytest.mark.parametrize("scenario", VECTORS["scenarios"], ids=lambda scenario: scenario["name"])
def test_commands_are_those_of_the_reference(scenario: dict[str, Any]) -> None:
    comparison = compare_scenario(scenario, VECTORS["chains"][scenario["chain"]])
    assert comparison.difference <= 1e-9  # the stale pose left out would give up to 2.5e-2


def test_the_vector_check_fails_on_a_small_difference(tmp_path: Path) -> None:
    file = {"chains": VECTORS["chains"], "scenarios": [json.loads(json.dumps(VECTORS["scenarios"][2]))]}
    same, other = tmp_path / "same.json", tmp_path / "other.json"
    same.write_text(json.dumps(file))
    file["scenarios"][0]["q_cmd"][100][3] += 1e-8
    other.write_text(json.dumps(file))
    assert main(same) == 0
    assert main(other) == 1


@settings(max_examples=10, deadline=None)
@given(arrays(float, 6, elements=st.floats(-1.0, 1.0)), st.integers(0, 1000))
def test_a_steady_wrench_deflects_by_its_compliance(push: Array, seed: int) -> None:
    stiffness = _random_inputs(seed, 1)[0][2]
    fdcc = Fdcc(ARM, HOME, FdccConfig(error_scale=0.5))
    q = _settle(fdcc, 5000, AT_HOME, stiffness, push * (5.0, 5.0, 5.0, 0.5, 0.5, 0.5))
    now = ARM.forward_kinematics(q)
    deflection = now.position - AT_HOME.position
    turn = rotation_vector(multiply_quaternions(now.wxyz, AT_HOME.inverse().wxyz))
    # In TCP axes, as the stiffness is: K times deflection is the wrench, whatever p and error_scale are.
    force = stiffness.translational @ now.rotation.T @ deflection
    torque = stiffness.rotational @ now.rotation.T @ turn
    # A millionth of a metre or radian may be left, which is KDL's dead zone.
    np.testing.assert_allclose(force, push[:3] * 5.0, atol=2e-6 * np.abs(stiffness.translational).max())
    np.testing.assert_allclose(torque, push[3:] * 0.5, atol=2e-6 * np.abs(stiffness.rotational).max())


def test_a_target_is_reached_without_wrench() -> None:
    target = _moved(AT_HOME, np.array([0.03, -0.02, 0.05]), np.array([0.2, 0.1, -0.3]))
    reached = ARM.forward_kinematics(_settle(Fdcc(ARM, HOME), 5000, target, STIFFNESS))
    np.testing.assert_allclose(reached.position, target.position, atol=2e-6)
    np.testing.assert_allclose(reached.rotation, target.rotation, atol=2e-6)


@pytest.mark.parametrize("is_commanded", [True, False])
def test_restoring_continues_to_the_bit(is_commanded: bool) -> None:
    config = FdccConfig(d_gains=(0.01, 0.0, 0.0, 0.0, 0.02, 0.0), iterations=2)
    first, second = Fdcc(ARM, HOME, config), Fdcc(ARM, np.zeros(6), config)

    def run(fdcc: Fdcc, seed: int) -> list[bytes]:
        commands = []
        for measured, target, stiffness, sensed, pull in _random_inputs(seed, 60):
            feedback = fdcc.q if is_commanded else measured
            commands.append(fdcc.step(feedback, target, stiffness, sensed, pull).tobytes())
        return commands

    run(first, seed=1)
    second.step(HOME, AT_HOME, STIFFNESS)  # another past
    state = first.state()
    assert state.dtype == np.float64
    second.restore(state)
    assert second.state().tobytes() == state.tobytes()
    assert run(second, seed=2) == run(first, seed=2)
    assert second.state().tobytes() == first.state().tobytes()


def test_a_state_of_another_arm_is_refused() -> None:
    with pytest.raises(ValueError, match=r"6 joints has shape \(18,\), not \(16,\)"):
        Fdcc(ARM, HOME).restore(np.zeros(16))


def test_full_blocks_are_a_diagonal_in_turned_axes() -> None:
    """C turned against the TCP with a diagonal equals C at the TCP with the turned blocks."""
    turn = Pose(np.zeros(3), quaternion_from_rotation_vector(np.array([0.5, -0.8, 1.1])))
    turned_arm = ArmModel(
        ARM.base, (*ARM.segments[:-1], Segment("compliance", TOOL @ turn), Segment(TCP, turn.inverse()))
    )
    r = turn.rotation
    blocks = [r @ block @ r.T for block in (STIFFNESS.translational, STIFFNESS.rotational)]
    full = Stiffness(*((block + block.T) / 2.0 for block in blocks))
    with_blocks = Fdcc(ARM, HOME, sensor_frame=FLANGE)
    with_diagonal = Fdcc(turned_arm, HOME, compliance_frame="compliance", sensor_frame=FLANGE)
    for _, target, _, sensed, _ in _random_inputs(3, 100):
        a = with_blocks.step(with_blocks.q, target, full, sensed)
        b = with_diagonal.step(with_diagonal.q, target, STIFFNESS, sensed)
        np.testing.assert_allclose(a, b, atol=1e-13)


def test_a_wrench_at_the_flange_is_one_at_the_tcp_with_its_lever() -> None:
    force, torque = PUSH[:3], PUSH[3:]
    lever = TOOL.inverse().position  # TCP to flange, both in the same axes here
    at_tcp = np.concatenate((force, torque + np.cross(lever, force)))
    at_flange_sensor, at_tcp_sensor = Fdcc(ARM, HOME, sensor_frame=FLANGE), Fdcc(ARM, HOME)
    for _ in range(50):
        a = at_flange_sensor.step(at_flange_sensor.q, AT_HOME, STIFFNESS, PUSH)
        b = at_tcp_sensor.step(at_tcp_sensor.q, AT_HOME, STIFFNESS, at_tcp)
        np.testing.assert_allclose(a, b, atol=1e-14)


def test_a_target_wrench_acts_like_a_sensed_one() -> None:
    sensed = Fdcc(ARM, HOME)
    in_hand = Fdcc(ARM, HOME, FdccConfig(hand_frame_control=True))
    in_base = Fdcc(ARM, HOME)
    for _ in range(50):
        rotation = ARM.forward_kinematics(in_base.q).rotation
        turned = np.concatenate((rotation @ PUSH[:3], rotation @ PUSH[3:]))
        a = sensed.step(sensed.q, AT_HOME, STIFFNESS, PUSH)
        b = in_hand.step(in_hand.q, AT_HOME, STIFFNESS, None, PUSH)
        c = in_base.step(in_base.q, AT_HOME, STIFFNESS, None, turned)
        np.testing.assert_allclose(b, a, atol=1e-14)
        np.testing.assert_allclose(c, a, atol=1e-14)


def test_cycles_of_one_iteration_are_one_cycle_of_many_when_fed_with_commands() -> None:
    one, three = Fdcc(ARM, HOME), Fdcc(ARM, HOME, FdccConfig(iterations=3))
    target = _moved(AT_HOME, np.array([0.1, 0.0, 0.0]), np.zeros(3))
    for _ in range(20):
        assert three.step(three.q, target, STIFFNESS, PUSH).tobytes() == (
            _settle(one, 3, target, STIFFNESS, PUSH).tobytes()
        )


def test_the_velocity_moves_the_next_command() -> None:
    fdcc = Fdcc(ARM, HOME)
    first = fdcc.step(HOME, AT_HOME, STIFFNESS, PUSH)
    np.testing.assert_array_equal(first, HOME)  # the force of a step moves the position one step later
    velocity = fdcc.velocity
    assert np.abs(velocity).max() > 0.0
    second = fdcc.step(first, AT_HOME, STIFFNESS, PUSH)
    np.testing.assert_allclose(second, HOME + 0.02 * velocity, atol=1e-15)


def test_the_pose_error_starts_from_the_last_command() -> None:
    """Feedback away from the command, target on the command: nothing pulls."""
    fdcc = Fdcc(ARM, HOME)
    fdcc.step(HOME + 0.01, AT_HOME, STIFFNESS)
    np.testing.assert_array_equal(fdcc.velocity, np.zeros(6))  # from the feedback's pose it would not be zero


@pytest.mark.parametrize("n_segments", [6, 8])  # ends at a moving link, which is replaced; at the tool
def test_the_virtual_arm_weighs_at_its_link_origins(n_segments: int) -> None:
    """H is the sum of m Jv^T Jv + I Jw^T Jw over the moving links and the end effector."""
    arm = ArmModel(ARM.base, ARM.segments[:n_segments])
    expected = np.zeros((6, 6))
    for k, segment in enumerate(arm.segments, start=1):
        is_end = k == n_segments
        if is_end or segment.axis is not None:
            jacobian = ArmModel(arm.base, arm.segments[:k]).jacobian(HOME[:k])
            mass, inertia = (1.0, 1.0) if is_end else (0.3, 1e-6)
            padded = np.pad(jacobian, ((0, 0), (0, 6 - jacobian.shape[1])))
            expected += mass * padded[:3].T @ padded[:3] + inertia * padded[3:].T @ padded[3:]
    model = virtual_arm(arm, link_mass=0.3)
    inertia_matrix = np.triu(pin.crba(model, model.createData(), HOME))
    np.testing.assert_allclose(inertia_matrix, np.triu(expected), atol=1e-12)


@settings(max_examples=20, deadline=None)
@given(arrays(float, 3, elements=st.floats(-3.0, 3.0)), arrays(float, 3, elements=st.floats(-3.0, 3.0)))
def test_joints_stay_within_their_limits(translation: Array, turn: Array) -> None:
    fdcc = Fdcc(ARM, HOME, FdccConfig(error_scale=1.0))
    target = _moved(AT_HOME, translation, turn)
    for _ in range(300):
        q = fdcc.step(fdcc.q, target, STIFFNESS)
        assert np.all((ARM.lower <= q) & (q <= ARM.upper))


def test_a_limit_stops_a_joint_but_not_its_velocity() -> None:
    at_limit = np.array([*HOME[:5], ARM.upper[5] - 0.01])
    fdcc = Fdcc(ARM, at_limit)
    target = _moved(ARM.forward_kinematics(at_limit), np.zeros(3), np.array([0.0, 0.0, -0.5]))
    q = _settle(fdcc, 300, target, STIFFNESS)
    assert q[5] == ARM.upper[5]
    assert fdcc.velocity[5] > 0.01


def test_errors_are_clamped_at_a_metre_and_a_radian() -> None:
    def velocity(translation: list[float], turn: list[float]) -> Array:
        fdcc = Fdcc(ARM, HOME)
        fdcc.step(HOME, _moved(AT_HOME, np.array(translation), np.array(turn)), STIFFNESS)
        return fdcc.velocity

    far, near = velocity([0.0, 3.0, 4.0], [0.0, 0.0, 3.0]), velocity([0.0, 0.6, 0.8], [0.0, 0.0, 1.0])
    np.testing.assert_allclose(far, near, atol=1e-13)
    assert np.abs(near - velocity([0.0, 0.54, 0.72], [0.0, 0.0, 0.9])).max() > 1e-3


@pytest.mark.parametrize("near_pi", [np.pi, np.pi - 1e-8, np.pi - 1e-5, np.pi + 1e-5])
def test_half_a_turn_is_taken_the_short_way(near_pi: float) -> None:
    axis = np.array([0.8, 0.0, -0.6])
    fdcc, by_one_radian = Fdcc(ARM, HOME), Fdcc(ARM, HOME)
    fdcc.step(HOME, _moved(AT_HOME, np.zeros(3), near_pi * axis), STIFFNESS)
    sign = -1.0 if near_pi > np.pi else 1.0
    by_one_radian.step(HOME, _moved(AT_HOME, np.zeros(3), sign * axis), STIFFNESS)
    np.testing.assert_allclose(fdcc.velocity, by_one_radian.velocity, atol=1e-9)


@pytest.mark.parametrize(("error", "moves"), [(5e-7, False), (2e-6, True)])
def test_errors_below_the_dead_zone_count_as_zero(error: float, moves: bool) -> None:
    fdcc = Fdcc(ARM, HOME)
    fdcc.step(HOME, _moved(AT_HOME, np.array([0.0, error, 0.0]), np.array([0.0, 0.0, error])), STIFFNESS)
    assert bool(np.any(fdcc.velocity)) == moves


@pytest.mark.parametrize("broken", ["joints", "target", "sensor", "target wrench"])
def test_what_is_not_finite_is_refused_and_forgotten(broken: str) -> None:
    fdcc = Fdcc(ARM, HOME)
    _settle(fdcc, 10, AT_HOME, STIFFNESS, PUSH)
    before = fdcc.state()
    bad = np.array([0.0, 0.0, np.nan, 0.0, 0.0, 0.0])
    with pytest.raises(FloatingPointError, match="not finite"):
        fdcc.step(
            fdcc.q + bad if broken == "joints" else fdcc.q,
            Pose(AT_HOME.position + np.inf, AT_HOME.wxyz) if broken == "target" else AT_HOME,
            STIFFNESS,
            bad if broken == "sensor" else None,
            bad if broken == "target wrench" else None,
        )
    assert fdcc.state().tobytes() == before.tobytes()
    other = Fdcc(ARM, HOME)
    other.restore(before)
    expected = other.step(other.q, AT_HOME, STIFFNESS, PUSH)
    np.testing.assert_array_equal(fdcc.step(fdcc.q, AT_HOME, STIFFNESS, PUSH), expected)


def test_the_velocity_is_limited_along_its_direction() -> None:
    fdcc = Fdcc(ARM, HOME)
    _settle(fdcc, 50, _moved(AT_HOME, np.array([0.1, 0.1, 0.1]), np.zeros(3)), STIFFNESS)
    velocity = fdcc.velocity
    fastest = float(np.abs(velocity).max())
    assert not fdcc.limit_velocity([fastest] * 6)
    assert fdcc.limit_velocity([fastest / 4.0] * 6)
    np.testing.assert_allclose(fdcc.velocity, velocity / 4.0, rtol=1e-14)


def test_gains_change_without_a_jump() -> None:
    fdcc = Fdcc(ARM, HOME)
    _settle(fdcc, 10, AT_HOME, STIFFNESS, PUSH)
    before = fdcc.state()
    fdcc.configure(replace(fdcc.config, error_scale=0.8, link_mass=0.5))
    assert fdcc.state().tobytes() == before.tobytes()


def test_a_start_beyond_the_limits_is_brought_within() -> None:
    fdcc = Fdcc(ARM, np.full(6, 100.0))
    np.testing.assert_array_equal(fdcc.q, ARM.upper)


@pytest.mark.parametrize(
    ("build", "reason"),
    [
        (lambda: FdccConfig(p_gains=(1.0, 1.0, 1.0)), "p_gains must be six"),  # type: ignore[arg-type]
        (lambda: FdccConfig(d_gains=(0.0, 0.0, 0.0, 0.0, 0.0, -1.0)), "d_gains must be six numbers >= 0"),
        (lambda: FdccConfig(error_scale=float("nan")), "error_scale must be >= 0, not nan"),
        (lambda: FdccConfig(iterations=0), "iterations must be at least 1"),
        (lambda: FdccConfig(internal_dt=0.0), "internal_dt must be above 0 s"),
        (lambda: FdccConfig(damping=1.1), r"0\.\.1, not 1.1"),
        (lambda: FdccConfig(link_mass=-0.1), "link_mass must be above 0 kg"),
    ],
)
def test_a_bad_config_is_refused_with_its_reason(build: Callable[[], FdccConfig], reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        build()


@pytest.mark.verify
def test_a_step_takes_at_most_four_times_the_bare_calls() -> None:
    assert min(measure(2000)["ratio"] for _ in range(3)) <= 4.0
