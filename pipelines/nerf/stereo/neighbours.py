"""Which views a view is compared with, and how far its surfaces may be.

Both follow from 3D points that are known beforehand: of structure from motion, or of a first coarse
pass. Symbols: V views, P points.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.stereo.neighbours import pair_scores_fast
from pipelines.nerf.stereo.views import StereoView, camera_extent

Floats = NDArray[np.float64]

_BELOW_DEG, _ABOVE_DEG = 2.0, 10.0
"""How fast the liking for an angle falls below and above the best one."""
_MAX_AXIS_DEG = 45.0
_LEAST_SCORE = 0.02
_MIN_POINTS = 20
_NEAREST, _FARTHEST = 0.6, 3.0
"""Beyond the points' own range: surfaces without texture have no points."""
_PARTS, _BEHIND = (6, 8), 1.5
"""Rows and columns of a picture's parts, and how many times as far a point may be as the nearest
in its part to be seen with it."""
_HIDDEN = 0.4
"""What share of the points that pictures hold must be behind something for that to be heeded: it
is .61 and .75 in flats of 4 and 9 rooms, and .00 to .37 in single rooms, outdoors and around
things, where hardly anything would change."""
_DIRECTIONS = 8_000_000
"""From views to points, 24 bytes each: both grow with the number of photos."""
_NEAR_PERCENTILE, _FAR_PERCENTILE = 1.0, 99.0


def choose_neighbours(
    views: Sequence[StereoView], points: Floats, count: int, best_angle_deg: float
) -> list[list[int]]:
    """For each view, at most `count` others that see the same points from a good angle.

    points: [P, 3]. The score of a pair is the share of the view's points that the other sees too,
    each weighted by exp(-(angle - best)^2 / (2 s^2)) of the angle at the point between both, with s
    2 degrees below the best angle and 10 above. Source: MVSNet, arXiv:1804.02505, section 4.1.
    Where two fifths of what pictures hold are behind something, what a view sees is
    `seen_before_others`.
    """
    centers = np.array([view.center for view in views])
    axes = np.array([view.axis for view in views])
    shown = np.array([view.seen(points)[1] for view in views])
    before = np.array([seen_before_others(view, points)[1] for view in views])
    if before.sum() < (1.0 - _HIDDEN) * shown.sum():
        shown = before
    facing = axes @ axes.T > np.cos(np.radians(_MAX_AXIS_DEG))
    scores = np.zeros((len(views), len(views)))
    for some in _portions(len(points), len(views)):
        toward = points[None, some] - centers[:, None]
        toward /= np.maximum(np.linalg.norm(toward, axis=-1, keepdims=True), 1e-12)
        held = np.ascontiguousarray(shown[:, some])
        found = pair_scores_fast(toward, held, facing, best_angle_deg, (_BELOW_DEG, _ABOVE_DEG))
        part = held.sum(axis=1) / np.maximum(shown.sum(axis=1), 1)
        scores += part[:, None] * found
    chosen = []
    for index, score in enumerate(scores):
        if not shown[index].any():
            chosen.append(_nearest(centers, facing, index, count))
            continue
        order = np.argsort(-score, kind="stable")[:count]
        chosen.append([int(other) for other in order if score[other] > _LEAST_SCORE])
    return chosen


