"""Kernel twin of `stereo.aggregation.aggregate`: semi-global aggregation along eight paths.

Symbols: D planes, [H, W] pixels. Four paths run with the rows from top to bottom, the other four
are the same on the picture turned by half a circle: two shares, so that two threads never write one
array. Memory: one volume a share, beside the costs.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads

Floats = NDArray[np.float32]
_FAR = np.float32(1e9)


@compiled
def _step(cost, before, least, small, large, out, total):
    """One pixel of one path. cost, total: [D]. before, out: [D + 2], padded; least: of before.

    L(d) = C(d) + min(L'(d), L'(d - 1) + small, L'(d + 1) + small, min L' + large) - min L'.
    Source: Hirschmueller, "Stereo processing by semiglobal matching", TPAMI 2008, eq. 13.
    Returns the least of out.
    """
    jump = least + large
    lowest = _FAR
    for d in range(len(cost)):
        beside = min(before[d], before[d + 2]) + small
        value = cost[d] + min(min(before[d + 1], beside), jump) - least
        out[d + 1] = value
        total[d] += value
        lowest = min(lowest, value)
    return lowest


@compiled
def _sweep_paths(share, shares, cost, weights, small, large, totals):
    num_planes, height, width = cost.shape
    total = totals[share]
    row = np.empty((width, num_planes), np.float32)
    # Of the row before and this one, for the paths from above, above left and above right.
    old = np.full((3, width, num_planes + 2), _FAR, np.float32)
    new = np.full((3, width, num_planes + 2), _FAR, np.float32)
    old_least, new_least = np.empty((3, width), np.float32), np.empty((3, width), np.float32)
    line = np.full((2, num_planes + 2), _FAR, np.float32)
    for step in range(height):
        y = step if share == 0 else height - 1 - step
        for plane in range(num_planes):
            for x in range(width):
                row[x, plane] = cost[plane, y, x]
        beside_least = np.float32(0.0)
        for step_x in range(width):
            x = step_x if share == 0 else width - 1 - step_x
            turn = 1 if share == 0 else -1
            if step_x == 0:
                line[1, 1:-1] = row[x]
                total[y, x] += row[x]
                beside_least = row[x].min()
            else:
                penalty = max(small, large * weights[0, y, x if share == 0 else x + 1])
                beside_least = _step(
                    row[x], line[0], beside_least, small, penalty, line[1], total[y, x]
                )
            line[0, 1:-1] = line[1, 1:-1]
            for path in range(3):
                from_x = x + turn * (0 if path == 0 else (-1 if path == 1 else 1))
                if step == 0 or from_x < 0 or from_x >= width:
                    new[path, x, 1:-1] = row[x]
                    total[y, x] += row[x]
                    new_least[path, x] = row[x].min()
                else:
                    # Weights are kept at the lower pixel of a pair, for either direction.
                    at_y, at_x = (y, x) if share == 0 else (y + 1, from_x)
                    penalty = max(small, large * weights[path + 1, at_y, at_x])
                    new_least[path, x] = _step(
                        row[x],
                        old[path, from_x],
                        old_least[path, from_x],
                        small,
                        penalty,
                        new[path, x],
                        total[y, x],
                    )
        old, new = new, old
        old_least, new_least = new_least, old_least


@compiled
def _choose(share, shares, totals, planes, margins):
    _, height, width, num_planes = totals.shape
    for y in range(share, height, shares):
        for x in range(width):
            best, lowest = 0, _FAR
            for d in range(num_planes):
                value = totals[0, y, x, d] + totals[1, y, x, d]
                if value < lowest:
                    best, lowest = d, value
            second = _FAR
            for d in range(num_planes):
                if abs(d - best) > 2:
                    second = min(second, totals[0, y, x, d] + totals[1, y, x, d])
            shift = np.float32(0.0)
            if 0 < best < num_planes - 1:
                before = totals[0, y, x, best - 1] + totals[1, y, x, best - 1]
                after = totals[0, y, x, best + 1] + totals[1, y, x, best + 1]
                bend = before - np.float32(2.0) * lowest + after
                if bend > np.float32(0.0):
                    shift = np.float32(0.5) * (before - after) / bend
            planes[y, x] = best + min(max(shift, np.float32(-0.5)), np.float32(0.5))
            margins[y, x] = (second - lowest) / np.float32(8.0)


def aggregate_fast(
    cost: Floats, weights: Floats, small: float, large: float
) -> tuple[Floats, Floats]:
    """As `stereo.aggregation.aggregate`, on arrays: planes and margins, [H, W] float32."""
    num_planes, height, width = cost.shape
    totals = np.zeros((2, height, width, num_planes), np.float32)
    run_threads(_sweep_paths, cost, weights, np.float32(small), np.float32(large), totals, shares=2)
    planes, margins = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    run_threads(_choose, totals, planes, margins)
    return planes, margins
