"""Fewer points at even distances: one of each cube of space, or the least crowded ones."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

_NEIGHBOURHOOD = 64
"""So many points that follow each other on the curve lose the same share."""
_CHOICE = 3
"""So many times the points that are wanted are chosen from, taken at even steps of the curve."""
_ROUNDS = 2
"""Each along another curve; with eight there are hardly fewer crowds than with two."""
_STEPS_ALONG_AXIS = 2**21
"""Three such numbers fit into the 63 bits of one."""
_SPREADING = (
    (32, 0x1F00000000FFFF),
    (16, 0x1F0000FF0000FF),
    (8, 0x100F00F00F00F00F),
    (4, 0x10C30C30C30C30C3),
    (2, 0x1249249249249249),
)
"""Shifts and masks that leave two zeros between the bits of a number."""


def one_of_each_cube(points: NDArray[np.float64], side: float) -> NDArray[np.int64]:
    """Indices, in order, of the point nearest to the middle of each cube that has any.

    points: [P, 3]. side: of the cubes, which stand beside each other from the least corner on.
    """
    if len(points) == 0:
        return np.zeros(0, np.int64)
    steps = (points - points.min(axis=0)) / side
    cubes = np.floor(steps)
    off = ((steps - cubes - 0.5) ** 2).sum(axis=1)
    # By cube, and within one the nearest to its middle first.
    order = np.lexsort((off, cubes[:, 2], cubes[:, 1], cubes[:, 0]))
    first = np.ones(len(points), bool)
    first[1:] = (np.diff(cubes[order], axis=0) != 0).any(axis=1)
    kept: NDArray[np.int64] = np.sort(order[first])
    return kept


def least_crowded(points: NDArray[np.float64], at_most: int, seed: int) -> NDArray[np.int64]:
    """Indices, in order, of as many points, evenly spread; all where there are not more.

    points: [P, 3]. How dense they are here and there stays as it is: of each neighbourhood the same
    share goes, those that follow others most closely on a curve that fills space (Morton's, which
    is turned in every round).
    """
    kept = np.arange(len(points))
    if len(points) <= at_most:
        return kept
    turns = np.random.default_rng(seed)
    if len(points) > _CHOICE * at_most:
        step = len(points) / (_CHOICE * at_most)
        every = (np.arange(_CHOICE * at_most) * step).astype(np.int64)
        kept = np.sort(_along_curve(points)[every])
    counts = np.exp(np.linspace(math.log(len(kept)), math.log(at_most), _ROUNDS + 1))
    for count in (*np.ceil(counts[1:-1]).astype(int), at_most):
        turn, _ = np.linalg.qr(turns.normal(size=(3, 3)))
        kept = np.sort(kept[_spread(points[kept] @ turn, max(int(count), at_most))])
    return kept


def _spread(points: NDArray[np.float64], count: int) -> NDArray[np.int64]:
    """Indices of so many of the points [P, 3], the closest ones on the curve left out."""
    order = _along_curve(points)
    along = points[order]
    gap = np.full(len(points), np.inf)
    gap[1:] = np.linalg.norm(np.diff(along, axis=0), axis=1)
    groups = max(len(points) // _NEIGHBOURHOOD, 1)
    group = np.arange(len(points)) * groups // len(points)
    ends = np.arange(1, groups + 1) * (len(points) - count) // groups
    losses = np.diff(ends, prepend=0)
    closest_first = np.lexsort((gap, group))
    starts = np.searchsorted(group, np.arange(groups))
    rank = np.arange(len(points)) - starts[group]
    kept: NDArray[np.int64] = order[closest_first[rank >= losses[group]]]
    return kept


def _along_curve(points: NDArray[np.float64]) -> NDArray[np.int64]:
    """The order [P] of points [P, 3] along Morton's curve."""
    low = points.min(axis=0)
    steps = (_STEPS_ALONG_AXIS - 1) / max(float((points - low).max()), 1e-300)
    key = np.zeros(len(points), np.uint64)
    for axis in range(3):
        bits = ((points[:, axis] - low[axis]) * steps).astype(np.uint64)
        for shift, mask in _SPREADING:
            bits = (bits | (bits << np.uint64(shift))) & np.uint64(mask)
        key |= bits << np.uint64(axis)
    return np.argsort(key, kind="stable")
