"""Kernel twin of `stereo.refinement.plain_search`: where along its normal a point looks alike."""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.parts.runtime import compiled, inlined, run_threads

Floats = NDArray[np.float32]


@inlined
def _sine(cosine):
    return np.sqrt(max(np.float32(0.0), np.float32(1.0) - cosine * cosine))


@inlined
def _dot(a, b):
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@compiled
def _choose(seen, p, point, normal, eyes, lenses, rules, chosen, quality, toward):
    """The views that a point is compared in, the best first, into `chosen`.

    Returns how many, the size of a pixel of the first there, and the largest sine between the first
    and another. quality: [V] and toward: [V, 3], scratch.
    """
    least_cosine, least_sine, good_sine, near_sine, least_score = rules
    first, best, footprint = -1, np.float32(0.0), np.float32(0.0)
    for v in range(len(eyes)):
        quality[v] = 0.0
        if seen[v, p] == 0:
            continue
        toward[v] = eyes[v] - point
        distance = np.sqrt(_dot(toward[v], toward[v]))
        toward[v] /= distance
        cosine = _dot(toward[v], normal)
        if cosine < least_cosine:
            continue
        quality[v] = cosine * lenses[v, 0] / distance
        if quality[v] > best:
            first, best, footprint = v, quality[v], distance / lenses[v, 0]
    widest = np.float32(0.0)
    if first < 0:
        return 0, footprint, widest
    chosen[0], used = first, 1
    quality[first] = 0.0
    while used < len(chosen):
        top, which, sine_of_which = least_score, -1, np.float32(0.0)
        for v in range(len(eyes)):
            if quality[v] <= 0.0:
                continue
            cosine = _dot(toward[v], toward[first])
            sine = _sine(cosine)
            if sine < least_sine or cosine < np.float32(0.5):
                continue
            score = quality[v] / best * min(np.float32(1.0), sine / good_sine)
            if sine > np.float32(2.0) * good_sine:
                score *= np.float32(2.0) * good_sine / sine
            for m in range(1, used):
                between = _sine(_dot(toward[v], toward[chosen[m]]))
                if between < near_sine:
                    score *= np.float32(0.3) + np.float32(0.7) * between / near_sine
            if score > top:
                top, which, sine_of_which = score, v, sine
        if which < 0:
            break
        chosen[used] = which
        used += 1
        quality[which] = 0.0
        widest = max(widest, sine_of_which)
    return used, footprint, widest


@compiled
def _patch(
    pixels, start, height, width, camera, lens, center, across, down, reach, least_variance, out
):
    """A patch's brightness in a view, its mean taken away and its length 1, into `out`.

    Returns whether all of it is in the picture and not plain.
    """
    total, squares, i = np.float32(0.0), np.float32(0.0), 0
    row_x, row_y, row_z = camera[0], camera[1], camera[2]
    x0 = _dot(row_x, center) + row_x[3]
    y0 = _dot(row_y, center) + row_y[3]
    z0 = _dot(row_z, center) + row_z[3]
    ax, ay, az = _dot(row_x, across), _dot(row_y, across), _dot(row_z, across)
    bx, by, bz = _dot(row_x, down), _dot(row_y, down), _dot(row_z, down)
    for a in range(-reach, reach + 1):
        for b in range(-reach, reach + 1):
            z = z0 + a * az + b * bz
            if z <= 0.0:
                return False
            u = lens[0] * (x0 + a * ax + b * bx) / z + lens[2] - np.float32(0.5)
            v = lens[1] * (y0 + a * ay + b * by) / z + lens[3] - np.float32(0.5)
            if not (u >= 0.0 and v >= 0.0 and u < width - 1 and v < height - 1):
                return False
            column, row = int(u), int(v)
            at = start + row * width + column
            p, q, r, s = pixels[at], pixels[at + 1], pixels[at + width], pixels[at + width + 1]
            if p == 0 or q == 0 or r == 0 or s == 0:
                return False
            fu, fv = u - np.float32(column), v - np.float32(row)
            top = np.float32(p) + fu * (np.float32(q) - np.float32(p))
            bottom = np.float32(r) + fu * (np.float32(s) - np.float32(r))
            value = top + fv * (bottom - top)
            out[i] = value
            i += 1
            total += value
            squares += value * value
    mean = total / i
    variance = squares / i - mean * mean
    if variance < least_variance:
        return False
    scale = np.float32(1.0) / np.sqrt(variance * i)
    for k in range(i):
        out[k] = (out[k] - mean) * scale
    return True


