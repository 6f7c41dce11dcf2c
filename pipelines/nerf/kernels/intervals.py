"""Numba twins, one ray at a time, of `intervals`, `samplers` and `contraction`.

Symbols: S intervals with S + 1 edges; `t` scene distance along a unit ray; `s` the same in [0, 1].
Sums run in float64 and are rounded once per element, as torch does it on the CPU.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from pipelines.nerf.kernels.lanes import exp_all
from pipelines.nerf.kernels.runtime import compiled

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
QUARTER = np.float32(0.25)
LINF, L2, NONE = 0, 1, 2
CONTRACTION_CODES = {"linf": LINF, "l2": L2, "none": NONE}


@compiled
def spread_edges(s_edges, count, s_near, s_far, t_edges):
    """t_edges[:count + 1] of s_edges: twin of `intervals.t_from_s`."""
    for i in range(count + 1):
        x = s_near + s_edges[i] * (s_far - s_near)
        t_edges[i] = TWO * x if x < HALF else HALF / (ONE - x)


@compiled
def find_weights(density, t_edges, count, light, weights):
    """Twin of `intervals.weights_from_density` for one ray; returns the sum of the weights.

    light: [count + 1, rounded up to 16] scratch, the transmittance at the edges afterwards.
    """
    passed, total = 0.0, 0.0
    for i in range(count):
        light[i] = -np.float32(passed)
        passed += density[i] * (t_edges[i + 1] - t_edges[i])
    light[count] = -np.float32(passed)
    exp_all(light, count + 1, light)
    for i in range(count):
        weight = light[i] - light[i + 1]
        # An infinite density in an interval of no width is 0 * inf; it holds nothing.
        weights[i] = weight if weight == weight else ZERO
        total += weights[i]
    return total


@compiled
def resample(s_edges, weights, total, count, num_new, padding, new_edges, masses):
    """new_edges[:num_new + 1]: twin of `intervals.sample_pdf` without jitter.

    masses[:num_new]: the weight, without padding, that lies between the new edges. The draws
    increase, so one walk along the histogram finds all of them.
    """
    scale = 1.0 / (total + count * padding)
    interval = 0
    low, before, reached = 0.0, 0.0, 0.0
    high = (weights[0] + padding) * scale
    num_edges = num_new + 1
    for j in range(num_edges):
        draw = (j + 0.5) / num_edges
        while interval < count - 1 and high <= draw:
            before += weights[interval]
            interval += 1
            low = high
            high += (weights[interval] + padding) * scale
        top = 1.0 if interval == count - 1 else high
        share = np.float32(min(max((draw - low) / (top - low), 0.0), 1.0)) if top > low else ZERO
        edge = s_edges[interval]
        new_edges[j] = edge + share * (s_edges[interval + 1] - edge)
        here = before + share * weights[interval]
        if j > 0:
            masses[j - 1] = np.float32(here - reached)
        reached = here


@compiled
def place_ray(origin, direction, t_edges, count, contraction, first, rows):
    """rows[:3, first + i] = unit point midway in interval i; rows[3, .] = 1 where density may be.

    rows: [4 or more, first + count or more]; 0 in row 3 elsewhere. As `place`.
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    for i in range(count):
        t = HALF * (t_edges[i] + t_edges[i + 1])
        x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
        inside = ONE
        if contraction == NONE:
            x, y, z = x * HALF + HALF, y * HALF + HALF, z * HALF + HALF
            within = ZERO < x < ONE and ZERO < y < ONE and ZERO < z < ONE
            inside = ONE if within else ZERO
        else:
            if contraction == L2:
                size = np.float32(math.sqrt(x * x + y * y + z * z))
            else:
                size = max(abs(x), abs(y), abs(z))
            inverse = ONE / max(size, ONE)
            factor = (TWO - inverse) * inverse * QUARTER
            x, y, z = x * factor + HALF, y * factor + HALF, z * factor + HALF
        column = first + i
        rows[0, column], rows[1, column], rows[2, column], rows[3, column] = x, y, z, inside


@compiled
def place(origin, direction, t, contraction, unit):
    """unit[:] = the unit point at distance t; returns whether density may be there.

    Twin of `contraction.unit_from_scene`.
    """
    x = origin[0] + direction[0] * t
    y = origin[1] + direction[1] * t
    z = origin[2] + direction[2] * t
    if contraction == NONE:
        unit[0], unit[1], unit[2] = x * HALF + HALF, y * HALF + HALF, z * HALF + HALF
        return ZERO < unit[0] < ONE and ZERO < unit[1] < ONE and ZERO < unit[2] < ONE
    if contraction == LINF:
        size = max(abs(x), abs(y), abs(z))
    else:
        size = np.float32(math.sqrt(x * x + y * y + z * z))
    inverse = ONE / max(size, ONE)
    factor = (TWO - inverse) * inverse * QUARTER
    unit[0], unit[1], unit[2] = x * factor + HALF, y * factor + HALF, z * factor + HALF
    return True


@compiled
def depths(weights, t_edges, count):
    """(median, expected) depth: twin of `rendering.median_depth` and `expected_depth`."""
    reached, moment = 0.0, 0.0
    median = -1
    for i in range(count):
        middle = HALF * (t_edges[i] + t_edges[i + 1])
        reached += weights[i]
        moment += weights[i] * middle
        if median < 0 and np.float32(reached) >= HALF:
            median = i
    if median < 0:
        median = count - 1
    first = HALF * (t_edges[0] + t_edges[1])
    last = HALF * (t_edges[count - 1] + t_edges[count])
    expected = np.float32(moment / (reached + 1e-10))
    return HALF * (t_edges[median] + t_edges[median + 1]), min(max(expected, first), last)
