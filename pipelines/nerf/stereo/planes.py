"""Plain surfaces, which nothing can match, completed by the planes that the whole scene shows.

A white wall says nothing of where it is, in no view; but its skirting board, a picture on it and
its corners do, each in some view. So planes are sought among the known depths of **all** views, and
in each view a patch of even brightness whose known pixels lie on one of them is taken to lie on it
as a whole, unless other views see through it. Sources: Gallup, Frahm, Pollefeys, "Piecewise Planar
and Non-Planar Stereo", CVPR 2010; Romanoni, Matteucci, "TAPA-MVS", arXiv:1903.10929.

Symbols: V views, P planes (n, d) with n . X = d, n of length 1, in the world. Depth is along the
camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.stereo.maps import DepthMap
from pipelines.nerf.stereo.patches import Labels
from pipelines.nerf.stereo.shelves import ByView
from pipelines.nerf.stereo.views import StereoView

Depths = NDArray[np.float32]
Floats = NDArray[np.float64]

_SAMPLES_PER_VIEW, _MOST_SAMPLES = 800, 30_000
_NORMAL_RADIUS = 3
_MIN_VOTES = 2
ON_PLANE, _ALIGNED = 0.01, 0.9
"""How near a point is to its plane, relative to its depth; |cosine| between their normals."""
_MOST_PLANES, _HYPOTHESES, _LEAST_SHARE = 24, 300, 0.01
_MIN_KNOWN, _MIN_SHARE = 30, 0.5
ON_A_LINE, _OF_PATCH, _WELL_KNOWN = 0.1, 0.3, 0.3
"""Places are on a line up to this ratio of their axes. What is known of a patch along one line, as
the next wall is in their corner, says nothing of it, unless the patch is little rounder itself, or
that is so much of it."""
LEVEL = 0.8
"""A plane is about level from this cosine between its normal and up on."""
_BELOW, _MOST_BELOW = 0.03, 0.02
"""Of known points, so many may seem to lie below a floor by so much of their depth."""
_EXTRAPOLATED = 3.0
"""How much nearer or farther than all its known pixels a patch may reach."""


def planes_and_samples(
    views: Sequence[StereoView],
    maps: ByView[DepthMap],
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> tuple[Floats, Floats, Floats]:
    """The planes [P, 4] (n, d) that most of the known surfaces lie on, largest first; and some of
    the points that the maps know, [K, 3], world, with their depths [K].

    One after the other by RANSAC over points with their normals; each has at least 1 % of them.
    on_progress: told the share that is done; may raise.
    """
    rng = np.random.default_rng(0)
    every = _samples(views, maps, rng, on_progress)
    points, normals, depths = every
    least = max(_LEAST_SHARE * len(points), _MIN_KNOWN)
    planes: list[Floats] = []
    while len(points) >= least and len(planes) < _MOST_PLANES:
        tried = rng.choice(len(points), min(_HYPOTHESES, len(points)), replace=False)
        candidates = np.column_stack(
            [normals[tried], np.einsum("kc,kc->k", normals[tried], points[tried])]
        )
        counts = [_on_plane(plane, points, normals, depths).sum() for plane in candidates]
        plane = candidates[int(np.argmax(counts))]
        for _ in range(3):
            members = _on_plane(plane, points, normals, depths)
            if members.sum() < _MIN_KNOWN:
                break
            plane = fitted(points[members], 1.0 / depths[members])
        if _on_plane(plane, points, normals, depths).sum() < least:
            break
        planes.append(plane)
        rest = ~_on_plane(plane, points, normals, depths, slack=2.0)
        points, normals, depths = points[rest], normals[rest], depths[rest]
    return np.array(planes).reshape(-1, 4), every[0], every[2]


def up_of(views: Sequence[StereoView]) -> Floats:
    """Which way is up, [3], unit, where nothing else says so: as the pictures have it in the mean.

    Of pictures that are stored on their side, or look straight down, that is wrong.
    """
    up: Floats = np.mean([-view.world_from_camera[:, 1] for view in views], axis=0)
    return up / max(float(np.linalg.norm(up)), 1e-12)


def levels_of(up: Floats, planes: Floats) -> Floats:
    """[P], the cosine between each plane's n and up [3]: 1 or -1 of a level one."""
    cosines: Floats = planes[:, :3] @ up
    return cosines


def floors_of(up: Floats, planes: Floats, points: Floats, depths: Floats) -> list[int]:
    """Numbers of the planes that are about level, and below which nothing is known.

    up: [3]. points: [K, 3], with their depths [K].
    """
    found = []
    for number, (plane, level) in enumerate(zip(planes, levels_of(up, planes), strict=True)):
        height = (points @ plane[:3] - plane[3]) * np.sign(level)
        if abs(level) >= LEVEL and (height < -_BELOW * depths).mean() <= _MOST_BELOW:
            found.append(number)
    return found


