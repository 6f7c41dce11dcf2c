"""Fewer points at even distances: one of each cube of space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


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
