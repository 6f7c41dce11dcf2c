"""Kernel twin of `alignment.align`: all functions in one file, so that the cache of compiled code
notices every change of them.

Threads are Python's, as kernels release the interpreter's lock. numba is used as it comes, not
through the training kernels' runtime, which would bring torch into a stage that has no other use
for it. A reference patch and its normal equations are made once for all pictures that it is looked
for in.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor

import numpy as np
from numba import njit

from pipelines.sfm.alignment import (
    CLOSE_PX,
    DAMPING,
    FAR_PX,
    LEAST_DETERMINANT,
    LEAST_DEVIATION,
    MAX_STEPS,
    RADIUS,
    Alignments,
    Arena,
    Floats,
    patch_weights,
)

_SHARES_PER_THREAD = 8
"""Several, so that a thread on a busy core does less instead of keeping the others waiting."""
# Everything but the promise that there are no NaN: a degenerate step must be noticed.
_FAST = {"contract", "reassoc", "nsz", "arcp", "afn"}
_compiled = njit(cache=True, nogil=True, error_model="numpy", fastmath=_FAST)
# Constants of other modules would not be noticed by the cache: they are arguments.
_NUMBERS = np.array([MAX_STEPS, CLOSE_PX, FAR_PX, LEAST_DEVIATION, LEAST_DETERMINANT, DAMPING])


def align_fast(arena: Arena, wanted: Alignments, num_threads: int) -> tuple[Floats, Floats]:
    """As `alignment.align`, on so many threads."""
    num = len(wanted.slots)
    found, alike = np.empty((num, 2)), np.empty(num)
    offsets, weights = patch_weights()
    shares = max(1, min(num_threads * _SHARES_PER_THREAD if num_threads > 1 else 1, num))

    def work(share: int) -> None:
        _align(
            *(share, shares, arena.grey, arena.heights_widths, wanted.slots, wanted.references),
            *(wanted.from_xy, wanted.to_xy, wanted.warps, offsets, weights, float(RADIUS)),
            *(_NUMBERS, found, alike),
        )

    with ThreadPoolExecutor(max(num_threads, 1)) as pool:
        list(pool.map(work, range(shares)))
    return found, alike


@_compiled
def _value(grey, width, x, y):
    """Bilinear; grey: [bytes] of one picture, x and y from the first pixel's centre."""
    column, row = int(x), int(y)
    s, t = x - column, y - row
    i = row * width + column
    top = grey[i] * (1.0 - s) + grey[i + 1] * s
    bottom = grey[i + width] * (1.0 - s) + grey[i + width + 1] * s
    return top * (1.0 - t) + bottom * t


@_compiled
def _inside(size, x, y, reach_x, reach_y):
    """Whether a patch that reaches so far to either side of (x, y) lies in the picture."""
    height, width = size[0], size[1]
    return (
        x - 0.5 - reach_x >= 0.0
        and y - 0.5 - reach_y >= 0.0
        and x - 0.5 + reach_x < width - 1.0
        and y - 0.5 + reach_y < height - 1.0
    )


@_compiled
def _normalise(values, weights):
    """Bring a patch [P] to mean 0 and deviation 1. Returns the deviation before."""
    mean = 0.0
    for i in range(len(values)):
        mean += values[i] * weights[i]
    square = 0.0
    for i in range(len(values)):
        values[i] -= mean
        square += values[i] * values[i] * weights[i]
    deviation = math.sqrt(square)
    scale = 1.0 / max(deviation, 1e-6)
    for i in range(len(values)):
        values[i] *= scale
    return deviation


