"""Rotations in batches, as networks learn them. Quaternions are wxyz, leading axes are free."""

from __future__ import annotations

import numpy as np
from scipy.spatial.transform import Rotation

from controller.types import Array


def matrices(wxyz: Array) -> Array:
    """(..., 3, 3) of unit quaternions (..., 4)."""
    return np.asarray(_rotation(wxyz).as_matrix().reshape(*wxyz.shape[:-1], 3, 3))


def quaternions(matrix: Array) -> Array:
    """(..., 4) wxyz of rotation matrices (..., 3, 3); the sign is either."""
    xyzw = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_quat()
    return np.asarray(np.roll(xyzw, 1, axis=-1).reshape(*matrix.shape[:-2], 4))


def rotation_vectors(matrix: Array) -> Array:
    """(..., 3) axis times angle [rad], angle in [0, pi]."""
    vectors = Rotation.from_matrix(matrix.reshape(-1, 3, 3)).as_rotvec()
    return np.asarray(vectors.reshape(matrix.shape[:-1]))


def from_rotation_vectors(vector: Array) -> Array:
    """(..., 3, 3) of (..., 3) axis times angle [rad], of any angle."""
    matrix = Rotation.from_rotvec(vector.reshape(-1, 3)).as_matrix()
    return np.asarray(matrix.reshape(*vector.shape, 3))


def six_numbers(matrix: Array) -> Array:
    """(..., 6): the first two columns, continuous everywhere (Zhou et al. 2019, arXiv 1812.07035)."""
    return np.concatenate((matrix[..., :, 0], matrix[..., :, 1]), axis=-1)


def from_six_numbers(numbers: Array) -> Array:
    """The rotations (..., 3, 3) of any (..., 6), by Gram and Schmidt where that can be done."""
    first = _unit(numbers[..., :3], np.array([1.0, 0.0, 0.0]))
    second = numbers[..., 3:] - (first * numbers[..., 3:]).sum(-1, keepdims=True) * first
    across = np.cross(
        first, np.eye(3)[np.abs(first).argmin(-1)]
    )  # along the axis that first is furthest from
    second = _unit(second, across / np.linalg.norm(across, axis=-1, keepdims=True))
    second = second - (first * second).sum(-1, keepdims=True) * first  # once more, against rounding
    second = second / np.linalg.norm(second, axis=-1, keepdims=True)
    return np.stack((first, second, np.cross(first, second)), axis=-1)


def nearest_branch(vector: Array, reference: Array) -> Array:
    """The rotation vector (..., 3) of the same rotation that lies nearest to `reference` (..., 3).

    A turn by an angle about an axis is also one by the angle plus any multiple of 2 pi. Tools that point down
    sit at pi, where the shortest vector flips with every tremble; the one nearest to a reference does not.
    """
    angle = np.linalg.norm(vector, axis=-1, keepdims=True)
    axis = vector / np.maximum(angle, 1e-12)
    turns = np.round(((axis * reference).sum(-1, keepdims=True) - angle) / (2 * np.pi))
    return np.where(angle < 1e-12, vector, vector + turns * 2 * np.pi * axis)


def mean_rotation(wxyz: Array) -> Array:
    """(4,) the mean of (n, 4) quaternions, whose signs do not matter (Markley et al. 2007)."""
    return principal(np.einsum("ni,nj->ij", wxyz, wxyz))


def principal(outer: Array) -> Array:
    """(..., 4): the unit quaternion nearest to a weighted sum (..., 4, 4) of outer products q q^T."""
    return np.asarray(np.linalg.eigh(outer)[1][..., :, -1])


def _rotation(wxyz: Array) -> Rotation:
    return Rotation.from_quat(np.roll(wxyz.reshape(-1, 4), -1, axis=-1))


def _unit(vector: Array, otherwise: Array) -> Array:
    """Vectors (..., 3) at length one; `otherwise` where they have none."""
    length = np.linalg.norm(vector, axis=-1, keepdims=True)
    return np.where(length > 1e-6, vector / np.maximum(length, 1e-6), otherwise)
