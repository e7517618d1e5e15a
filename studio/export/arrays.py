"""How a dataset writes poses and stiffness: as numbers without jumps, and back."""

from __future__ import annotations

import numpy as np

from controller.types import Array
from policy import rotations
from policy.features import blocks_of

_UPPER = np.triu_indices(3)


def cholesky_of(stiffness: Array) -> Array:
    """(n, 12) upper triangles U of the two blocks K = U^T U (the paper, IV) of (n, 12) `Stiffness.vector`."""
    upper = np.swapaxes(np.linalg.cholesky(blocks_of(stiffness)), -1, -2)
    return np.asarray(upper[..., *_UPPER].reshape(len(stiffness), 12))


def stiffness_from(cholesky: Array) -> Array:
    """Inverse of `cholesky_of`."""
    upper = np.zeros((len(cholesky), 2, 3, 3))
    upper[..., *_UPPER] = cholesky.reshape(-1, 2, 6)
    blocks = np.swapaxes(upper, -1, -2) @ upper
    return np.asarray(blocks[..., *_UPPER].reshape(-1, 12))


def six_of(wxyz: Array) -> Array:
    """(n, 6) first two columns of the rotation matrices of (n, 4)."""
    return rotations.six_numbers(rotations.matrices(wxyz))


def quaternions_from_six(numbers: Array) -> Array:
    """Inverse of `six_of`, up to the sign, which does not jump."""
    return _continuous(rotations.quaternions(rotations.from_six_numbers(numbers)))


def mean_rotation_vector(wxyz: Array) -> Array:
    """(3,) of the mean of (n, 4)."""
    return rotations.rotation_vectors(rotations.matrices(rotations.mean_rotation(wxyz)))


def axis_angle_of(wxyz: Array, reference: Array) -> Array:
    """(n, 3) axis times angle of (n, 4), on the branch next to `reference` (3,)."""
    return rotations.nearest_branch(rotations.rotation_vectors(rotations.matrices(wxyz)), reference)


def quaternions_from_axis_angle(vectors: Array) -> Array:
    """Inverse of `axis_angle_of`, up to the sign, which does not jump."""
    return _continuous(rotations.quaternions(rotations.from_rotation_vectors(vectors)))


def _continuous(wxyz: Array) -> Array:
    """The same rotations, each quaternion on the side of the one before."""
    turns = np.sign((wxyz[1:] * wxyz[:-1]).sum(1))
    signs = np.concatenate(([1.0 if wxyz[0, 0] >= 0 else -1.0], np.where(turns < 0, -1.0, 1.0)))
    return wxyz * np.cumprod(signs)[:, None]
