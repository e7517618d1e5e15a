"""The twin: exact repetition, honest forces, quick and quiet compliance."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from controller.servo import ServoConfig
from controller.stiffness import stiffness_of
from controller.types import (
    ARM_ROW,
    Action,
    ArmAction,
    ArmState,
    CartesianTarget,
    Hold,
    JointTarget,
    Pose,
    Release,
    Snapshot,
    StiffnessMode,
    Target,
    multiply_quaternions,
    quaternion_from_rotation_vector,
)
from studio import tasks
from studio.benchmarks import two_arms
from studio.benchmarks.contact import free_step, press, twin_with
from studio.inputs.scripted import ScriptedAgent
from studio.session import Session
from studio.tasks.wiping import BOARD_CENTER
from studio.twin import GRAVITY, Twin

ROOT = Path(__file__).parent.parent
LOW, HIGH = stiffness_of(StiffnessMode.LOW), stiffness_of(StiffnessMode.HIGH)
RISES = {"low": 0.50, "medium": 0.28, "high": 0.20}  # [s] at most


def run(twin: Twin, *targets: Target, seconds: float = 1.0) -> ArmState:
    """Command each arm one target for a while; the first arm's state then."""
    for _ in range(round(seconds * 100)):
        twin.apply(Action(tuple(ArmAction(target, 0.0) for target in targets)))
    return twin.observe().arms[0]


def start_pose(twin: Twin, seed: int = 0) -> Pose:
    twin.reset(seed)
    return twin.observe().arms[0].base_from_tcp


def on_board(depth: float, wxyz: np.ndarray) -> Pose:
    return Pose(BOARD_CENTER - np.array([0.0, 0.0, depth]), wxyz)


def pressing(twin: Twin) -> CartesianTarget:
    """Bring a reset twin into contact."""
    start = start_pose(twin)
    target = CartesianTarget(on_board(0.01, start.wxyz), LOW)
    state = run(twin, target, seconds=2.0)
    assert state.wrench.force[2] > 2.0
    return target


def wipe(twin: Twin, ticks: int) -> Iterator[bytes]:
    """Digests of the next ticks, with a target that moves on the board."""
    wxyz = twin.observe().arms[0].base_from_tcp.wxyz
    for tick in range(ticks):
        pose = on_board(0.01, wxyz)
        target = CartesianTarget(Pose(pose.position + np.array([0.0, 0.0005 * tick, 0.0]), wxyz), LOW)
        twin.apply(Action((ArmAction(target, 0.0),)))
        yield twin.digest()


# Repetition


def test_the_same_seed_gives_the_same_state_and_another_seed_another(twin: Twin) -> None:
    digests = []
    for seed in (3, 4, 3):
        twin.reset(seed)
        digests.append([twin.digest(), *wipe(twin, 20)])
    assert digests[0] == digests[2]
    assert not set(digests[0]) & set(digests[1])


def test_a_wider_spread_draws_other_scenes(twin: Twin) -> None:
    twin.reset(3)
    plain = twin.digest()
    twin.reset(3, spread=1.5)
    assert twin.digest() != plain
    with pytest.raises(ValueError, match="above 0"):
        twin.reset(3, spread=0.0)


def test_a_restored_twin_goes_on_to_the_bit_in_contact(twin: Twin) -> None:
    pressing(twin)
    snapshot = twin.save()
    expected = list(wipe(twin, 100))
    twin.reset(5)
    twin.restore(snapshot)
    assert list(wipe(twin, 100)) == expected
    fresh = Twin(tasks.load("wiping"))
    fresh.restore(snapshot)
    assert list(wipe(fresh, 100)) == expected


