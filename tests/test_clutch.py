"""Laws of the clutch: engaging is the identity, only the way since then counts, a jump lets go."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from controller.types import Array, Pose, multiply_quaternions, quaternion_from_rotation_vector, rotation_of
from studio.inputs.clutch import MAX_JUMP, SCALES, Clutch, Fader, facing, seen_from
from studio.inputs.haptics import Haptics

numbers = st.floats(-1.0, 1.0)
vectors = st.tuples(numbers, numbers, numbers).map(np.array)
turns = vectors.map(lambda v: quaternion_from_rotation_vector(3.0 * v))
poses = st.builds(Pose, vectors, turns)
scales = st.floats(*SCALES)
steps = st.builds(  # small enough for a hand within one sample
    Pose, vectors.map(lambda v: 0.02 * v), vectors.map(lambda v: quaternion_from_rotation_vector(0.1 * v))
)


def moved(pose: Pose, step: Pose) -> Pose:
    """By a step in the room's axes."""
    wxyz = multiply_quaternions(step.wxyz, pose.wxyz)
    return Pose(pose.position + step.position, wxyz / np.linalg.norm(wxyz))


def assert_same(a: Pose | None, b: Pose | None) -> None:
    assert a is not None
    assert b is not None
    assert np.allclose(a.position, b.position, atol=1e-12)
    assert np.allclose(a.rotation, b.rotation, atol=1e-12)


def engaged(hand: Pose, target: Pose, scale: float = 1.0) -> Clutch:
    clutch = Clutch()
    clutch.engage(hand, target, 0.0, scale)
    return clutch


@given(poses, poses, scales)
def test_engaging_is_the_identity(hand: Pose, target: Pose, scale: float) -> None:
    assert_same(engaged(hand, target, scale).follow(hand, 0.01, scale), target)


@given(poses, poses, scales, st.lists(steps, max_size=8))
def test_only_where_the_hand_is_counts_and_not_its_way_there(
    hand: Pose, target: Pose, scale: float, way: list[Pose]
) -> None:
    wandering, straight = engaged(hand, target, scale), engaged(hand, target, scale)
    there = hand
    for n, step in enumerate(way):
        there = moved(there, step)
        wandering.follow(there, 0.01 * n, scale)
    assert_same(wandering.follow(there, 1.0, scale), straight.follow(there, 10.0, scale))


@given(poses, poses, poses, scales, steps, steps)
def test_the_order_of_moving_and_engaging_does_not_matter(
    hand: Pose, elsewhere: Pose, target: Pose, scale: float, first: Pose, second: Pose
) -> None:
    """What a hand does with the clutch open leaves no trace: going on from a new grip is going on."""
    once = engaged(hand, target, scale)
    whole = once.follow(moved(moved(hand, first), second), 1.0, scale)
    twice = engaged(hand, target, scale)
    halfway = twice.follow(moved(hand, first), 0.01, scale)
    twice.release()
    assert twice.follow(elsewhere, 0.02, scale) is None
    assert halfway is not None
    twice.engage(elsewhere, halfway, 0.03, scale)
    assert_same(twice.follow(moved(elsewhere, second), 0.04, scale), whole)


@given(poses, poses, scales, steps)
def test_the_scale_acts_on_the_position_only(hand: Pose, target: Pose, scale: float, step: Pose) -> None:
    one = engaged(hand, target).follow(moved(hand, step), 0.01)
    scaled = engaged(hand, target, scale).follow(moved(hand, step), 0.01, scale)
    assert one is not None
    assert scaled is not None
    assert np.allclose(scaled.rotation, one.rotation, atol=1e-12)
    assert np.allclose(scaled.position - target.position, scale * (one.position - target.position))


@given(poses, poses, scales, scales, steps, steps)
def test_changing_the_scale_moves_nothing(
    hand: Pose, target: Pose, before: float, after: float, first: Pose, second: Pose
) -> None:
    clutch = engaged(hand, target, before)
    there = moved(hand, first)
    at_first = clutch.follow(there, 0.01, before)
    assert_same(clutch.follow(there, 0.02, after), at_first)
    end = clutch.follow(moved(there, second), 0.03, after)
    assert at_first is not None
    assert end is not None
    assert np.allclose(end.position - at_first.position, after * second.position, atol=1e-12)


