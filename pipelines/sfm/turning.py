"""Did the camera travel, or only turn, and through which lens? From homographies between pictures.

A camera that turns on the spot sees pictures related by H ~ K R K^-1, with one K for all. So does
nothing else: a camera that travels past one plane gives H ~ K (R + t n^T / d) K^-1. COLMAP puts
both into one class of pairs, and reconstructs a turning camera with a wrong focal length and small
reprojection errors, so errors do not tell.

One that turns much and travels little, as in a room that is filmed from its middle, is nearly the
former: its homographies tell the focal length to a tenth, which the fundamental matrices of its
few other pairs do not. Source: Hartley and Zisserman, "Multiple View
Geometry", 2nd edition, 8.4 and 13.1.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from pipelines.tools.colmap_results import PairStatistics

Array = npt.NDArray[np.float64]

_FOCALS = np.geomspace(0.4, 6.0, 60)
"""Focal lengths tried, in units of the image's long side: 100 to 10 degrees across."""
_GRID = np.stack(np.meshgrid(np.linspace(-0.4, 0.4, 5), np.linspace(-0.25, 0.25, 5)), -1)

_MIN_SHARE = 0.7
"""Share of verified pairs that one homography must explain."""
_MAX_RESIDUAL = 0.01
"""Of the long side. Measured on a rendered room: turning 0.002, with sways of 1 % of the depth
0.007, of 4 % 0.03; travelling along one wall 0.04."""


_MIN_PAIRS = 10
_MIN_TURN_DEG = 3.0
"""A pair that turned less says nothing of the focal length."""
_MOST_SCATTERED = 0.25
"""How far apart the quartiles of the pairs' own focal lengths may lie, as a share of the median.
Measured: 0.09 of the room that is filmed from its middle."""
_MOST_TRAVELLED = 0.06
"""Residual beyond which pairs differ by more than turning: 0.04 of that room."""
_MIN_GAIN = 2.0
"""How many times less the residual must be than with COLMAP's own focal length to start from."""
_COLMAP_FOCAL = 1.2


def is_turning(statistics: PairStatistics) -> bool:
    """Whether the camera turned in place, or stood still, instead of travelling.

    False also where too few pairs matched to tell.
    """
    enough = statistics.num_verified >= 0.5 * len(statistics.num_features)
    num = len(statistics.homographies)
    if not enough or num == 0 or num < _MIN_SHARE * statistics.num_verified:
        return False
    return turning_residual(statistics.homographies) <= _MAX_RESIDUAL


def turning_residual(homographies: Array) -> float:
    """How far the homographies are from those of a camera that only turns.

    homographies: [H, 3, 3], H >= 1, in units of the long side from the image's centre.
    Returns the median over pairs of the root mean square distance between where H and the nearest
    K R K^-1 send a grid of points, in units of the long side, for the best common focal length.
    """
    return float(np.median(_residuals(homographies)[0], axis=1).min())


def focal_of_turning(statistics: PairStatistics) -> float | None:
    """The focal length, in units of the long side, of a camera whose pairs mostly differ as they do
    by turning; None where too few do, or where they do not agree on one.

    It is the median of what each pair says by itself: travelling makes each a little wrong.
    """
    if len(statistics.homographies) < max(_MIN_PAIRS, 0.5 * statistics.num_verified):
        return None
    residuals, angles = _residuals(statistics.homographies)
    best = residuals.argmin(axis=0)
    turned = np.take_along_axis(angles, best[None], axis=0)[0] >= np.radians(_MIN_TURN_DEG)
    if turned.sum() < max(_MIN_PAIRS, 0.5 * statistics.num_verified):
        return None
    low, middle, high = np.percentile(_FOCALS[best[turned]], (25, 50, 75))
    misses = np.median(residuals[:, turned], axis=1)
    there, usual = (misses[np.abs(_FOCALS - at).argmin()] for at in (middle, _COLMAP_FOCAL))
    agree = high - low <= _MOST_SCATTERED * middle
    fits = there <= _MOST_TRAVELLED and _MIN_GAIN * there <= usual
    return float(middle) if agree and fits else None


def _residuals(homographies: Array) -> tuple[Array, Array]:
    """For each of _FOCALS and each homography [H, 3, 3], [F, H]: how far the nearest K R K^-1 sends
    a grid of points from where the homography does, root mean square, and the angle of R."""
    signs = np.sign(np.linalg.det(homographies))
    scaled = homographies * (signs / np.cbrt(np.abs(np.linalg.det(homographies))))[:, None, None]
    points = np.concatenate([_GRID.reshape(-1, 2), np.ones((_GRID.size // 2, 1))], axis=1)
    wanted = _project(scaled, points)
    residuals, angles = [], []
    for focal in _FOCALS:
        calibration = np.diag([focal, focal, 1.0])
        turned = np.linalg.inv(calibration) @ scaled @ calibration
        left, _, right = np.linalg.svd(turned)
        rotation = left @ right
        rotation *= np.sign(np.linalg.det(rotation))[:, None, None]
        found = _project(calibration @ rotation @ np.linalg.inv(calibration), points)
        residuals.append(np.sqrt(((found - wanted) ** 2).sum(axis=2).mean(axis=1)))
        cosines = (np.trace(rotation, axis1=1, axis2=2) - 1.0) / 2.0
        angles.append(np.arccos(np.clip(cosines, -1.0, 1.0)))
    return np.array(residuals), np.array(angles)


def _project(homographies: Array, points: Array) -> Array:
    """[H, 3, 3] applied to [P, 3] homogeneous points: [H, P, 2]."""
    mapped = points @ homographies.transpose(0, 2, 1)
    depth = mapped[:, :, 2:]
    flat: Array = mapped[:, :, :2] / np.where(np.abs(depth) < 1e-6, 1e-6, depth)
    return flat
