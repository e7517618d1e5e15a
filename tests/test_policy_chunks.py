"""Executing chunks: between steps, from chunk to chunk, and averaged over many."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from controller.types import CartesianTarget, Hold, JointTarget
from policy.chunks import DECAY, ActionChunk, ArmChunk, ChunkExecutor

PERIOD = 0.05
STEPS = 40


def about(axis: str, degrees: float | list[float] | np.ndarray) -> Rotation:
    """Turns about x or z."""
    vector = {"x": [1.0, 0.0, 0.0], "z": [0.0, 0.0, 1.0]}[axis]
    return Rotation.from_rotvec(np.deg2rad(degrees)[..., None] * np.array(vector))


def chunk_at(
    time: float, x: float = 0.0, turn: float = 0.0, sign: float = 1.0, k: float = 500.0
) -> ActionChunk:
    """Moves along y at 0.1 m/s from time zero, at `x` [m], turned about z by `turn` [deg]."""
    y = 0.1 * (time + PERIOD * np.arange(STEPS))
    wxyz = sign * about("z", turn).as_quat()[[3, 0, 1, 2]]
    arm = ArmChunk(
        gripper=np.full(STEPS, 0.5),
        position=np.stack((np.full(STEPS, x), y, np.zeros(STEPS)), axis=1),
        wxyz=np.tile(wxyz, (STEPS, 1)),
        translational=np.tile(np.eye(3) * k, (STEPS, 1, 1)),
        rotational=np.tile(np.eye(3) * 35.0, (STEPS, 1, 1)),
    )
    return ActionChunk(time, PERIOD, (arm,))


def cartesian(executor: ChunkExecutor, time: float) -> CartesianTarget:
    target = executor.action(time).arms[0].target
    assert isinstance(target, CartesianTarget)
    return target


def test_before_the_first_chunk_the_arm_holds_and_keeps_its_hand() -> None:
    executor = ChunkExecutor(n_arms=1)
    executor.reset(gripper=(0.7,))
    (arm,) = executor.action(0.0).arms
    assert isinstance(arm.target, Hold)
    assert arm.gripper == 0.7
    assert executor.wants(0.0)
    assert executor.late == 0


@pytest.mark.parametrize("mode", ["replan", "ensemble"])
def test_actions_lie_between_steps(mode: str) -> None:
    executor = ChunkExecutor(mode, n_arms=1)
    executor.add(chunk_at(0.0))
    assert cartesian(executor, 0.025).base_from_target.position[1] == pytest.approx(0.0025)


@pytest.mark.parametrize(("mode", "every"), [("replan", 10), ("ensemble", 1)])
def test_the_policy_is_asked_after_some_steps(mode: str, every: int) -> None:
    executor = ChunkExecutor(mode, n_arms=1)
    executor.add(chunk_at(0.0))
    assert not executor.wants(every * PERIOD - 0.01)
    assert executor.wants(every * PERIOD)


def test_a_late_answer_is_joined_in_its_middle() -> None:
    executor = ChunkExecutor(n_arms=1)
    executor.add(chunk_at(0.0))
    executor.add(chunk_at(0.5, x=0.2))  # arrives 30 ms later
    pose = cartesian(executor, 0.53).base_from_target
    np.testing.assert_allclose(pose.position, [0.2, 0.053, 0.0], atol=1e-12)


@pytest.mark.parametrize("mode", ["replan", "ensemble"])
def test_past_the_end_the_last_target_is_held_and_counted(mode: str) -> None:
    executor = ChunkExecutor(mode, n_arms=1)
    executor.add(chunk_at(0.0))
    last = cartesian(executor, (STEPS - 1) * PERIOD).base_from_target.position
    assert executor.late == 0
    for late in (1, 2, 3):
        np.testing.assert_array_equal(cartesian(executor, 5.0 + late).base_from_target.position, last)
        assert executor.late == late


def test_an_older_chunk_is_dropped() -> None:
    executor = ChunkExecutor(n_arms=1)
    executor.add(chunk_at(1.0))
    executor.add(chunk_at(0.5, x=0.2))
    assert cartesian(executor, 1.0).base_from_target.position[0] == 0.0


def test_the_ensemble_is_the_weighted_mean_of_all_chunks() -> None:
    executor = ChunkExecutor("ensemble", n_arms=1)
    chunks = [
        chunk_at(n * PERIOD, x=float(n), turn=10.0 * n, sign=(-1.0) ** n, k=100.0 + n) for n in range(4)
    ]
    for chunk in chunks:
        executor.add(chunk)
    weights = np.exp(-DECAY * np.arange(4))  # the oldest first
    weights /= weights.sum()
    target = cartesian(executor, 3 * PERIOD)
    assert target.base_from_target.position[0] == pytest.approx(weights @ np.arange(4))
    assert target.base_from_target.position[1] == pytest.approx(0.1 * 3 * PERIOD)
    assert target.stiffness.translational[0, 0] == pytest.approx(weights @ (100.0 + np.arange(4)))
    turns = about("z", 10.0 * np.arange(4))
    mean = turns.mean(weights)  # signs of the quaternions differ; a plain mean would cancel them
    assert (Rotation.from_matrix(target.base_from_target.rotation) * mean.inv()).magnitude() < 1e-9


def test_the_ensemble_remembers_no_more_than_a_chunk() -> None:
    executor = ChunkExecutor("ensemble", n_arms=1)
    for n in range(200):
        executor.add(chunk_at(n * PERIOD))
        executor.action(n * PERIOD)
        assert len(executor._sums) <= STEPS + 1
    np.testing.assert_allclose(
        cartesian(executor, 200 * PERIOD).base_from_target.position[1], 0.1 * 200 * PERIOD
    )


@pytest.mark.parametrize("offset", [0.01, 0.03, 3.0])
def test_the_ensemble_joins_chunks_that_begin_between_its_steps(offset: float) -> None:
    executor = ChunkExecutor("ensemble", n_arms=1)
    executor.add(chunk_at(0.0))
    executor.add(chunk_at(offset))
    for time in (offset + 0.04, offset + 0.5):
        assert cartesian(executor, time).base_from_target.position[1] == pytest.approx(0.1 * time, abs=1e-3)


def test_quaternions_do_not_change_their_sign_on_the_way() -> None:
    executor = ChunkExecutor(n_arms=1)
    before = None
    for n, turn in enumerate(np.linspace(170, 190, 30)):  # w passes zero
        executor.add(chunk_at(n * 0.1, turn=turn))
        wxyz = cartesian(executor, n * 0.1).base_from_target.wxyz
        assert before is None or wxyz @ before > 0.99
        before = wxyz


def test_joints_are_commanded_as_joints() -> None:
    executor = ChunkExecutor("ensemble", n_arms=2)
    q = np.linspace(0, 1, STEPS)[:, None] * np.ones(6)
    executor.add(ActionChunk(0.0, PERIOD, (ArmChunk(np.zeros(STEPS), q=q),) * 2))
    for arm in executor.action(PERIOD).arms:
        assert isinstance(arm.target, JointTarget)
        np.testing.assert_allclose(arm.target.q, q[1])


def test_wrong_use_is_refused() -> None:
    with pytest.raises(ValueError, match="'replan' and 'ensemble'"):
        ChunkExecutor("average", n_arms=1)  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="at least 1"):
        ChunkExecutor(replan_every=0, n_arms=1)
    with pytest.raises(ValueError, match="1 arms for 2"):
        ChunkExecutor(n_arms=2).add(chunk_at(0.0))
