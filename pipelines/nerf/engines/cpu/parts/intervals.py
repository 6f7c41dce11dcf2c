"""Numba twins, one ray at a time, of `intervals`, `samplers` and `contraction`.

Symbols: S intervals with S + 1 edges; `t` scene distance along a unit ray; `s` the same in [0, 1].
Sums run in float64 and are rounded once per element, as torch does it on the CPU.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np

from pipelines.nerf.engines.cpu.parts.lanes import exp_all, expm1_all
from pipelines.nerf.engines.cpu.parts.runtime import compiled, inlined

ZERO, HALF, ONE, TWO = np.float32(0.0), np.float32(0.5), np.float32(1.0), np.float32(2.0)
QUARTER = np.float32(0.25)
LINF, L2, NONE = 0, 1, 2
CONTRACTION_CODES = {"linf": LINF, "l2": L2, "none": NONE}
INSIDE = 3
"""The row behind x, y and z of a sample's place: 1 where density may be, else 0."""


@compiled
def spread_edges(s_edges, count, s_near, s_far, t_edges):
    """t_edges[:count + 1] of s_edges: twin of `intervals.t_from_s`."""
    for i in range(count + 1):
        x = s_near + s_edges[i] * (s_far - s_near)
        t_edges[i] = TWO * x if x < HALF else HALF / (ONE - x)


@compiled
def find_weights(density, t_edges, count, rows, weights):
    """Twin of `intervals.weights_from_density` for one ray; returns the sum of the weights.

    rows: [2, count rounded up to 16, or more] scratch.
    """
    passed, total = 0.0, 0.0
    for i in range(count):
        thickness = density[i] * (t_edges[i + 1] - t_edges[i])
        rows[0, i], rows[1, i] = -np.float32(passed), -thickness
        passed += thickness
    exp_all(rows[0], count, rows[0])
    expm1_all(rows[1], count, rows[1])
    for i in range(count):
        weight = -rows[0, i] * rows[1, i]
        # An infinite density in an interval of no width is 0 * inf; it holds nothing.
        weights[i] = weight if weight == weight else ZERO
        total += weights[i]
    return total


@compiled
def resample(s_edges, weights, total, count, num_new, offsets, padding, new_edges, masses):
    """new_edges[:num_new + 1]: twin of `intervals.sample_pdf`.

    total: the sum of the weights. offsets: [1 or num_new + 1], where in their equal shares the
    draws lie, in [0, 1). masses[:num_new]: the weight, without padding, that lies between the new
    edges. The draws increase, so one walk along the histogram finds all of them.
    """
    scale = 1.0 / (total + count * padding)
    interval = 0
    low, before, reached = 0.0, 0.0, 0.0
    high = (weights[0] + padding) * scale
    num_edges, last_offset = num_new + 1, len(offsets) - 1
    for j in range(num_edges):
        draw = (j + offsets[min(j, last_offset)]) / num_edges
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


@inlined
def contracted_size(x, y, z, contraction):
    """The norm of a scene point that its contraction, `LINF` or `L2`, goes by."""
    if contraction == L2:
        return np.float32(math.sqrt(x * x + y * y + z * z))
    return max(abs(x), abs(y), abs(z))


@inlined
def contracting_factor(size):
    """(f, 1 / n) with f x + 1/2 the unit point of scene point x; n: its size, at least 1."""
    inverse = ONE / max(size, ONE)
    return (TWO - inverse) * inverse * QUARTER, inverse


@compiled
def place_ray(origin, direction, t_edges, count, contraction, first, rows):
    """rows[:3, first + i] = unit point midway in interval i; rows[INSIDE, .] = 1 where density may
    be, else 0. Twin of `contraction.unit_from_scene`.

    rows: [4 or more, first + count or more].
    """
    ox, oy, oz = origin[0], origin[1], origin[2]
    dx, dy, dz = direction[0], direction[1], direction[2]
    for i in range(count):
        t = HALF * (t_edges[i] + t_edges[i + 1])
        x, y, z = ox + dx * t, oy + dy * t, oz + dz * t
        factor, inside = HALF, ONE
        if contraction != NONE:
            factor, _ = contracting_factor(contracted_size(x, y, z, contraction))
        x, y, z = x * factor + HALF, y * factor + HALF, z * factor + HALF
        if contraction == NONE:
            within = ZERO < x < ONE and ZERO < y < ONE and ZERO < z < ONE
            inside = ONE if within else ZERO
        column = first + i
        rows[0, column], rows[1, column], rows[2, column] = x, y, z
        rows[INSIDE, column] = inside


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
