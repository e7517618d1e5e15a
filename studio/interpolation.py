"""Values at a time between recorded ones."""

from __future__ import annotations

import numpy as np

from controller.types import Array

NANOSECOND = 1e-9  # [s] to which recorded times are told


def newest(times: Array, time: float) -> int:
    """Index of the last of rising `times` at or before `time`, else of the first."""
    return max(int(np.searchsorted(times, time + NANOSECOND, side="right")) - 1, 0)


def between(times: Array, time: float) -> tuple[int, int, float]:
    """The two of rising `times` around `time`, and the second's share; clamped at both ends."""
    second = int(np.searchsorted(times, time, side="right"))
    if second == 0 or second == len(times):
        end = max(second - 1, 0)
        return end, end, 0.0
    first = second - 1
    return first, second, float((time - times[first]) / (times[second] - times[first]))


def blend(first: Array, second: Array, share: float) -> Array:
    """`first` to the bit where the share is 0."""
    blended: Array = first + share * (second - first)
    return blended


def blend_poses(first: Array, second: Array, share: float) -> Array:
    """(7,) position, wxyz; the quaternion the short way round."""
    if share == 0.0:
        return first
    towards = np.concatenate((second[:3], second[3:] * (1.0 if first[3:] @ second[3:] >= 0.0 else -1.0)))
    pose = blend(first, towards, share)
    pose[3:] /= np.linalg.norm(pose[3:])
    return pose
