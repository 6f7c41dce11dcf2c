"""Which views a view is compared with, and how far its surfaces may be.

Both follow from 3D points that are known beforehand: of structure from motion, or of a first coarse
pass. Symbols: V views, P points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

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
_LEAST_IN_PART = 0.1
"""Of the mean number of points, so many make a part one where something is known."""
_ENOUGH, _LEAST_GAIN = 2.0, 0.15
"""Neighbours at the best angle that are enough for a part; and how much of that, in parts of the
whole picture, one must bring to be chosen for it."""
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
    chosen, cameras = [], _Cameras.of(views)
    for index, score in enumerate(scores):
        if not shown[index].any():
            chosen.append(_nearest(centers, facing, index, count))
            continue
        parts = _Parts.of(views[index], points, shown[index])
        chosen.append(_covering(parts.liked_by(cameras, best_angle_deg), score, count))
    return chosen


@dataclass(frozen=True)
class _Parts:
    """The middles [K, 3] of those parts of a picture where nothing is known, as far away as what is
    known close by; and where the view is, [3]."""

    middles: Floats
    eye: Floats

    @classmethod
    def of(cls, view: StereoView, points: Floats, shown: NDArray[np.bool_]) -> _Parts:
        """shown: [P], which of the points the view sees; at least one."""
        depths, u, v, _ = view.projected(points[shown])
        rows, columns = _PARTS
        height, width = view.picture.shape
        row = np.minimum((v * rows / height).astype(np.int64), rows - 1)
        column = np.minimum((u * columns / width).astype(np.int64), columns - 1)
        down, across = np.divmod(np.arange(rows * columns), columns)
        depth = np.zeros(rows * columns)
        count = np.bincount(row * columns + column, minlength=rows * columns)
        known = np.flatnonzero(count >= _LEAST_IN_PART * len(depths) / len(count))
        for part in known:
            depth[part] = np.median(depths[(row == down[part]) & (column == across[part])])
        empty = np.setdiff1d(np.arange(rows * columns), known)
        down, across = down[empty], across[empty]
        far = (down[:, None] - known // columns) ** 2 + (across[:, None] - known % columns) ** 2
        depth = depth[known[far.argmin(axis=1)]]
        fx, fy, cx, cy = view.lens
        x = ((across + 0.5) * width / columns - cx) / fx
        y = ((down + 0.5) * height / rows - cy) / fy
        local = np.stack([x, y, np.ones(len(x))], axis=-1) * depth[:, None]
        return cls(local @ view.world_from_camera[:, :3].T + view.center, view.center)

    def liked_by(self, others: _Cameras, best_angle_deg: float) -> Floats:
        """[V, K]: how good each view's angle is to each part that it has in its picture; else 0."""
        mine, yours = self.middles - self.eye, self.middles - others.centers[:, None]
        lengths = np.linalg.norm(mine, axis=-1) * np.linalg.norm(yours, axis=-1)
        cosine = np.einsum("kc,vkc->vk", mine, yours) / np.maximum(lengths, 1e-12)
        angle = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
        spread = np.where(angle < best_angle_deg, _BELOW_DEG, _ABOVE_DEG)
        liked: Floats = np.exp(-0.5 * ((angle - best_angle_deg) / spread) ** 2)
        return liked * others.show(yours)


@dataclass(frozen=True)
class _Cameras:
    """All views': centers [V, 3], turns [V, 3, 3] of their frames in the world, lenses [V, 4] as
    `StereoView.lens`, sizes [V, 2], width and height."""

    centers: Floats
    turns: Floats
    lenses: Floats
    sizes: Floats

    @classmethod
    def of(cls, views: Sequence[StereoView]) -> _Cameras:
        """Those of the views."""
        return cls(
            np.stack([view.center for view in views]),
            np.stack([view.world_from_camera[:, :3] for view in views]),
            np.array([view.lens for view in views]),
            np.array([view.picture.shape[::-1] for view in views], np.float64),
        )

    def show(self, away: Floats) -> NDArray[np.bool_]:
        """[V, K]: which places each picture shows. away: [V, K, 3], from each view's centre."""
        x, y, z = np.moveaxis(np.matmul(away, self.turns), -1, 0)
        ahead = np.where(z > 0, z, np.inf)
        fx, fy, cx, cy = self.lenses.T[..., None]
        u, v = fx * x / ahead + cx, fy * y / ahead + cy
        width, height = self.sizes.T[..., None]
        shown: NDArray[np.bool_] = (z > 0) & (u >= 0) & (v >= 0) & (u < width) & (v < height)
        return shown


def _covering(liked: Floats, score: Floats, count: int) -> list[int]:
    """The views of the best scores [V]; but of the later half each one that sees parts without
    points which too few of those before it see, if there is any.

    What is plain has no points: by these alone all of them may look past it. liked: [V, K], as of
    `_Parts.liked_by`.
    """
    order = [int(o) for o in np.argsort(-score, kind="stable") if score[o] > _LEAST_SCORE]
    chosen = order[: count - count // 2]
    covered = liked[chosen].sum(axis=0)
    while len(chosen) < count:
        gain = np.minimum(np.maximum(_ENOUGH - covered, 0.0), liked).sum(axis=1)
        gain[chosen] = 0.0
        gain[score <= _LEAST_SCORE] = 0.0
        best = int(gain.argmax())
        if gain[best] < _LEAST_GAIN * np.prod(_PARTS):
            break
        chosen.append(best)
        covered += liked[best]
    rest = [other for other in order if other not in chosen]
    return chosen + rest[: count - len(chosen)]


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
