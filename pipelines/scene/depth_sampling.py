"""Depth maps asked between their pixels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Depths = NDArray[np.float32]
Floats = NDArray[np.float64]

_SAME_SURFACE = 0.02
"""Relative difference up to which neighbouring depths are one surface, to be drawn through."""


def sampled(z: Depths, u: Floats, v: Floats) -> Depths:
    """The depths [H, W] at columns `u` and rows `v` of the map `z`, [H, W] each; 0 beyond it.

    Pixel centres are at integers. Between four pixels of one surface inverse depth is interpolated,
    which planes are exact in; elsewhere the nearest pixel tells.
    """
    height, width = z.shape
    inside = (u >= -0.5) & (u < width - 0.5) & (v >= -0.5) & (v < height - 0.5)
    u, v = (np.where(inside, places, 0.0) for places in (u, v))
    columns, rows = np.rint(u).astype(int), np.rint(v).astype(int)
    nearest = z[np.clip(rows, 0, height - 1), np.clip(columns, 0, width - 1)]
    i = np.clip(np.floor(u).astype(int), 0, max(width - 2, 0))
    j = np.clip(np.floor(v).astype(int), 0, max(height - 2, 0))
    fu, fv = np.clip(u - i, 0.0, 1.0), np.clip(v - j, 0.0, 1.0)
    right, below = np.minimum(i + 1, width - 1), np.minimum(j + 1, height - 1)
    corners = np.stack([z[j, i], z[j, right], z[below, i], z[below, right]])
    least, most = corners.min(axis=0), corners.max(axis=0)
    inverse = 1.0 / np.where(corners > 0, corners, 1.0)
    top = inverse[0] + fu * (inverse[1] - inverse[0])
    bottom = inverse[2] + fu * (inverse[3] - inverse[2])
    smooth = (least > 0) & (most - least <= _SAME_SURFACE * least)
    values = np.where(smooth, 1.0 / (top + fv * (bottom - top)), nearest)
    return np.where(inside, values, 0.0).astype(np.float32)
