"""By how much cameras whose X axes are all parallel look up or down, by the planes that they see.

Who walks straight ahead, or along a shelf, holds the phone level but tipped, by an angle that no
axis of it tells: up is somewhere across the common X axis, the side. Most of what people build is
level or upright. So points are looked at from the side, where a floor, a table top, a ceiling and
a wall ahead are lines, and the direction is taken along which, and across which, most of them lie
on few lines (a Manhattan world: Coughlan, Yuille, "Manhattan World: Compass Direction from a Single
Image by Bayesian Inference", ICCV 1999; here with points in place of edges).

Symbols: P points.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

_MOST_DEG, _STEP_DEG = 40.0, 1.0
"""How far from the cameras' own up it may be; from 45 on a table looks like a wall."""
_FINER, _PEAK = 9, 8
"""The best is the mean of so many angles around it, by this power of what lies on lines."""
LINE, _LINES = 0.01, 3
"""Width of a line, in median distances of points from the cameras' middle, and how many count."""
FEWEST_POINTS = 100
_LEAST_SHARE, _CLEAR = 0.2, 1.25
"""Of the points, how many lie on these lines, and how many times as many as by the median angle:
of a hedge or a heap no direction has more than another."""
FARTHEST = 5.0
"""Median distances beyond which points do not count: they are off by more than lines are wide."""


def level_with_planes(points: Array, eyes: Array, side: Array, up: Array) -> Array | None:
    """The direction, [3] unit, across the side and near `up`, to which most of what is seen is
    level or upright; None where no direction is clearly that.

    points: [P, 3]. eyes: [N, 3], camera centres. side, up: [3] unit, orthogonal.
    """
    if len(points) < FEWEST_POINTS:
        return None
    away = points - eyes.mean(axis=0)
    distance = np.linalg.norm(away, axis=1)
    usual = float(np.median(distance))
    if not usual > 0.0:
        return None
    away = away[distance <= FARTHEST * usual]
    flat = np.stack([away @ up, away @ np.cross(side, up)], axis=1)
    angles = np.radians(np.arange(-_MOST_DEG, _MOST_DEG + _STEP_DEG, _STEP_DEG))
    shares = np.array([_on_lines(flat, angle, LINE * usual) for angle in angles])
    best = int(shares.argmax())
    if not 0 < best < len(angles) - 1:
        return None
    if shares[best] < _LEAST_SHARE or shares[best] < _CLEAR * np.median(shares):
        return None
    near = angles[best] + np.radians(_STEP_DEG) * np.linspace(-1.0, 1.0, _FINER)
    weights = np.array([_on_lines(flat, angle, LINE * usual) for angle in near]) ** _PEAK
    angle = float(np.average(near, weights=weights))
    level: Array = np.cos(angle) * up + np.sin(angle) * np.cross(side, up)
    return level


def _on_lines(flat: Array, angle: float, width: float) -> float:
    """The share of points [P, 2] (along up, across it) on the fullest lines of two directions: up
    turned by an angle, and what is across it."""
    turned_up = flat @ [np.cos(angle), np.sin(angle)]
    across = flat @ [-np.sin(angle), np.cos(angle)]
    return sum(share_on_lines(offsets, width) for offsets in (turned_up, across))


def share_on_lines(offsets: Array, width: float) -> float:
    """The share of offsets [P] in their fullest stretches of a width, less what evenly spread ones
    would have there."""
    bins = np.floor((offsets - offsets.min()) / width).astype(np.int64)
    counts = np.bincount(bins)
    if len(counts) <= 2 * _LINES:
        return 0.0
    pairs = counts[1:] + counts[:-1]
    found, even = 0.0, 2.0 * len(offsets) / len(counts)
    for _ in range(_LINES):
        at = int(pairs.argmax())
        found += max(float(pairs[at]) - even, 0.0)
        pairs[max(at - 1, 0) : at + 2] = 0
    return found / len(offsets)