@_compiled
def _prepare(grey, size, xy, offsets, weights, radius, numbers, template, images, factor):
    """Reference patch [P], weighted steepest descent images [6, P], Cholesky factor [6, 6] of the
    normal equations. Returns whether there is anything to align."""
    x, y = xy[0], xy[1]
    if not _inside(size, x, y, radius + 0.5, radius + 0.5):
        return False
    width = size[1]
    num = len(weights)
    for i in range(num):
        u, v = x - 0.5 + offsets[i, 0], y - 0.5 + offsets[i, 1]
        template[i] = _value(grey, width, u, v)
        images[0, i] = _value(grey, width, u + 0.5, v) - _value(grey, width, u - 0.5, v)
        images[1, i] = _value(grey, width, u, v + 0.5) - _value(grey, width, u, v - 0.5)
    deviation = _normalise(template, weights)
    if deviation <= numbers[3]:
        return False
    for i in range(num):
        slope_x, slope_y = images[0, i] / deviation, images[1, i] / deviation
        images[0, i], images[1, i] = slope_x, slope_y
        images[2, i], images[3, i] = slope_x * offsets[i, 0], slope_x * offsets[i, 1]
        images[4, i], images[5, i] = slope_y * offsets[i, 0], slope_y * offsets[i, 1]
    for row in range(6):
        mean = 0.0
        for i in range(num):
            mean += images[row, i] * weights[i]
        for i in range(num):
            images[row, i] -= mean
    trace = 0.0
    for row in range(6):
        for column in range(row + 1):
            total = 0.0
            for i in range(num):
                total += images[row, i] * images[column, i] * weights[i]
            factor[row, column] = total
        trace += factor[row, row]
    for row in range(6):
        factor[row, row] += numbers[5] * trace / 6.0 + 1e-9
    for row in range(6):
        for column in range(row + 1):
            total = factor[row, column]
            for k in range(column):
                total -= factor[row, k] * factor[column, k]
            if row == column:
                factor[row, row] = math.sqrt(max(total, 1e-12))
            else:
                factor[row, column] = total / factor[column, column]
    for row in range(6):
        for i in range(num):
            images[row, i] *= weights[i]
    return True


@_compiled
def _align(
    share,
    shares,
    grey,
    sizes,
    slots,
    references,
    from_xy,
    to_xy,
    warps,
    offsets,
    weights,
    radius,
    numbers,
    found,
    alike,
):
    num, patch = len(slots), len(weights)
    template, values = np.empty(patch), np.empty(patch)
    images, factor, p = np.empty((6, patch)), np.empty((6, 6)), np.empty(6)
    usable, known = False, -1
    for n in range(num * share // shares, num * (share + 1) // shares):
        if references[n] != known:
            known = references[n]
            slot = slots[n, 0]
            usable = _prepare(
                grey[slot],
                sizes[slot],
                from_xy[n],
                offsets,
                weights,
                radius,
                numbers,
                template,
                images,
                factor,
            )
        found[n, 0], found[n, 1], alike[n] = to_xy[n, 0], to_xy[n, 1], -1.0
        if not usable:
            continue
        slot = slots[n, 1]
        width = sizes[slot, 1]
        other = grey[slot]
        x, y = to_xy[n, 0], to_xy[n, 1]
        a, b, c, d = warps[n, 0, 0], warps[n, 0, 1], warps[n, 1, 0], warps[n, 1, 1]
        last = False
        for step in range(int(numbers[0]) + 1):
            reach_x, reach_y = radius * (abs(a) + abs(b)), radius * (abs(c) + abs(d))
            if not _inside(sizes[slot], x, y, reach_x, reach_y):
                break
            for i in range(patch):
                u, v = offsets[i, 0], offsets[i, 1]
                values[i] = _value(other, width, x - 0.5 + a * u + b * v, y - 0.5 + c * u + d * v)
            if _normalise(values, weights) <= numbers[3]:
                break
            score = 0.0
            for i in range(patch):
                score += values[i] * template[i] * weights[i]
            if score > alike[n]:
                alike[n], found[n, 0], found[n, 1] = score, x, y
            if last or step == int(numbers[0]):
                break
            for row in range(6):
                total = 0.0
                for i in range(patch):
                    total += images[row, i] * (values[i] - template[i])
                for k in range(row):
                    total -= factor[row, k] * p[k]
                p[row] = total / factor[row, row]
            for back in range(6):
                row = 5 - back
                total = p[row]
                for k in range(row + 1, 6):
                    total -= factor[k, row] * p[k]
                p[row] = total / factor[row, row]
            determinant = (1.0 + p[2]) * (1.0 + p[5]) - p[3] * p[4]
            if not determinant > numbers[4]:
                break
            # warp <- warp o change^-1
            e, f = (1.0 + p[5]) / determinant, -p[3] / determinant
            g, h = -p[4] / determinant, (1.0 + p[2]) / determinant
            a, b = a * e + b * g, a * f + b * h
            c, d = c * e + d * g, c * f + d * h
            move_x, move_y = a * p[0] + b * p[1], c * p[0] + d * p[1]
            x, y = x - move_x, y - move_y
            last = move_x * move_x + move_y * move_y < numbers[1] * numbers[1]
            strayed = (x - to_xy[n, 0]) ** 2 + (y - to_xy[n, 1]) ** 2
            if not strayed < numbers[2] * numbers[2]:
                break
