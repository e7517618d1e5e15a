"""Encoding states and targets: what is decoded is what was encoded, and always something a robot may do."""

from __future__ import annotations

import dataclasses
import json

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from controller.stiffness import bounded, stiffness_of
from controller.types import Stiffness, StiffnessMode
from policy.features import ArmStates, Encoding, Features, Targets, blocks_of
from policy.rotations import from_six_numbers, matrices, mean_rotation, nearest_branch

MODES = [stiffness_of(mode) for mode in StiffnessMode]


def about(axis: str, degrees: float | list[float] | np.ndarray) -> Rotation:
    """Turns about x or z."""
    vector = {"x": [1.0, 0.0, 0.0], "z": [0.0, 0.0, 1.0]}[axis]
    return Rotation.from_rotvec(np.deg2rad(degrees)[..., None] * np.array(vector))


def random_poses(rng: np.random.Generator, *shape: int) -> np.ndarray:
    """(*shape, 7)"""
    wxyz = rng.normal(size=(*shape, 4))
    return np.concatenate(
        (rng.normal(size=(*shape, 3)), wxyz / np.linalg.norm(wxyz, axis=-1, keepdims=True)), axis=-1
    )


def seen_and_targets(n_arms: int, rng: np.random.Generator) -> tuple[ArmStates, Targets]:
    """Of 5 moments with chunks of 7 steps; stiffness is that of modes."""
    seen = ArmStates(random_poses(rng, 5, n_arms), rng.normal(size=(5, n_arms, 6)), rng.random((5, n_arms)))
    drawn = rng.integers(3, size=(5, 7, n_arms))
    blocks = np.array([[k.translational, k.rotational] for k in MODES])[drawn]
    return seen, Targets(
        gripper=rng.random((5, 7, n_arms)),
        base_from_target=random_poses(rng, 5, 7, n_arms),
        stiffness=blocks,
        q=rng.normal(size=(5, 7, n_arms, 6)),
    )


def fitted(encoding: Encoding, seen: ArmStates, targets: Targets) -> Features:
    states, actions = encoding.state(seen), encoding.action(targets, seen)
    wrenches = np.random.default_rng(1).normal(size=(9, encoding.n_arms, 6))
    return Features.fit(encoding, states, actions.reshape(-1, actions.shape[-1]), wrenches)


@pytest.mark.parametrize("n_arms", [1, 2])
@pytest.mark.parametrize("frame", ["relative", "absolute"])
@pytest.mark.parametrize("rotation", ["6d", "axis-angle"])
@pytest.mark.parametrize("stiffness", ["log-diagonal", "cholesky", "mode"])
def test_decoding_inverts_encoding(n_arms: int, frame: str, rotation: str, stiffness: str) -> None:
    seen, targets = seen_and_targets(n_arms, np.random.default_rng(0))
    encoding = Encoding(n_arms, "cartesian", frame, rotation, stiffness, branch=((2.2, 2.2, 0.1),) * n_arms)
    features = fitted(encoding, seen, targets)
    values = features.encode_action(targets, seen)
    assert values.shape == (5, 7, encoding.action_width)
    decoded = features.decode_action(values, seen)
    np.testing.assert_allclose(
        decoded.base_from_target[..., :3], targets.base_from_target[..., :3], atol=1e-9
    )
    np.testing.assert_allclose(
        matrices(decoded.base_from_target[..., 3:]), matrices(targets.base_from_target[..., 3:]), atol=1e-9
    )
    np.testing.assert_allclose(decoded.stiffness, targets.stiffness, rtol=1e-9)
    np.testing.assert_allclose(decoded.gripper, targets.gripper, atol=1e-12)


def test_how_two_tools_stand_to_each_other_does_not_depend_on_where_they_are() -> None:
    rng = np.random.default_rng(0)
    seen, _ = seen_and_targets(2, rng)
    plain, encoding = Encoding(2), Encoding(2, between=True)
    states = encoding.state(seen)
    np.testing.assert_array_equal(states[..., : encoding.own_width], plain.state(seen))
    assert states.shape[-1] == encoding.state_width == plain.state_width + 9
    moved = dataclasses.replace(seen, base_from_tcp=seen.base_from_tcp.copy())
    moved.base_from_tcp[..., :3] += [0.1, -0.2, 0.05]
    again = encoding.state(moved)
    np.testing.assert_allclose(again[..., -9:], states[..., -9:], atol=1e-12)
    # The last tool is where the first one is, and the way and the turn that are told.
    position = seen.base_from_tcp[..., 0, :3] + states[..., -9:-6]
    turn = from_six_numbers(states[..., -6:]) @ matrices(seen.base_from_tcp[..., 0, 3:])
    np.testing.assert_allclose(position, seen.base_from_tcp[..., 1, :3], atol=1e-12)
    np.testing.assert_allclose(turn, matrices(seen.base_from_tcp[..., 1, 3:]), atol=1e-9)


@pytest.mark.parametrize("frame", ["relative", "absolute"])
def test_decoding_inverts_encoding_of_joints(frame: str) -> None:
    seen, targets = seen_and_targets(2, np.random.default_rng(0))
    encoding = Encoding(2, "joint", frame)
    features = fitted(encoding, seen, targets)
    decoded = features.decode_action(features.encode_action(targets, seen), seen)
    np.testing.assert_allclose(decoded.q, targets.q, atol=1e-9)
    assert decoded.base_from_target is None
    assert encoding.action_width == encoding.state_width == 14


