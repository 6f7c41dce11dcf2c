"""Whether depth views agree with each other: what one shows, the others must not look through."""

from __future__ import annotations

from collections.abc import Iterable
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.ahead import each_ahead
from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_DEPTH_TOLERANCE = 0.05
_MAX_CONTRADICTED = 0.3
_MOST_THREADS = 2
"""Each holds some numbers of every point, 80 bytes or more."""


def consistent(points: Floats, views: Iterable[DepthView]) -> NDArray[np.bool_]:
    """Which points [P, 3] the views do not contradict: [P].

    A view contradicts a point that hangs in front of the surface it sees by more than 5 %, and
    supports one on that surface. The nearest surface around the pixel counts, or edges would be
    eaten away by the background beside them. Points behind it are hidden and say nothing. A point
    goes when at least two views, and more than 30 % of those with a say, contradict it.
    """
    contradicted = np.zeros(len(points), np.int32)
    supported = np.zeros(len(points), np.int32)
    for against, for_it in each_ahead(partial(_verdict, points), views, _MOST_THREADS):
        contradicted[against] += 1
        supported[for_it] += 1
    bad = (contradicted >= 2) & (contradicted > _MAX_CONTRADICTED * (contradicted + supported))
    fine: NDArray[np.bool_] = ~bad
    return fine


def _verdict(points: Floats, view: DepthView) -> tuple[Indices, Indices]:
    """Which points a view contradicts, and which it supports."""
    lens = view.lens
    matrix = view.camera_from_world_cv(np.zeros(3))
    local = points @ matrix[:3, :3].T + matrix[:3, 3]
    z = local[:, 2]
    safe = np.where(z > 1e-9, z, np.inf)
    u = np.floor(lens.fl_x * local[:, 0] / safe + lens.cx)
    v = np.floor(lens.fl_y * local[:, 1] / safe + lens.cy)
    inside = (z > 1e-9) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    seen = np.flatnonzero(inside)
    surface = _nearest_around(view.z_depth)[v[seen].astype(int), u[seen].astype(int)]
    known = np.isfinite(surface)
    seen, surface = seen[known], surface[known]
    before = z[seen] < surface * (1.0 - _DEPTH_TOLERANCE)
    beside = np.abs(z[seen] - surface) <= surface * _DEPTH_TOLERANCE
    return seen[before], seen[beside]


def _nearest_around(z_depth: NDArray[np.float32]) -> NDArray[np.float32]:
    """[H, W] the least known depth in each pixel's 3x3 neighbourhood; infinite where none is."""
    height, width = z_depth.shape
    padded = np.pad(
        np.where(z_depth > 0, z_depth, np.float32(np.inf)), 1, constant_values=np.float32(np.inf)
    )
    shifted = [padded[y : y + height, x : x + width] for y in range(3) for x in range(3)]
    nearest: NDArray[np.float32] = np.minimum.reduce(shifted)
    return nearest
