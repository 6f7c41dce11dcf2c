"""Where a picture shows the patch that another one shows: affine alignment of small patches.

A patch of the reference picture is laid over the other one by an affine map, which inverse
compositional Gauss-Newton steps improve until both agree best. Brightness is normalised to mean 0
and deviation 1 on both sides, so gain and offset of the exposure make no difference. A Gaussian
weighs the middle most. `align` is the plain definition, `alignment_kernel` the same for many.

Symbols: N alignments, P pixels of a patch. Pictures are grey, uint8, in an `Arena`: slot s holds
one of heights_widths[s] = (h, w), row by row from the slot's start. Positions are (x, y) pixels of
the picture as it lies there, the first pixel's centre at (0.5, 0.5).

Source: Baker and Matthews, "Lucas-Kanade 20 years on", IJCV 2004, 3.2 (inverse compositional).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]

RADIUS = 5
"""Of a patch, pixels: 11 x 11. Of 7, points lie a tenth less exactly
(docs/poses-experiments.md)."""
SPREAD = 0.6 * RADIUS
"""Standard deviation of the weights, pixels."""
MAX_STEPS = 8
CLOSE_PX = 0.003
"""A step below this is the last."""
FAR_PX = 3.0
"""Who strays so far has lost the patch."""
LEAST_DEVIATION = 2.0
"""Grey levels by which a patch must vary: less is noise."""
LEAST_DETERMINANT = 0.2
"""Of a step's affine part; below it the patch collapses."""
DAMPING = 1e-4
"""Of the normal equations, relative to their mean diagonal: patches with one edge only."""


@dataclass(frozen=True)
class Arena:
    """Pictures in slots. grey: [S, bytes] uint8. heights_widths: [S, 2] int64."""

    grey: npt.NDArray[np.uint8]
    heights_widths: npt.NDArray[np.int64]


@dataclass(frozen=True)
class Alignments:
    """N patches to be found, those of one reference one after the other.

    slots: [N, 2] int64, of the reference picture and of the other. references: [N] int64, equal
    where the reference patch is the same. from_xy: [N, 2], the patch's centre in the reference.
    to_xy: [N, 2], where it is about. warps: [N, 2, 2], a pixel's step in the reference -> in the
    other picture, about.
    """

    slots: npt.NDArray[np.int64]
    references: npt.NDArray[np.int64]
    from_xy: Floats
    to_xy: Floats
    warps: Floats


def patch_weights() -> tuple[Floats, Floats]:
    """Offsets [P, 2] of a patch's pixels from its centre, and their weights [P], of sum 1."""
    line = np.arange(-RADIUS, RADIUS + 1.0)
    x, y = np.meshgrid(line, line)
    offsets = np.stack([x.ravel(), y.ravel()], -1)
    weights = np.exp(-(offsets**2).sum(-1) / (2 * SPREAD**2))
    return offsets, weights / weights.sum()


def align(arena: Arena, wanted: Alignments) -> tuple[Floats, Floats]:
    """Where each patch is, [N, 2], and how alike it is there, [N]: correlation in [-1, 1].

    The best of all steps is returned. -1, and the position as it was, where either patch leaves its
    picture or is flat.
    """
    offsets, weights = patch_weights()
    num = len(wanted.slots)
    found, alike = wanted.to_xy.copy(), np.full(num, -1.0)
    template, inside = _sample(arena, wanted.slots[:, 0], wanted.from_xy[:, None] + offsets)
    halves = np.array([[[0.5, 0.0]], [[0.0, 0.5]]])
    slopes = []
    for half in halves:
        ahead, inside_ahead = _sample(
            arena, wanted.slots[:, 0], wanted.from_xy[:, None] + offsets + half
        )
        behind, inside_behind = _sample(
            arena, wanted.slots[:, 0], wanted.from_xy[:, None] + offsets - half
        )
        slopes.append(ahead - behind)
        inside &= inside_ahead & inside_behind
    template, deviation = _normalised(template, weights)
    slope_x, slope_y = (slope / deviation[:, None] for slope in slopes)
    x, y = offsets[:, 0], offsets[:, 1]
    images = np.stack(
        [slope_x, slope_y, slope_x * x, slope_x * y, slope_y * x, slope_y * y], -1
    )  # [N, P, 6], steepest descent
    images = images - (images * weights[:, None]).sum(1, keepdims=True)
    normal = np.einsum("npi,p,npj->nij", images, weights, images)
    mean = np.trace(normal, axis1=1, axis2=2) / 6
    normal = normal + (DAMPING * mean + 1e-9)[:, None, None] * np.eye(6)
    here, warps = wanted.to_xy.copy(), wanted.warps.copy()
    active = inside & (deviation > LEAST_DEVIATION)
    last = np.zeros(num, bool)
    for step in range(MAX_STEPS + 1):
        places = here[:, None] + np.einsum("nij,pj->npi", warps, offsets)
        values, inside = _sample(arena, wanted.slots[:, 1], places)
        values, deviation = _normalised(values, weights)
        active &= inside & (deviation > LEAST_DEVIATION)
        score = (values * template * weights).sum(-1)
        better = active & (score > alike)
        alike[better], found[better] = score[better], here[better]
        active &= ~last
        if step == MAX_STEPS or not active.any():
            break
        right = np.einsum("npi,p,np->ni", images, weights, values - template)
        p = np.linalg.solve(normal, right[..., None])[..., 0]
        change = np.eye(2) + p[:, 2:].reshape(-1, 2, 2)
        active &= np.linalg.det(change) > LEAST_DETERMINANT
        change[~active], p[~active] = np.eye(2), 0.0
        warps = warps @ np.linalg.inv(change)
        move = np.einsum("nij,nj->ni", warps, p[:, :2])
        here = here - move
        last = np.linalg.norm(move, axis=1) < CLOSE_PX
        active &= np.linalg.norm(here - wanted.to_xy, axis=1) < FAR_PX
    return found, alike


def _normalised(values: Floats, weights: Floats) -> tuple[Floats, Floats]:
    """Patches [N, P] with mean 0 and deviation 1, and their deviations [N] before."""
    values = values - (values * weights).sum(-1, keepdims=True)
    deviation = np.sqrt((values**2 * weights).sum(-1))
    return values / np.maximum(deviation, 1e-6)[:, None], deviation


def _sample(
    arena: Arena, slots: npt.NDArray[np.int64], places: Floats
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """Grey values [N, P] at places [N, P, 2], bilinear, and whether all of a row's lie inside."""
    sizes = arena.heights_widths[slots]
    height, width = sizes[:, :1], sizes[:, 1:]
    x, y = places[..., 0] - 0.5, places[..., 1] - 0.5
    within = (x >= 0) & (y >= 0) & (x < width - 1) & (y < height - 1)
    inside: npt.NDArray[np.bool_] = np.all(within, axis=-1)
    x, y = np.where(inside[:, None], x, 0.0), np.where(inside[:, None], y, 0.0)
    column, row = x.astype(np.int64), y.astype(np.int64)
    s, t = x - column, y - row
    first = row * width + column
    row_of = slots[:, None]
    below = np.where(inside[:, None], first + width, first)
    beside = np.where(inside[:, None], 1, 0)
    grey = arena.grey
    top = grey[row_of, first] * (1 - s) + grey[row_of, first + beside] * s
    bottom = grey[row_of, below] * (1 - s) + grey[row_of, below + beside] * s
    return top * (1 - t) + bottom * t, inside
