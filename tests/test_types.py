"""Laws of poses, rotations and stiffness."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from controller.types import (
    ARM_ROW_WIDTH,
    ArmState,
    Array,
    Pose,
    Stiffness,
    Wrench,
    quaternion_from_rotation_vector,
    quaternion_of,
    rotation_of,
    rotation_vector,
)

numbers = st.floats(-10.0, 10.0)
vectors = arrays(float, 3, elements=numbers)
axes = vectors.filter(lambda v: np.linalg.norm(v) > 1e-3).map(lambda v: v / np.linalg.norm(v))
turns = axes.flatmap(lambda axis: st.floats(0.0, np.pi - 1e-6).map(lambda angle: angle * axis))
poses = st.builds(lambda p, turn: Pose(p, quaternion_from_rotation_vector(turn)), vectors, turns)
blocks = arrays(float, (3, 3), elements=st.floats(-20.0, 20.0)).map(
    lambda a: _symmetrised(a @ a.T) + np.eye(3)
)


def _symmetrised(block: Array) -> Array:
    return np.asarray((block + block.T) / 2.0)


def _assert_same_pose(a: Pose, b: Pose, tolerance: float = 1e-12) -> None:
    np.testing.assert_allclose(a.position, b.position, atol=tolerance * 100)
    np.testing.assert_allclose(a.rotation, b.rotation, atol=tolerance)


@given(poses)
def test_inverse_of_inverse_is_the_pose(pose: Pose) -> None:
    _assert_same_pose(pose.inverse().inverse(), pose)
    _assert_same_pose(pose @ pose.inverse(), Pose.identity())


@given(poses, poses, poses)
def test_poses_chain_like_matrices(a: Pose, b: Pose, c: Pose) -> None:
    _assert_same_pose((a @ b) @ c, a @ (b @ c))
    _assert_same_pose((a @ b).inverse(), b.inverse() @ a.inverse())
    points = np.array([[1.0, 2.0, 3.0], [0.0, 0.0, 0.0]])
    np.testing.assert_allclose((a @ b).apply(points), a.apply(b.apply(points)), atol=1e-9)


@given(poses)
def test_a_pose_reads_back_to_the_bit(pose: Pose) -> None:
    assert Pose.from_vector(pose.vector).vector.tobytes() == pose.vector.tobytes()


@given(turns)
def test_rotation_vector_inverts_its_quaternion(turn: Array) -> None:
    np.testing.assert_allclose(rotation_vector(quaternion_from_rotation_vector(turn)), turn, atol=1e-13)
    np.testing.assert_allclose(rotation_of(quaternion_from_rotation_vector(turn)), pin.exp3(turn), atol=1e-13)


@given(axes, st.sampled_from([0.0, 1e-300, 1e-13, 1e-11, 1e-8, 1e-4, np.pi - 1e-4, np.pi - 1e-8, np.pi]))
def test_rotation_vector_is_exact_at_its_ends(axis: Array, angle: float) -> None:
    # By the arc cosine of the trace, an angle of 1e-8 would come out as 0 and pi - 1e-8 as pi.
    read = rotation_vector(quaternion_from_rotation_vector(angle * axis))
    assert np.linalg.norm(read) == pytest.approx(angle, rel=1e-12, abs=1e-15)
    if angle < np.pi:
        np.testing.assert_allclose(read, angle * axis, rtol=1e-9, atol=1e-15)


@given(axes, st.sampled_from([0.0, 1e-8, 1.0, np.pi - 1e-4, np.pi - 1e-8, np.pi]))
def test_quaternion_of_inverts_rotation_of(axis: Array, angle: float) -> None:
    rotation = rotation_of(quaternion_from_rotation_vector(angle * axis))
    np.testing.assert_allclose(rotation_of(quaternion_of(rotation)), rotation, atol=1e-14)


@given(axes, st.floats(3.2, 6.2))
def test_rotation_vector_takes_the_short_way(axis: Array, angle: float) -> None:
    read = rotation_vector(quaternion_from_rotation_vector(angle * axis))
    np.testing.assert_allclose(read, (angle - 2.0 * np.pi) * axis, atol=1e-12)


@pytest.mark.parametrize("wxyz", [[1.0, 0.0, 0.0, 0.01], [0.0, 0.0, 0.0, 0.0], [np.nan, 0.0, 0.0, 0.0]])
def test_a_pose_needs_a_unit_quaternion(wxyz: list[float]) -> None:
    with pytest.raises(ValueError, match="unit quaternion"):
        Pose(np.zeros(3), np.array(wxyz))


@given(blocks, blocks)
def test_stiffness_reads_back_to_the_bit(translational: Array, rotational: Array) -> None:
    stiffness = Stiffness(translational, rotational)
    again = Stiffness.from_vector(stiffness.vector)
    assert again.vector.tobytes() == stiffness.vector.tobytes()
    assert again.translational.tobytes() == translational.tobytes()
    assert again.rotational.tobytes() == rotational.tobytes()


def test_a_diagonal_is_the_special_case_of_blocks() -> None:
    stiffness = Stiffness.diagonal((250.0, 500.0, 750.0, 20.0, 35.0, 50.0))
    np.testing.assert_array_equal(stiffness.translational, np.diag([250.0, 500.0, 750.0]))
    np.testing.assert_array_equal(stiffness.diagonals, [250.0, 500.0, 750.0, 20.0, 35.0, 50.0])


@given(blocks, axes, st.floats(0.0, 100.0))
def test_stiffness_must_be_positive_definite(block: Array, axis: Array, deficit: float) -> None:
    along = axis @ block @ axis
    lowered = _symmetrised(block - (along + deficit + 1e-6 * along) * np.outer(axis, axis))
    with pytest.raises(ValueError, match="rotational stiffness must be positive definite"):
        Stiffness(block, lowered)  # axis @ lowered @ axis < 0


@pytest.mark.parametrize(
    ("block", "reason"),
    [
        (np.diag([500.0, 500.0, 0.0]), "positive definite"),
        (np.diag([-500.0, -500.0, 500.0]), "positive definite"),  # its determinant is positive
        (np.diag([500.0, np.nan, 500.0]), "finite"),
        (np.diag([500.0, np.inf, 500.0]), "finite"),
        (np.array([[500.0, 1.0, 0.0], [0.0, 500.0, 0.0], [0.0, 0.0, 500.0]]), "symmetric"),
    ],
)
def test_stiffness_is_refused_with_its_reason(block: Array, reason: str) -> None:
    with pytest.raises(ValueError, match=reason):
        Stiffness(block, np.eye(3))


def test_an_arm_state_reads_its_row() -> None:
    row = np.arange(float(ARM_ROW_WIDTH))
    row[19 + 3 : 19 + 7] = [0.5, 0.5, -0.5, 0.5]
    state = ArmState.from_row(row)
    unpacked = (
        [state.time],
        state.q,
        state.dq,
        state.q_command,
        state.base_from_tcp.vector,
        state.wrench.vector,
        [state.gripper],
    )
    np.testing.assert_array_equal(np.concatenate(unpacked), row)
    assert Wrench.from_vector(state.wrench.vector).force.tolist() == state.wrench.force.tolist()