def laid_on_planes(view: StereoView, z: Depths, planes: Floats, patches: Labels) -> Depths:
    """A depth map [H, W] whose patches lie on the planes that their known pixels lie on.

    planes: [P, 4]. patches: [H, W], of the picture. A patch goes to the plane that most of its
    known pixels are within 2 % of, if half of them are and they are not all on one line.
    """
    offsets = planes[:, 3] - planes[:, :3] @ view.center
    apart = np.abs(offsets) > 1e-9
    if not apart.any():
        return z
    # Along a ray to z = 1, the inverse depth of a plane is linear in the ray.
    turned = planes[apart, :3] @ view.world_from_camera[:, :3] / offsets[apart, None]
    x, y = (axis.astype(np.float64) for axis in view.rays())
    known = z > 0
    inverse = np.where(known, 1.0 / np.where(known, z, 1.0), 0.0)
    num_patches = int(patches.max()) + 1

    def near(found: Floats) -> NDArray[np.bool_]:
        return known & (np.abs(found - inverse) < 2.0 * ON_PLANE * inverse)

    num_near = np.stack(
        [
            np.bincount(patches[near(x * a + (y * b + c)[:, None])], minlength=num_patches)
            for a, b, c in turned
        ],
        axis=-1,
    )
    num_known = np.bincount(patches[known], minlength=num_patches)
    decided = (num_known >= _MIN_KNOWN) & (num_near.max(axis=-1) >= _MIN_SHARE * num_known)
    chosen = turned[num_near.argmax(axis=-1)][patches]
    found = x * chosen[..., 0] + y[:, None] * chosen[..., 1] + chosen[..., 2]
    supported = near(found)
    columns, rows = np.broadcast_arrays(x, y[:, None])
    across, of_patch = (
        roundness(patches[at], columns[at], rows[at], num_patches)
        for at in (supported, np.ones_like(supported))
    )
    on_a_line = across <= np.minimum(ON_A_LINE, _OF_PATCH * of_patch)
    num_pixels = np.bincount(patches.ravel(), minlength=num_patches)
    decided &= ~on_a_line | (num_known > _WELL_KNOWN * num_pixels)
    nearest, farthest = np.zeros(num_patches), np.full(num_patches, np.inf)
    np.maximum.at(nearest, patches[supported], inverse[supported])
    np.minimum.at(farthest, patches[supported], inverse[supported])
    within = found < _EXTRAPOLATED * nearest[patches]
    within &= found > np.maximum(farthest[patches] / _EXTRAPOLATED, 1e-12)
    fills = ~known & within & (view.picture >= 0.0)
    moves = known & (np.abs(found - inverse) < ON_PLANE * inverse)
    taken = decided[patches] & (fills | moves)
    laid: Depths = np.where(taken, 1.0 / np.where(taken, found, 1.0), z).astype(np.float32)
    return laid


def roundness(labels: NDArray[np.integer[Any]], x: Floats, y: Floats, num: int) -> Floats:
    """[num]: of the places (x, y) [K] with each label from 0 on, the shorter of their axes by the
    longer one, in [0, 1]; 0 where all are on a line, or none is.
    """
    count = np.maximum(np.bincount(labels, minlength=num), 1)

    def mean(values: Floats) -> Floats:
        return np.bincount(labels, values, num) / count

    middle_x, middle_y = mean(x), mean(y)
    x, y = x - middle_x[labels], y - middle_y[labels]
    xx, yy, xy = mean(x * x), mean(y * y), mean(x * y)
    half = np.hypot((xx - yy) / 2.0, xy)
    longer = (xx + yy) / 2.0 + half
    shorter = np.maximum((xx + yy) / 2.0 - half, 0.0)
    ratio: Floats = np.sqrt(shorter / np.maximum(longer, 1e-30))
    return ratio


def inverse_depths(view: StereoView, planes: Floats, x: Floats, y: Floats) -> Floats:
    """[P, ...], 1 / z of each plane along rays to (x, y, 1); not positive where a ray misses it."""
    apart = planes[:, 3] - planes[:, :3] @ view.center
    apart = np.where(np.abs(apart) < 1e-9, 1e-9, apart)
    turned = planes[:, :3] @ view.world_from_camera[:, :3] / apart[:, None]
    return np.stack([x * a + (y * b + c) for a, b, c in turned])


def ray_grid(view: StereoView) -> tuple[Floats, Floats]:
    """x [W] and y [H, 1] of the pixels' rays."""
    x, y = view.rays()
    return x.astype(np.float64), y.astype(np.float64)[:, None]


def _rays(view: StereoView) -> Floats:
    """[H, W, 3], to z = 1 in the camera's frame."""
    x, y = view.rays()
    height, width = view.picture.shape
    return np.stack(
        [
            np.broadcast_to(x[None, :], (height, width)),
            np.broadcast_to(y[:, None], (height, width)),
            np.ones((height, width)),
        ],
        axis=-1,
    ).astype(np.float64)