def test_an_action_of_the_paper_has_19_numbers_an_arm() -> None:
    paper = {"frame": "absolute", "rotation": "axis-angle", "stiffness": "cholesky"}
    assert Encoding(1, **paper).action_width == 19
    assert Encoding(2, **paper).action_width == 38
    assert Encoding(2, **paper).state_width == 14


def test_a_full_block_goes_through_cholesky() -> None:
    rng = np.random.default_rng(3)
    turn = Rotation.random(random_state=1).as_matrix()
    full = turn @ np.diag([100.0, 500.0, 900.0]) @ turn.T
    given_ = np.stack([(full + full.T) / 2, np.diag([20.0, 30.0, 40.0])])[None, None, None]
    seen = ArmStates(random_poses(rng, 1, 1), np.zeros((1, 1, 6)), np.zeros((1, 1)))
    targets = Targets(np.zeros((1, 1, 1)), random_poses(rng, 1, 1, 1), given_)
    encoding = Encoding(1, stiffness="cholesky")
    np.testing.assert_allclose(
        encoding.targets(encoding.action(targets, seen), seen).stiffness, given_, rtol=1e-9
    )


@settings(max_examples=60, deadline=None)
@given(
    numbers=st.lists(st.floats(-1e4, 1e4), min_size=22, max_size=22),
    stiffness=st.sampled_from(["log-diagonal", "cholesky", "mode"]),
    rotation=st.sampled_from(["6d", "axis-angle"]),
)
def test_any_numbers_decode_to_what_a_robot_may_do(
    numbers: list[float], stiffness: str, rotation: str
) -> None:
    encoding = Encoding(1, "cartesian", "relative", rotation, stiffness)
    seen = ArmStates(np.array([[0.3, 0.1, 0.2, 0.0, 1.0, 0.0, 0.0]]), np.zeros((1, 6)), np.zeros(1))
    decoded = encoding.targets(np.array(numbers)[None, : encoding.action_width], seen)
    blocks = decoded.stiffness[0, 0]
    given_ = Stiffness(*blocks)  # raises where a block is not symmetric positive definite
    assert bounded(given_) is given_
    turn = matrices(decoded.base_from_target[0, 0, 3:])
    np.testing.assert_allclose(turn @ turn.T, np.eye(3), atol=1e-6)
    assert 0.0 <= decoded.gripper[0, 0] <= 1.0


def test_absolute_axis_angle_does_not_jump_at_pi() -> None:
    # A tool that points down and trembles by a degree: the shortest vector would jump by 2 pi.
    down = about("x", 180)
    tremble = about("x", np.linspace(-1, 1, 21)) * down
    vectors = tremble.as_rotvec()
    assert np.abs(np.diff(vectors[:, 0])).max() > 6.0
    smooth = nearest_branch(vectors, vectors[0])
    assert np.abs(np.diff(smooth[:, 0])).max() < 0.01
    np.testing.assert_allclose(Rotation.from_rotvec(smooth).as_matrix(), tremble.as_matrix(), atol=1e-12)


def test_six_numbers_that_are_a_little_off_give_a_rotation() -> None:
    numbers = np.array([1.0, 0.1, 0.0, 0.2, 0.9, 0.1])
    turn = from_six_numbers(numbers)
    np.testing.assert_allclose(turn.T @ turn, np.eye(3), atol=1e-12)
    assert np.linalg.det(turn) == pytest.approx(1.0)


def test_the_mean_rotation_does_not_depend_on_signs() -> None:
    turns = about("z", [170, 180, 190]).as_quat()[:, [3, 0, 1, 2]]
    mean = mean_rotation(turns * np.array([[1], [-1], [1]]))
    assert abs(mean @ turns[1]) == pytest.approx(1.0)


def test_a_number_that_never_changes_stays_finite_and_exact() -> None:
    seen, targets = seen_and_targets(1, np.random.default_rng(0))
    still = Targets(np.full((5, 7, 1), 0.3), targets.base_from_target, targets.stiffness)
    encoding = Encoding(1)
    features = fitted(encoding, seen, still)
    values = features.encode_action(still, seen)
    assert np.isfinite(values).all()
    np.testing.assert_allclose(features.decode_action(values, seen).gripper, 0.3)


def test_features_are_the_same_after_json() -> None:
    seen, targets = seen_and_targets(2, np.random.default_rng(0))
    features = fitted(Encoding(2, branch=((0.1, 0.2, 0.3),) * 2), seen, targets)
    back = Features.from_json(json.loads(json.dumps(features.to_json())))
    assert back.encoding == features.encoding
    assert np.array_equal(back.encode_action(targets, seen), features.encode_action(targets, seen))


def test_stiffness_that_an_encoding_cannot_tell_is_refused() -> None:
    full = blocks_of(np.array([[500.0, 10, 0, 500, 0, 500, 35, 0, 0, 35, 0, 35]]))
    with pytest.raises(ValueError, match=r"off the diagonal.*use cholesky"):
        Encoding(1).check(full, "take x")
    Encoding(1, stiffness="cholesky").check(full, "take x")
    odd = blocks_of(np.array([[400.0, 0, 0, 400, 0, 400, 35, 0, 0, 35, 0, 35]]))
    with pytest.raises(ValueError, match=r"no mode; use log-diagonal"):
        Encoding(1, stiffness="mode").check(odd, "take x")