def _portions(num_points: int, num_views: int) -> list[slice]:
    """The points in portions whose directions from all views are held at a time."""
    size = max(1, _DIRECTIONS // max(num_views, 1))
    return [slice(first, first + size) for first in range(0, num_points, size)]


def pair_scores(
    toward: Floats,
    shown: NDArray[np.bool_],
    facing: NDArray[np.bool_],
    best_angle_deg: float,
    spread_deg: tuple[float, float],
) -> Floats:
    """The scores [V, V] of `choose_neighbours`, of the first with the second; its definition.

    toward: [V, P, 3], unit, from each view's centre to each point. shown: [V, P], whether the view
    has it in its picture. facing: [V, V]; pairs that look elsewhere score 0. spread_deg: s below
    and above the best angle.
    """
    scores = np.zeros((len(shown), len(shown)))
    for index, mine in enumerate(shown):
        if not mine.any():
            continue
        cosines = np.einsum("vpc,pc->vp", toward[:, mine], toward[index, mine])
        angles = np.degrees(np.arccos(np.clip(cosines, -1.0, 1.0)))
        spread = np.where(angles < best_angle_deg, *spread_deg)
        liked = np.exp(-0.5 * ((angles - best_angle_deg) / spread) ** 2) * shown[:, mine]
        scores[index] = liked.mean(axis=1) * facing[index]
    np.fill_diagonal(scores, 0.0)
    return scores


def _nearest(centers: Floats, facing: NDArray[np.bool_], index: int, count: int) -> list[int]:
    """The nearest views that look the same way, for a view that no known point is in."""
    distance = np.linalg.norm(centers - centers[index], axis=1)
    distance[~facing[index]] = np.inf
    distance[index] = np.inf
    order = np.argsort(distance, kind="stable")[:count]
    return [int(other) for other in order if np.isfinite(distance[other])]


def seen_before_others(view: StereoView, points: Floats) -> tuple[Floats, NDArray[np.bool_]]:
    """Depths [P] of world points [P, 3], and which of them the picture shows, but for those that
    are clearly behind another one in their part of it.

    A wall hides the next room, whose cameras have all of this one's points in their pictures.
    """
    depths, u, v, shown = view.projected(points)
    rows, columns = _PARTS
    height, width = view.picture.shape
    there = np.flatnonzero(shown)
    part = (v[there] * rows / height).astype(np.int64) * columns
    part += (u[there] * columns / width).astype(np.int64)
    nearest = np.full(rows * columns, np.inf)
    np.minimum.at(nearest, part, depths[there])
    seen = shown.copy()
    seen[there] = depths[there] <= _BEHIND * nearest[part]
    return depths, seen


def depth_range(view: StereoView, points: Floats) -> tuple[float, float] | None:
    """(nearest, farthest) depth worth trying, world units; None where too few points tell.

    The nearest by what is `seen_before_others`, if that leaves out much. The farthest by all
    points, as through a fence something is seen, too; planes even in inverse depth are few out
    there.
    """
    depths, shown = view.seen(points)
    if shown.sum() < _MIN_POINTS:
        return None
    _, seen = seen_before_others(view, points)
    if seen.sum() >= (1.0 - _HIDDEN) * shown.sum():
        seen = shown
    near = np.percentile(depths[seen], _NEAR_PERCENTILE)
    far = np.percentile(depths[shown], _FAR_PERCENTILE)
    return _NEAREST * float(near), _FARTHEST * float(far)


def spread_apart(views: Sequence[StereoView], count: int) -> list[list[int]]:
    """Neighbours where nothing is known of the scene yet: at baselines of all useful lengths.

    Of the views that look nearly the same way, `count` at distances even in logarithm from 1/50 to
    1/3 of the cameras' extent.
    """
    centers = np.array([view.center for view in views])
    axes = np.array([view.axis for view in views])
    extent = camera_extent(views)
    wanted = extent * np.geomspace(1.0 / 50.0, 1.0 / 3.0, count)
    chosen = []
    for index in range(len(views)):
        distance = np.linalg.norm(centers - centers[index], axis=1)
        usable = axes @ axes[index] > np.cos(np.radians(_MAX_AXIS_DEG))
        usable &= distance > extent * 1e-4
        found: list[int] = []
        for length in wanted:
            gap = np.where(usable, np.abs(np.log(np.maximum(distance, 1e-12) / length)), np.inf)
            best = int(gap.argmin())
            if np.isfinite(gap[best]):
                found.append(best)
                usable[best] = False
        chosen.append(found)
    return chosen
