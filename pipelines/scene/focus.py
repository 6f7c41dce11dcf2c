"""The point that the cameras of a capture look at, where there is one.

A capture around something has such a point: its optical axes meet in front of the cameras. One that
faces forward (a door handle filmed with 0.3 m of travel: nearly parallel axes) or that looks about
(a room filmed from within) has none, and then no point is better than a wrong one: what is cut off,
where the world's origin lies and how a flight keeps its distance all go by it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MIN_SPREAD = 0.02
"""Smallest eigenvalue of the mean of (I - d d^T): sin^2 of the spread of the axes, here 8 degrees.

A Record3D take of a door handle has 0.0135 and axes that pass within 1 degree of a common point,
which lies at 0.17 m where the LiDAR says 0.26 to 0.21 m.
"""
_MAX_ASIDE_COS = np.cos(np.radians(30.0))
"""A camera looks at the point when it is within 30 degrees of its axis: within most pictures."""
_MIN_SHARE = 0.6
_MAX_ROUNDS = 20
_MOST = 3.0
"""How many times as far as the median camera one counts at most."""


def find_focus(world_from_camera: Floats) -> Floats | None:
    """The point [3] nearest to the optical axes of the cameras that look at it, or None.

    world_from_camera: [N, 3, 4], OpenGL axes. Least squares: sum over cameras with centre c and
    axis d of (I - d d^T)(x - c) = 0, over those cameras that have x within 30 degrees of their
    axis, found in rounds. None where these are fewer than 60 % of all, or where their axes spread
    less than 8 degrees.
    """
    centers, axes = world_from_camera[:, :, 3], -world_from_camera[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    looking = np.ones(len(centers), bool)
    focus: Floats | None = None
    for _ in range(_MAX_ROUNDS):
        if looking.sum() < max(2.0, _MIN_SHARE * len(centers)):
            return None
        system = across[looking].mean(axis=0)
        if np.linalg.eigvalsh(system)[0] < _MIN_SPREAD:
            return None
        moments = np.einsum("nij,nj->i", across[looking], centers[looking]) / looking.sum()
        focus = np.linalg.solve(system, moments)
        to_focus = focus - centers
        along = (to_focus * axes).sum(axis=1)
        now_looking = along > _MAX_ASIDE_COS * np.linalg.norm(to_focus, axis=1)
        if np.array_equal(now_looking, looking):
            break
        looking = now_looking
    return focus


def usual_distance(poses: Floats, focus: Floats) -> float:
    """The mean distance of cameras [N, 3, 4] from a point [3]; one picture of the whole from afar,
    or a pose that is wrong, hardly changes it."""
    far = np.linalg.norm(poses[:, :, 3] - focus, axis=1)
    return float(np.minimum(far, _MOST * np.median(far)).mean())