@given(poses, poses, turns)
def test_a_jump_lets_go_and_says_why(hand: Pose, target: Pose, direction: Array) -> None:
    clutch = engaged(hand, target)
    leap = rotation_of(direction) @ np.array([1.5 * MAX_JUMP, 0.0, 0.0])
    jumped = Pose(hand.position + leap, hand.wxyz)
    assert clutch.follow(jumped, 1 / 90) is None
    assert not clutch.engaged
    assert "jumped by" in clutch.why
    assert clutch.follow(hand, 2 / 90) is None  # until it is engaged anew
    clutch.engage(jumped, target, 3 / 90)
    assert clutch.why == ""


def test_a_hand_that_was_not_seen_for_a_moment_may_be_further_away() -> None:
    hand = Pose.identity()
    away = Pose(np.array([0.2, 0.0, 0.0]), hand.wxyz)
    assert engaged(hand, hand).follow(away, 0.01) is None
    assert engaged(hand, hand).follow(away, 0.1) is not None


def test_turning_too_fast_or_nan_is_a_jump_too() -> None:
    hand = Pose.identity()
    turned = Pose(hand.position, quaternion_from_rotation_vector(np.array([0.0, 0.0, 1.0])))
    assert engaged(hand, hand).follow(turned, 0.01) is None
    assert engaged(hand, hand).follow(Pose(np.full(3, np.nan), hand.wxyz), 0.01) is None


@pytest.mark.parametrize("scale", [0.0, -1.0, 100.0, math.nan])
def test_an_impossible_scale_is_refused(scale: float) -> None:
    with pytest.raises(ValueError, match="it goes from"):
        engaged(Pose.identity(), Pose.identity(), scale)


@given(st.floats(-3.1, 3.1), st.floats(-1.5, 1.5), st.floats(-0.7, 0.7))
def test_ahead_is_where_the_head_faces_however_it_is_bent(yaw: float, pitch: float, roll: float) -> None:
    def turn(axis: Array, angle: float) -> Array:
        return quaternion_from_rotation_vector(angle * axis)

    x, y, z = np.eye(3)
    nod = multiply_quaternions(turn(y, pitch), turn(x, roll if abs(pitch) < 0.5 else 0.0))
    head = Pose(np.array([0.3, 0.1, 1.7]), multiply_quaternions(turn(z, yaw), nod))
    assert facing(head) == pytest.approx(yaw, abs=1e-9)
    a_step_ahead = Pose(np.array([math.cos(yaw), math.sin(yaw), 0.0]), turn(z, yaw))
    seen = seen_from(a_step_ahead, facing(head))
    assert seen.position == pytest.approx([1.0, 0.0, 0.0], abs=1e-9)
    assert np.allclose(seen.rotation, np.eye(3), atol=1e-9)


@given(poses, poses, st.floats(-3.1, 3.1), steps)
def test_where_a_person_faces_turns_the_motion_and_nothing_else(
    hand: Pose, target: Pose, yaw: float, step: Pose
) -> None:
    back = quaternion_from_rotation_vector(np.array([0.0, 0.0, -yaw]))
    turned = engaged(seen_from(hand, yaw), target).follow(seen_from(moved(hand, step), yaw), 0.01)
    assert turned is not None
    way = Pose(np.zeros(3), back).rotation @ step.position
    assert np.allclose(turned.position - target.position, way, atol=1e-12)


def test_a_trigger_takes_the_gripper_over_where_both_agree() -> None:
    fader = Fader()
    assert [fader.opening(asked, present=0.0) for asked in (1.0, 0.5, 0.2)] == [0.0, 0.0, 0.0]
    assert [fader.opening(asked, present=0.0) for asked in (0.04, 0.7)] == [0.04, 0.7]
    quick = Fader()
    assert quick.opening(0.9, present=0.5) == 0.5
    assert quick.opening(0.1, present=0.5) == 0.1  # it passed by


@given(st.floats(0.0, 300.0), st.floats(0.0, 300.0))
def test_a_harder_press_is_felt_no_less(light: float, hard: float) -> None:
    haptics = Haptics()
    one, other = (haptics.amplitude((0.0, newtons, 0.0)) for newtons in sorted((light, hard)))
    assert 0.0 <= one <= other <= 1.0


def test_vibration_begins_behind_the_dead_band_and_is_full_at_50_newtons() -> None:
    haptics = Haptics()
    felt = [haptics.amplitude((0.0, 0.0, newtons)) for newtons in (0.0, 3.0, 26.5, 50.0, 200.0)]
    assert felt == pytest.approx([0.0, 0.0, 0.5, 1.0, 1.0])
    assert Haptics(strength=0.5).amplitude((30.0, 0.0, 40.0)) == 0.5
    with pytest.raises(ValueError, match="dead band"):
        Haptics(dead_band=60.0)
