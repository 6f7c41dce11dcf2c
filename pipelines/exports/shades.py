"""What a trained scene shows besides its colours, as numbers and as pictures people can look at.

[H, W] pictures of undistorted views; z is the depth along the camera's axis, world units, 0 where
nothing is known. Normals are unit vectors to the camera's side, 0 where nothing is known.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.floating]
Bytes = NDArray[np.uint8]

_NEAR_TO_FAR = np.array(
    [[252, 231, 155], [245, 150, 85], [190, 70, 110], [90, 40, 120], [20, 20, 60]], np.float64
)
_UNKNOWN = 60


def depth_range(z: Floats) -> tuple[float, float] | None:
    """Where almost all known depths lie, or None without any."""
    known = z > 0
    if not known.any():
        return None
    low, high = np.percentile(z[known], (2.0, 98.0))
    return float(low), float(high)


def range_of_views(views: Sequence[DepthView]) -> tuple[float, float] | None:
    """The same for all of some views, so that one range serves a whole flight."""
    return depth_range(np.concatenate([view.z_depth.ravel() for view in views]))


def depth_picture(z: Floats, between: tuple[float, float] | None) -> Bytes:
    """[H, W, 3] by the logarithm of the depth: near is bright, far is dark, grey is unknown.

    between: the depths of the brightest and the darkest; None where nothing is known.
    """
    known = z > 0
    colors = np.full((*z.shape, 3), _UNKNOWN, np.uint8)
    if between is None or not known.any():
        return colors
    low, high = between
    span = max(math.log(high / low), 1e-6)
    place = np.clip(np.log(z[known] / low) / span, 0.0, 1.0) * (len(_NEAR_TO_FAR) - 1)
    steps = np.arange(len(_NEAR_TO_FAR))
    channels = [np.interp(place, steps, _NEAR_TO_FAR[:, channel]) for channel in range(3)]
    colors[known] = np.rint(np.stack(channels, axis=-1)).astype(np.uint8)
    return colors


def normals_of(view: DepthView) -> NDArray[np.float32]:
    """[H, W, 3] normals of the surface that a view shows, in the axes of its camera.

    From the points of neighbouring pixels; unknown beside a jump in depth and at the picture's rim.
    """
    points = view.lens.directions() * np.asarray(view.z_depth, np.float64)[..., None]
    return normals_of_points(points, view.smooth_mask())


def normals_of_points(points: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float32]:
    """The same of any lens. points: [H, W, 3], camera axes. known: [H, W], surface without jump."""
    normals = np.zeros((*known.shape, 3), np.float32)
    if min(known.shape) < 3:
        return normals
    # Down crossed with right looks back at the camera.
    right = points[1:-1, 2:] - points[1:-1, :-2]
    down = points[2:, 1:-1] - points[:-2, 1:-1]
    crossed = np.cross(down, right)
    length = np.linalg.norm(crossed, axis=-1, keepdims=True)
    whole = known[1:-1, 1:-1] & known[1:-1, 2:] & known[1:-1, :-2] & known[2:, 1:-1]
    whole &= known[:-2, 1:-1] & (length[..., 0] > 0)
    unit = np.where(whole[..., None], crossed / np.maximum(length, 1e-300), 0.0)
    normals[1:-1, 1:-1] = unit
    return normals


def normals_picture(normals: Floats) -> Bytes:
    """[H, W, 3]: x to the right is red, y up is green, z to the camera is blue; grey is unknown."""
    colors: Bytes = np.rint(127.5 * (normals + 1.0)).astype(np.uint8)
    colors[~np.asarray(normals).any(axis=-1)] = _UNKNOWN
    return colors


def accumulation_picture(accumulation: Floats) -> Bytes:
    """[H, W, 3]: white where every ray ends, black where none does."""
    grey = np.rint(255.0 * np.clip(accumulation, 0.0, 1.0)).astype(np.uint8)
    return np.repeat(grey[..., None], 3, axis=-1)
