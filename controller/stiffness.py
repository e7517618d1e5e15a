"""The stiffness modes as numbers, and the bounds that the controller accepts.

The paper gives 250, 500 and 750 for low, medium and high, "the same value on all diagonals". Taken literally
that mixes N/m and N·m/rad, and 750 N·m/rad overshoots by a quarter with the rotational gain that suits the
translation. So two tables exist: `tuned`, our default, with rotational values that rise as fast as the
translation, and `literal`, the paper's numbers, which needs a smaller rotational gain (`ROTATIONAL_GAIN`).
"""

from __future__ import annotations

from functools import cache
from typing import Literal

import numpy as np

from controller.types import Array, Stiffness, StiffnessMode

StiffnessTable = Literal["tuned", "literal"]

# [N/m] and [N·m/rad] of each mode
_TABLES: dict[str, dict[StiffnessMode, tuple[float, float]]] = {
    "tuned": {
        StiffnessMode.LOW: (250.0, 20.0),
        StiffnessMode.MEDIUM: (500.0, 35.0),
        StiffnessMode.HIGH: (750.0, 50.0),
    },
    "literal": {
        StiffnessMode.LOW: (250.0, 250.0),
        StiffnessMode.MEDIUM: (500.0, 500.0),
        StiffnessMode.HIGH: (750.0, 750.0),
    },
}

# FDCC's p gain on rotations for each table: with it a rotation rises as fast as a translation.
ROTATIONAL_GAIN: dict[str, float] = {"tuned": 0.5, "literal": 0.035}

# What the controller accepts. The lower ends keep FDCC from stalling; above the upper ends the explicit
# integration of FDCC loses its stability margin in contact.
TRANSLATIONAL_BOUNDS = (50.0, 1200.0)  # [N/m]
ROTATIONAL_BOUNDS = (2.0, 1200.0)  # [N·m/rad]


@cache
def stiffness_of(mode: StiffnessMode, table: StiffnessTable = "tuned") -> Stiffness:
    """The stiffness of a mode: diagonal and isotropic."""
    translational, rotational = _TABLES[table][mode]
    return Stiffness.diagonal([translational] * 3 + [rotational] * 3)


def nearest_mode(stiffness: Stiffness, table: StiffnessTable = "tuned") -> StiffnessMode:
    """The mode whose translational stiffness is nearest to the mean of `stiffness`, for display."""
    mean = float(np.trace(stiffness.translational)) / 3
    return min(StiffnessMode, key=lambda mode: abs(_TABLES[table][mode][0] - mean))


def bounded(stiffness: Stiffness) -> Stiffness:
    """`stiffness` itself where its eigenvalues lie within the bounds, else with the eigenvalues clipped."""
    translational = _clip_eigenvalues(stiffness.translational, TRANSLATIONAL_BOUNDS)
    rotational = _clip_eigenvalues(stiffness.rotational, ROTATIONAL_BOUNDS)
    if translational is stiffness.translational and rotational is stiffness.rotational:
        return stiffness
    return Stiffness(translational, rotational)


def _clip_eigenvalues(block: Array, bounds: tuple[float, float]) -> Array:
    low, high = bounds
    values, vectors = np.linalg.eigh(block)
    if values[0] >= low and values[-1] <= high:
        return block
    clipped = (vectors * np.clip(values, low, high)) @ vectors.T
    return np.asarray((clipped + clipped.T) / 2)
