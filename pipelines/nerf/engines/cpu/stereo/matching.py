"""Kernel twin of `stereo.matching.matching_cost`: ZNCC of warped neighbours, plane by plane.

Symbols: [H, W] of the reference picture, N neighbours, D planes. A negative brightness means that
there is no picture there.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads

VARIANCE_FLOOR = np.float32(2e-5)
"""Added to both variances: below it a window holds noise, and noise must not match noise."""
UNSEEN_COST = np.float32(1.0)
"""Of a plane that no neighbour sees: that of no correlation, which never looks like a match."""
_NOTHING = np.float32(9.0)

Floats = NDArray[np.float32]


@compiled
def _window_sums(values, radius, out):
    """Sums over 2 radius + 1 neighbours of a row, cut at its ends. values, out: [W]."""
    width = len(values)
    total = np.float32(0.0)
    for x in range(min(radius, width)):
        total += values[x]
    for x in range(width):
        if x + radius < width:
            total += values[x + radius]
        if x - radius - 1 >= 0:
            total -= values[x - radius - 1]
        out[x] = total


@compiled
def _warp_row(other, h, y, out, seen):
    """One row of the neighbour as the reference would see it if all lay on one plane.

    other: [H', W']. h: [3, 3], from reference to neighbour pixels, centres at integers.
    out: [W], 0 where the neighbour has no picture; seen: [W] says where it has one.
    """
    rows, columns = other.shape
    u0, v0, z0 = h[0, 1] * y + h[0, 2], h[1, 1] * y + h[1, 2], h[2, 1] * y + h[2, 2]
    last_u, last_v = np.float32(columns - 1), np.float32(rows - 1)
    for x in range(len(out)):
        seen[x] = False
        out[x] = np.float32(0.0)
        depth = h[2, 0] * np.float32(x) + z0
        if not depth > np.float32(0.0):
            continue
        inverse = np.float32(1.0) / depth
        u = (h[0, 0] * np.float32(x) + u0) * inverse
        v = (h[1, 0] * np.float32(x) + v0) * inverse
        if not (u >= np.float32(0.0) and v >= np.float32(0.0) and u < last_u and v < last_v):
            continue
        i, j = np.int32(u), np.int32(v)
        a, b = other[j, i], other[j, i + 1]
        c, d = other[j + 1, i], other[j + 1, i + 1]
        if min(min(a, b), min(c, d)) < np.float32(0.0):
            continue
        fu, fv = u - np.float32(i), v - np.float32(j)
        top, bottom = a + fu * (b - a), c + fu * (d - c)
        out[x] = top + fv * (bottom - top)
        seen[x] = True


@compiled
def _score_row(columns, mean, scale, counts, seen, best, second):
    """Turn the window sums of one row into costs and keep the best two. All [W] or [3, W]."""
    for x in range(len(mean)):
        share = np.float32(1.0) / counts[x]
        mean_o = columns[0, x] * share
        var_o = max(columns[1, x] * share - mean_o * mean_o, np.float32(0.0)) + VARIANCE_FLOOR
        covariance = columns[2, x] * share - mean[x] * mean_o
        cost = np.float32(1.0) - covariance * scale[x] / np.sqrt(var_o)
        cost = cost if seen[x] else _NOTHING
        second[x] = min(second[x], max(best[x], cost))
        best[x] = min(best[x], cost)


@compiled
def _match(share, shares, reference, others, homographies, radius, mean, scale, counts, cost):
    num_planes, height, width = cost.shape
    side = 2 * radius + 1
    ring = np.empty((side, 3, width), np.float32)
    columns = np.empty((3, width), np.float32)
    shown, product = np.empty(width, np.float32), np.empty(width, np.float32)
    seen = np.empty((side, width), np.bool_)
    best, second = np.empty((height, width), np.float32), np.empty((height, width), np.float32)
    for plane in range(share, num_planes, shares):
        best[:] = _NOTHING
        second[:] = _NOTHING
        for n in range(len(others)):
            columns[:] = np.float32(0.0)
            for y in range(height + radius):
                slot = y % side
                if y >= side:
                    for k in range(3):
                        for x in range(width):
                            columns[k, x] -= ring[slot, k, x]
                if y < height:
                    _warp_row(others[n], homographies[n, plane], np.float32(y), shown, seen[slot])
                    _window_sums(shown, radius, ring[slot, 0])
                    for x in range(width):
                        product[x] = shown[x] * shown[x]
                    _window_sums(product, radius, ring[slot, 1])
                    for x in range(width):
                        product[x] = shown[x] * reference[y, x]
                    _window_sums(product, radius, ring[slot, 2])
                    for k in range(3):
                        for x in range(width):
                            columns[k, x] += ring[slot, k, x]
                else:
                    ring[slot] = np.float32(0.0)
                row = y - radius
                if row >= 0:
                    _score_row(
                        columns,
                        mean[row],
                        scale[row],
                        counts[row],
                        seen[row % side],
                        best[row],
                        second[row],
                    )
        for y in range(height):
            for x in range(width):
                if best[y, x] == _NOTHING:
                    cost[plane, y, x] = UNSEEN_COST
                elif second[y, x] == _NOTHING:
                    cost[plane, y, x] = best[y, x]
                else:
                    cost[plane, y, x] = np.float32(0.5) * (best[y, x] + second[y, x])


def matching_cost_fast(
    reference: Floats, others: Floats, homographies: Floats, radius: int
) -> Floats:
    """As `stereo.matching.matching_cost`, on arrays: [D, H, W] float32."""
    counts = _squares(np.ones_like(reference), radius)
    mean = _squares(reference, radius) / counts
    variance = np.maximum(_squares(reference * reference, radius) / counts - mean * mean, 0.0)
    scale = 1.0 / np.sqrt(variance + VARIANCE_FLOOR)
    cost = np.empty((homographies.shape[1], *reference.shape), np.float32)
    constants = (mean.astype(np.float32), scale.astype(np.float32), counts.astype(np.float32))
    run_threads(_match, reference, others, homographies, radius, *constants, cost)
    return cost


def _squares(values: Floats, radius: int) -> NDArray[np.float64]:
    """[H, W] sums over squares of side 2 radius + 1, cut at the border."""
    sums: NDArray[np.float64] = values.astype(np.float64)
    for axis in (0, 1):
        padded = np.cumsum(np.insert(sums, 0, 0.0, axis=axis), axis=axis)
        size = values.shape[axis]
        high = np.minimum(np.arange(size) + radius + 1, size)
        low = np.maximum(np.arange(size) - radius, 0)
        sums = padded.take(high, axis) - padded.take(low, axis)
    return sums