@compiled
def _search(
    share, shares, points, normals, seen, pixels, sizes, starts, cameras, eyes, lenses, rules,
    counts, step_px, least_variance, scores, steps,
):  # fmt: skip
    """scores: [P, 2 S + 1] alikeness at each step, -2 where unknown. steps: [P] in length."""
    num_views, num_steps, reach = counts
    side = 2 * reach + 1
    chosen = np.empty(num_views, np.int64)
    quality = np.empty(len(eyes), np.float32)
    toward = np.empty((len(eyes), 3), np.float32)
    patches = np.empty((2, side * side), np.float32)
    alike = np.empty(num_views, np.float32)
    across, down = np.empty(3, np.float32), np.empty(3, np.float32)
    center = np.empty(3, np.float32)
    for p in range(share, len(points), shares):
        point, normal = points[p], normals[p]
        used, footprint, widest = _choose(
            seen, p, point, normal, eyes, lenses, rules, chosen, quality, toward
        )
        if used < 3:
            continue
        if abs(normal[0]) < 0.6:
            across[0], across[1], across[2] = 0.0, normal[2], -normal[1]
        else:
            across[0], across[1], across[2] = -normal[2], 0.0, normal[0]
        across *= footprint / np.sqrt(_dot(across, across))
        down[0] = normal[1] * across[2] - normal[2] * across[1]
        down[1] = normal[2] * across[0] - normal[0] * across[2]
        down[2] = normal[0] * across[1] - normal[1] * across[0]
        step = step_px * footprint / widest
        steps[p] = step
        for k in range(2 * num_steps + 1):
            for axis in range(3):
                center[axis] = point[axis] + np.float32(k - num_steps) * step * normal[axis]
            count = 0
            for m in range(used):
                v = chosen[m]
                ok = _patch(
                    pixels, starts[v], sizes[v, 0], sizes[v, 1], cameras[v], lenses[v], center,
                    across, down, reach, least_variance, patches[min(m, 1)],
                )  # fmt: skip
                if m == 0 and not ok:
                    break
                if m == 0 or not ok:
                    continue
                value = np.float32(0.0)
                for i in range(side * side):
                    value += patches[0, i] * patches[1, i]
                # Kept in falling order.
                i = count
                while i > 0 and alike[i - 1] < value:
                    alike[i] = alike[i - 1]
                    i -= 1
                alike[i] = value
                count += 1
            if count < 2:
                continue
            taken = min(count, max(2, (2 * used) // 3))
            total = np.float32(0.0)
            for i in range(taken):
                total += alike[i]
            scores[p, k] = total / taken


def search_fast(
    points: Floats,
    normals: Floats,
    seen: NDArray[np.uint8],
    pictures: Any,
    rules: tuple[float, ...],
    counts: tuple[int, int, int],
    step_px: float,
    least_variance: float,
) -> tuple[Floats, Floats]:
    """As `stereo.refinement.plain_search`."""
    scores = np.full((len(points), 2 * counts[1] + 1), -2.0, np.float32)
    steps = np.zeros(len(points), np.float32)
    run_threads(
        _search,
        np.ascontiguousarray(points, np.float32),
        np.ascontiguousarray(normals, np.float32),
        seen,
        pictures.pixels,
        pictures.sizes,
        pictures.starts,
        pictures.cameras,
        pictures.eyes,
        pictures.lenses,
        tuple(np.float32(rule) for rule in rules),
        counts,
        np.float32(step_px),
        np.float32(least_variance),
        scores,
        steps,
    )
    return scores, steps