def test_a_restored_twin_goes_on_to_the_bit_in_another_process(twin: Twin, tmp_path: Path) -> None:
    pressing(twin)
    np.savez(tmp_path / "snapshot.npz", **twin.save().arrays)
    program = f"""
import numpy as np
from controller.types import Snapshot
from studio import tasks
from studio.twin import Twin
from tests.test_twin import wipe
twin = Twin(tasks.load("wiping"))
twin.restore(Snapshot(dict(np.load({str(tmp_path / "snapshot.npz")!r}))))
print(*[digest.hex() for digest in wipe(twin, 100)])
"""
    told = subprocess.run(
        [sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True
    )
    assert told.stdout.split() == [digest.hex() for digest in wipe(twin, 100)]


def test_looking_at_a_twin_changes_nothing(twin: Twin) -> None:
    pressing(twin)
    snapshot = twin.save()
    expected = list(wipe(twin, 30))
    twin.restore(snapshot)
    watched = []
    for digest in wipe(twin, 30):
        watched.append(digest)
        twin.observe(), twin.progress(), twin.task_state(), twin.save()
    assert watched == expected


def test_a_snapshot_of_another_task_is_refused(twin: Twin) -> None:
    other = Twin(tasks.load(two_arms.Task.name))
    with pytest.raises(ValueError, match="another task"):
        twin.restore(Snapshot(other.save().arrays))


def test_an_action_for_two_arms_is_refused_by_one(twin: Twin) -> None:
    with pytest.raises(ValueError, match="2 arm actions for 1 arms"):
        twin.apply(Action((ArmAction(Hold(), 0.0),) * 2))


# Contact


@pytest.mark.parametrize("mode", StiffnessMode)
def test_a_press_is_stiffness_times_depth(twin: Twin, mode: StiffnessMode) -> None:
    pressed = press(twin, mode)
    assert pressed.to_law == pytest.approx(1.0, abs=0.03)
    assert pressed.to_depth == pytest.approx(1.0, abs=0.10)
    assert pressed.std_N < 0.1
    assert pressed.slip_mm < 0.1


@pytest.mark.parametrize("mode", [StiffnessMode.LOW, StiffnessMode.HIGH])
def test_a_press_stays_quiet_at_twice_the_error_scale(mode: StiffnessMode) -> None:
    shipped = ServoConfig()
    doubled = replace(shipped, fdcc=replace(shipped.fdcc, error_scale=2.0 * shipped.fdcc.error_scale))
    assert press(twin_with(doubled), mode, place=(0.60, 0.12)).std_N < 0.1


def test_joint_position_control_presses_many_times_harder(twin: Twin) -> None:
    stiff, compliant = press(twin, StiffnessMode.HIGH, by_joints=True), press(twin, StiffnessMode.HIGH)
    assert stiff.mean_N > 5 * compliant.mean_N


@pytest.mark.parametrize("mode", StiffnessMode)
@pytest.mark.parametrize("axis", [0, 2])
def test_a_free_step_rises_in_time(twin: Twin, mode: StiffnessMode, axis: int) -> None:
    rise = free_step(twin, mode, np.eye(3, 6)[axis] * 0.02)
    assert rise.rise_s <= RISES[mode.value]
    assert rise.overshoot < 0.05


def test_two_arms_push_each_other_with_the_same_force() -> None:
    twin = Twin(tasks.load(two_arms.Task.name))
    ending = Session(twin).run(ScriptedAgent(twin, 0), time_limit=4.0)
    assert ending.progress.success
    left, right = (arm.wrench.force[1] for arm in twin.observe().arms)
    assert left == pytest.approx(-right, rel=0.01)
    assert left == pytest.approx(0.01 * 750 * 250 / 1000, rel=0.1)  # 750 and 250 N/m in series over 10 mm


# Force and torque


def test_a_mass_that_the_sensor_does_not_know_of_reads_its_weight() -> None:
    twin = Twin(tasks.load("wiping"))
    pose = start_pose(twin)
    twin.model.body("eraser").mass += 0.3
    state = run(twin, CartesianTarget(pose, HIGH), seconds=1.5)
    np.testing.assert_allclose(state.wrench.force, [0.0, 0.0, -0.3 * GRAVITY], atol=0.01)


@pytest.mark.parametrize("axis", [0, 1])
def test_hand_and_eraser_weigh_nothing_however_the_tool_tilts(twin: Twin, axis: int) -> None:
    start = start_pose(twin)
    tilt = quaternion_from_rotation_vector(np.radians(20.0) * np.eye(3)[axis])
    target = CartesianTarget(Pose(start.position, multiply_quaternions(tilt, start.wxyz)), HIGH)
    state = run(twin, target, seconds=2.0)
    # With the hand only tared, its 1.1 kg would read 3.7 N across and 0.5 N·m.
    np.testing.assert_allclose(state.wrench.force, 0.0, atol=0.02)
    np.testing.assert_allclose(state.wrench.torque, 0.0, atol=0.01)


def test_a_push_off_the_centre_is_a_torque_about_the_tcp(twin: Twin) -> None:
    pose = start_pose(twin)
    eraser = twin.model.body("eraser").id
    twin.data.xfrc_applied[eraser, :3] = [0.0, 2.0, 0.0]  # on the eraser's centre of mass, 26.5 mm above
    state = run(twin, CartesianTarget(pose, HIGH), seconds=1.5)
    twin.data.xfrc_applied[:] = 0.0
    np.testing.assert_allclose(state.wrench.force, [0.0, 2.0, 0.0], atol=0.02)
    np.testing.assert_allclose(state.wrench.torque, [-0.0265 * 2.0, 0.0, 0.0], atol=0.005)


# Commands


def test_joint_targets_are_followed_stiffly(twin: Twin) -> None:
    twin.reset(0)
    q = twin.observe().arms[0].q_command + np.array([0.1, -0.05, 0.05, 0.0, 0.1, -0.2])
    state = run(twin, JointTarget(q), seconds=2.0)
    np.testing.assert_allclose(state.q, q, atol=1e-4)


def test_hold_keeps_pressing_and_release_lets_go(twin: Twin) -> None:
    pressing(twin)
    held = run(twin, Hold(), seconds=1.0).wrench.force[2]
    assert held == pytest.approx(2.36, abs=0.05)
    assert run(twin, Release(), seconds=2.0).wrench.force[2] < 0.5


def test_a_refused_target_stops_one_arm_and_not_the_other() -> None:
    twin = Twin(tasks.load(two_arms.Task.name))
    left, right = (arm.base_from_tcp for arm in twin.observe().arms)
    bad = CartesianTarget(Pose(np.full(3, np.nan), left.wxyz), LOW)
    up = CartesianTarget(Pose(right.position + np.array([0.0, 0.0, 0.05]), right.wxyz), HIGH)
    for _ in range(150):
        applied = twin.apply(Action((ArmAction(bad, 0.0), ArmAction(up, 0.0))))
    (limit,) = applied.limits
    assert (limit.arm, limit.kind, limit.refused) == (0, "not_finite", True)
    now = [arm.base_from_tcp.position for arm in twin.observe().arms]
    np.testing.assert_allclose(now[0], left.position, atol=1e-4)
    np.testing.assert_allclose(now[1], up.base_from_target.position, atol=1e-3)


def test_a_trace_begins_as_observed_and_leaves_no_gap(twin: Twin) -> None:
    pressing(twin)
    times = []
    for _ in range(5):
        observed = twin.observe().arms[0]
        trace = twin.apply(Action((ArmAction(Hold(), 0.0),))).trace[0]
        first = ArmState.from_row(trace[0])
        assert (first.time, first.q.tolist()) == (observed.time, observed.q.tolist())
        times += trace[:, ARM_ROW["time"]].ravel().tolist()
    np.testing.assert_allclose(np.diff(times), 0.002)
