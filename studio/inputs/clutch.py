"""The clutch: what a hand does after it was engaged, the target does too, whatever device tracks the hand.

Poses of hand and target are given in one set of axes. The target moves by the hand's way times a scale and
turns as the hand turns, both since the moment of engagement, so that engaging moves nothing.
"""

from __future__ import annotations

import math

import numpy as np

from controller.types import Pose, multiply_quaternions

# Between two samples a tracked hand goes no further than this, nor faster; more is a tracking error.
MAX_JUMP = 0.06  # [m]
MAX_TURN = math.radians(25.0)
MAX_SPEED = 4.0  # [m/s]
MAX_TURN_RATE = 25.0  # [rad/s]

SCALES = (0.05, 5.0)  # of the target's way to the hand's
CONJUGATE = np.array([1.0, -1.0, -1.0, -1.0])


class Clutch:
    """Connects one hand to one target. It lets go by itself where the hand jumps; `why` then says so."""

    def __init__(self) -> None:
        self.why = ""  # it let go by itself; empty where it did not
        self._grip: _Grip | None = None
        self._hand = Pose.identity()  # newest sample
        self._at = 0.0

    @property
    def engaged(self) -> bool:
        return self._grip is not None

    def engage(self, hand: Pose, target: Pose, at: float, scale: float = 1.0) -> None:
        """From here on the target goes where `hand` leads it, beginning at `target`. `at`: any clock [s]."""
        self._grip = _Grip(hand, target, checked_scale(scale))
        self._hand, self._at, self.why = hand, at, ""

    def follow(self, hand: Pose, at: float, scale: float = 1.0) -> Pose | None:
        """The target for a new sample of the hand, taken at `at` [s]; None while not engaged.

        Another scale than before counts from the sample before on: changing it moves nothing either.
        """
        if self._grip is None:
            return None
        if jump := _jump(self._hand, hand, max(0.0, at - self._at)):
            self.release(jump)
            return None
        if scale != self._grip.scale:
            self._grip = _Grip(self._hand, self._grip.target_for(self._hand), checked_scale(scale))
        self._hand, self._at = hand, at
        return self._grip.target_for(hand)

    def release(self, why: str = "") -> None:
        """Let go; only `engage` takes hold again."""
        self._grip, self.why = None, why


class _Grip:
    """Where hand and target were when the clutch took hold."""

    def __init__(self, hand: Pose, target: Pose, scale: float) -> None:
        self.scale = scale
        self._hand, self._target = hand.position, target.position
        self._hand_from_target = multiply_quaternions(hand.wxyz * CONJUGATE, target.wxyz)

    def target_for(self, hand: Pose) -> Pose:
        wxyz = multiply_quaternions(hand.wxyz, self._hand_from_target)
        position = self._target + self.scale * (hand.position - self._hand)
        return Pose(position, wxyz / math.hypot(*wxyz.tolist()))


class Fader:
    """A trigger that takes an opening over only where both agree, so that engaging opens no hand."""

    AGREES = 0.05  # of the opening

    def __init__(self) -> None:
        self._has_taken_over = False
        self._asked: float | None = None

    def opening(self, asked: float, present: float) -> float:
        """What to command: `present`, until the trigger has asked for that or passed by it; then `asked`."""
        before, self._asked = self._asked, asked
        passed = before is not None and (before - present) * (asked - present) <= 0.0
        self._has_taken_over |= passed or abs(asked - present) <= self.AGREES
        return asked if self._has_taken_over else present


def checked_scale(scale: float) -> float:
    """Raises ValueError outside of `SCALES`, also for NaN."""
    low, high = SCALES
    if not low <= scale <= high:
        raise ValueError(f"A scale of {scale} is not possible; it goes from {low} to {high}.")
    return scale


def facing(head: Pose) -> float:
    """[rad] about z by which somebody who looks along x has turned; `head` has x ahead, y left, z up.

    Where the head is bent down or back, its top says where it faces.
    """
    ahead, up = head.rotation[:, 0], head.rotation[:, 2]
    level = ahead[:2] if math.hypot(*ahead[:2]) > 0.5 else -math.copysign(1.0, ahead[2]) * up[:2]
    return math.atan2(level[1], level[0])


def seen_from(pose: Pose, yaw: float) -> Pose:
    """A pose of the room in axes turned by `yaw` [rad] about z: x is where somebody faces."""
    c, s = math.cos(yaw), math.sin(yaw)
    x, y, z = pose.position.tolist()
    w, i, j, k = pose.wxyz.tolist()
    ch, sh = math.cos(yaw / 2), math.sin(yaw / 2)
    wxyz = np.array([ch * w + sh * k, ch * i + sh * j, ch * j - sh * i, ch * k - sh * w])
    return Pose(np.array([c * x + s * y, c * y - s * x, z]), wxyz)


def _jump(before: Pose, now: Pose, dt: float) -> str:
    """What is wrong with going from one sample to the next in `dt` [s]; empty where nothing is."""
    way = math.dist(before.position.tolist(), now.position.tolist())
    turn = 2.0 * math.acos(min(1.0, abs(float(before.wxyz @ now.wxyz))))
    if way <= max(MAX_JUMP, MAX_SPEED * dt) and turn <= max(MAX_TURN, MAX_TURN_RATE * dt):
        return ""  # NaN gets no further
    return f"The controller's pose jumped by {way * 100:.0f} cm and {math.degrees(turn):.0f}°."