def _samples(
    views: Sequence[StereoView],
    maps: ByView[DepthMap],
    rng: np.random.Generator,
    on_progress: Callable[[float], None],
) -> tuple[Floats, Floats, Floats]:
    """(points [K, 3], unit normals [K, 3], both world; depths [K]) of some of the known pixels."""

    def look(index: int) -> tuple[DepthMap, Floats, Floats, NDArray[np.int64]]:
        found, rays = maps[index], _rays(views[index])
        normal, sure = _normals(rays, found.z)
        return found, rays, normal, np.flatnonzero(sure & (found.votes >= _MIN_VOTES))

    points, normals, depths = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    looks = each_ahead(look, range(len(views)))
    for done, (view, seen) in enumerate(zip(views, looks, strict=True), start=1):
        on_progress(done / len(views))
        found, rays, normal, usable = seen
        picked = rng.choice(usable, min(len(usable), _SAMPLES_PER_VIEW), replace=False)
        depth = found.z.ravel()[picked].astype(np.float64)
        turn = view.world_from_camera[:, :3]
        points.append(rays.reshape(-1, 3)[picked] * depth[:, None] @ turn.T + view.center)
        normals.append(normal.reshape(-1, 3)[picked] @ turn.T)
        depths.append(depth)
    every = np.concatenate(points), np.concatenate(normals), np.concatenate(depths)
    if len(every[0]) <= _MOST_SAMPLES:
        return every
    some = rng.choice(len(every[0]), _MOST_SAMPLES, replace=False)
    return every[0][some], every[1][some], every[2][some]


def _normals(rays: Floats, z: Depths) -> tuple[Floats, NDArray[np.bool_]]:
    """Unit normals [H, W, 3] in the camera's frame, and where there are any [H, W].

    By least squares of 1/z = a x + b y + c over the known pixels of a square around each, at least
    half of it: on a plane that is exact, and (a, b, c) is its normal.
    """
    known = z > 0
    inverse = np.where(known, 1.0 / np.where(known, z, 1.0), 0.0)
    weight = known.astype(np.float64)
    count = _box_sums(weight)
    filled = np.maximum(count, 1.0)

    def mean(values: Floats) -> Floats:
        return _box_sums(values * weight) / filled

    x, y = rays[..., 0], rays[..., 1]
    mean_x, mean_y, mean_i = mean(x), mean(y), mean(inverse)
    xx, yy = mean(x * x) - mean_x**2, mean(y * y) - mean_y**2
    xy = mean(x * y) - mean_x * mean_y
    xi, yi = mean(x * inverse) - mean_x * mean_i, mean(y * inverse) - mean_y * mean_i
    spread = xx * yy - xy * xy
    side = 2 * _NORMAL_RADIUS + 1
    sure = known & (count > 0.5 * side * side) & (spread > 1e-14)
    safe = np.where(sure, spread, 1.0)
    a, b = (xi * yy - yi * xy) / safe, (yi * xx - xi * xy) / safe
    normal = np.stack([a, b, mean_i - a * mean_x - b * mean_y], axis=-1)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return normal / np.maximum(length, 1e-12), sure & (length[..., 0] > 1e-12)


def _box_sums(values: Floats) -> Floats:
    """[H, W] sums over squares of side 2 _NORMAL_RADIUS + 1, cut at the border."""
    radius = _NORMAL_RADIUS
    height, width = values.shape
    sums = np.zeros((height + 1, width + 1))
    np.cumsum(np.cumsum(values, axis=0), axis=1, out=sums[1:, 1:])
    top, bottom = (np.clip(np.arange(height) + d, 0, height) for d in (-radius, radius + 1))
    left, right = (np.clip(np.arange(width) + d, 0, width) for d in (-radius, radius + 1))
    rows = sums[bottom] - sums[top]
    boxes: Floats = rows[:, right] - rows[:, left]
    return boxes


def _on_plane(
    plane: Floats, points: Floats, normals: Floats, depths: Floats, slack: float = 1.0
) -> NDArray[np.bool_]:
    """[K]: which points lie on the plane and face as it does."""
    away = np.abs(points @ plane[:3] - plane[3])
    aligned = np.abs(normals @ plane[:3]) > 1.0 - slack * (1.0 - _ALIGNED)
    on: NDArray[np.bool_] = (away < slack * ON_PLANE * depths) & aligned
    return on


def fitted(points: Floats, weights: Floats) -> Floats:
    """The plane [4] of least weighted squared distance to the points [K, 3]."""
    middle = weights @ points / weights.sum()
    _, _, axes = np.linalg.svd((points - middle) * weights[:, None], full_matrices=False)
    return np.append(axes[2], axes[2] @ middle)
