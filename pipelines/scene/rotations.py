"""Rotations as matrices [N, 3, 3] and as unit quaternions (w, x, y, z) [N, 4]; float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


def quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (w, x, y, z) [N, 4] of rotation matrices [N, 3, 3].

    Each is the eigenvector of Bar-Itzhack's symmetric 4x4 matrix, so a matrix that is slightly off
    gives the nearest rotation. The sign is free.
    """
    m = rotations
    k = np.empty((len(m), 4, 4))
    k[:, 0, 0] = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    k[:, 1, 1] = m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2]
    k[:, 2, 2] = m[:, 1, 1] - m[:, 0, 0] - m[:, 2, 2]
    k[:, 3, 3] = m[:, 2, 2] - m[:, 0, 0] - m[:, 1, 1]
    k[:, 0, 1] = k[:, 1, 0] = m[:, 2, 1] - m[:, 1, 2]
    k[:, 0, 2] = k[:, 2, 0] = m[:, 0, 2] - m[:, 2, 0]
    k[:, 0, 3] = k[:, 3, 0] = m[:, 1, 0] - m[:, 0, 1]
    k[:, 1, 2] = k[:, 2, 1] = m[:, 0, 1] + m[:, 1, 0]
    k[:, 1, 3] = k[:, 3, 1] = m[:, 0, 2] + m[:, 2, 0]
    k[:, 2, 3] = k[:, 3, 2] = m[:, 1, 2] + m[:, 2, 1]
    vectors: Floats = np.linalg.eigh(k)[1][:, :, -1]
    return vectors


def rotation_matrices(q: Floats) -> Floats:
    """Rotation matrices [N, 3, 3] of unit quaternions (w, x, y, z) [N, 4]."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    stacked: Floats = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return stacked


def rotation_between(start: Floats, end: Floats) -> Floats:
    """The smallest rotations [N, 3, 3] that turn unit vectors `start` [N, 3] to `end` [N, 3].

    For opposite vectors, where no turn is smallest, one of the half turns.
    """
    cross = np.cross(start, end)
    # The unit quaternion of half the angle, before its length is 1: (1 + cos, cross).
    q = np.concatenate((1.0 + (start * end).sum(axis=1, keepdims=True), cross), axis=1)
    opposite = np.linalg.norm(q, axis=1) < 1e-9
    if opposite.any():
        least = np.eye(3)[np.abs(start[opposite]).argmin(axis=1)]
        q[opposite, 1:] = np.cross(start[opposite], least)
    return rotation_matrices(q)
