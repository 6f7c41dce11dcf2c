"""Plain table tops, which nothing can match, laid where their rims lie.

The top of a white table has no known point but for its rim and for what lies at the foot of the
things on it. Both are level, and so they tell at what height the top is, although they are too few,
and lie too much like an edge, to be found as a plane among all that is known. So heights above a
level plane of the scene are sought at which half of what is known of plain patches lies, in several
views; and in each view such a patch is laid there, between what is known of it and no farther: the
wall behind a chest begins at the chest's height, too.

Symbols as in `stereo.planes`: planes [P, 4] (n, d) with n . X = d, n of length 1, in the world.
Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.morphology import convex_hull_image
from skimage.segmentation import expand_labels

from pipelines.nerf.stereo.maps import back_project
from pipelines.nerf.stereo.patches import Labels
from pipelines.nerf.stereo.planes import (
    LEVEL,
    ON_PLANE,
    Depths,
    Floats,
    fitted,
    inverse_depths,
    levels_of,
    ray_grid,
)
from pipelines.nerf.stereo.views import StereoView

Bools = NDArray[np.bool_]

_LEAST_AREA, _MOST_KNOWN, _LEAST_KNOWN, _LEAST_ON = 0.01, 0.8, 30, 0.5
"""A patch counts if it is so large, of the picture, less than that of it is known, as then it has
texture, but so many pixels are; it lies at a height if that share of these does."""
_MOST_POINTS = 400
"""Of a patch, for the height."""
_LEAST_ROUND = 0.5
"""Of a patch, so much lies between what is known of it at that height: a rim goes round a top, and
does not only pass by it below."""
_LEAST_VIEWS, _LEAST_VIEW_SHARE, _MOST_TOPS = 3, 0.05, 4
_STEPS_PER_DEPTH = 400
"""Heights tried, per median depth."""
_MOST_TILT_DEG = 3.0
_APART = 4.0 * ON_PLANE
"""Planes nearer to each other than this, by the depth, are one."""
_FATTENED_PX = 8
"""Matching takes squares and carries depths on, so what lies within so many pixels of a patch's
border may have the depth that is beyond it."""


@dataclass(frozen=True)
class _Rim:
    """Some of what is known of a plain patch: points [K, 3], world, with their depths [K]; of which
    view, and that camera's place [3].
    """

    view: int
    eye: Floats
    points: Floats
    depths: Floats


class Rims:
    """What is known of the plain patches of all views, gathered view by view."""

    def __init__(self) -> None:
        self._rims: list[_Rim] = []
        self._num_views = 0

    def add(self, view: StereoView, z: Depths, patches: Labels) -> None:
        """The next view's. patches: [H, W], of its picture."""
        for patch in _open_patches(z, patches):
            known = np.flatnonzero((patches == patch) & (z > 0))
            some = known[np.linspace(0, len(known) - 1, min(len(known), _MOST_POINTS)).astype(int)]
            chosen = np.zeros_like(z)
            chosen.flat[some] = z.flat[some]
            depths = z.flat[some].astype(np.float64)
            self._rims.append(
                _Rim(self._num_views, view.center, back_project(view, chosen), depths)
            )
        self._num_views += 1

    def tops(self, normal: Floats, floors: Floats) -> Floats:
        """The planes [T, 4] about at right angles to `normal`, upwards, that plain patches lie on
        by what is known of them, the one of most views first.

        floors: planes [P, 4] that are none: what is plain and stands on a floor has it for a rim.
        """
        left, found = list(self._rims), np.zeros((0, 4))
        floors = floors * np.sign(floors[:, :3] @ normal)[:, None]
        for _ in range(_MOST_TOPS):
            height = self._best_height(left, normal)
            if height is None:
                break
            members = [rim for rim in left if _share_at(rim, normal, height) >= _LEAST_ON]
            if not members:
                break
            left = [rim for rim in left if not any(rim is member for member in members)]
            points = np.concatenate([rim.points for rim in members])
            depths = np.concatenate([rim.depths for rim in members])
            plane = _fitted_to(points, depths, np.append(normal, height))
            own = _on(plane, points, depths)
            known = np.concatenate([floors, found])
            apart = np.abs(points[own] @ known[:, :3].T - known[:, 3]) / depths[own, None]
            if not (np.median(apart, axis=0) < _APART).any():
                found = np.concatenate([found, plane[None]])
        return found

    def _best_height(self, rims: Sequence[_Rim], normal: Floats) -> float | None:
        """That at which most patches lie, if they are of enough views."""
        if not rims:
            return None
        heights = [rim.points @ normal for rim in rims]
        step = float(np.median(np.concatenate([rim.depths for rim in rims]))) / _STEPS_PER_DEPTH
        low = min(float(height.min()) for height in heights) - step
        high = max(float(height.max()) for height in heights) + step
        num = min(int((high - low) / step) + 2, 200_000)
        at_views = np.zeros((self._num_views, num), bool)
        for rim, height in zip(rims, heights, strict=True):
            reach = 2.0 * ON_PLANE * rim.depths
            begin = np.clip(np.ceil((height - reach - low) / step), 0, num - 1).astype(int)
            end = np.clip(np.floor((height + reach - low) / step) + 1, 0, num - 1).astype(int)
            count = np.bincount(begin, minlength=num) - np.bincount(end, minlength=num)
            below = np.arange(num) * step + low < rim.eye @ normal
            at_views[rim.view] |= below & (np.cumsum(count) >= _LEAST_ON * len(height))
        num_views = at_views.sum(axis=0)
        most = int(num_views.max())
        if most < max(_LEAST_VIEWS, _LEAST_VIEW_SHARE * self._num_views):
            return None
        return low + step * _middle_of_longest_run(np.flatnonzero(num_views == most))


def _middle_of_longest_run(numbers: NDArray[np.int64]) -> float:
    """Of rising numbers, the middle one of the longest row that has no gaps."""
    runs = np.split(numbers, np.flatnonzero(np.diff(numbers) != 1) + 1)
    longest = max(runs, key=len)
    return float(longest[len(longest) // 2])


def upwards(up: Floats, planes: Floats) -> Floats | None:
    """The normal [3], as up [3] as can be, of the first of the planes [P, 4] that is about level,
    if any."""
    levels = levels_of(up, planes)
    flat = np.flatnonzero(np.abs(levels) >= LEVEL)
    if not len(flat):
        return None
    normal: Floats = planes[flat[0], :3] * np.sign(levels[flat[0]])
    return normal


def laid_on_tops(view: StereoView, z: Depths, tops: Floats, patches: Labels) -> Depths:
    """A depth map [H, W] with its plain patches on those of the tops [T, 4], below the camera, that
    half of what is known of them lies on, between these pixels.

    Known pixels stay where they are before the top, as a cup would be, but not where the depth is
    that of what lies beyond the patch's border, close by. Nothing is seen through a top.
    """
    laid = z.copy()
    hull_of: Any = convex_hull_image
    inverses = inverse_depths(view, tops, *ray_grid(view))
    off = np.stack([np.abs(_heights(view, z, top)) for top in tops])
    off[tops[:, :3] @ view.center <= tops[:, 3]] = np.inf
    for patch in _open_patches(z, patches):
        own = patches == patch
        near = own & (z > 0) & (off < 2.0 * ON_PLANE * z)
        best = int(near.sum(axis=(1, 2)).argmax())
        if near[best].sum() < _LEAST_ON * (own & (z > 0)).sum():
            continue
        inverse = inverses[best]
        within = own & hull_of(near[best])
        if within.sum() < _LEAST_ROUND * own.sum():
            continue
        within &= (inverse > 1e-9) & (view.picture >= 0.0)
        is_behind = z * inverse > 1.0
        within &= (z == 0) | near[best] | is_behind | _carried_in(z, own)
        laid[within] = (1.0 / inverse[within]).astype(np.float32)
    return laid


def _heights(view: StereoView, z: Depths, top: Floats) -> Floats:
    """[H, W]: how far above a plane each known pixel's point is."""
    x, y = ray_grid(view)
    a, b, c = top[:3] @ view.world_from_camera[:, :3]
    heights: Floats = z * (a * x + b * y + c) + (top[:3] @ view.center - top[3])
    return heights


def _carried_in(z: Depths, own: Bools) -> Bools:
    """[H, W]: where a patch has the depth that is known beyond its border, close by."""
    places = np.arange(z.size).reshape(z.shape) + 1
    expand: Any = expand_labels
    nearest = expand(np.where((z > 0) & ~own, places, 0), _FATTENED_PX)
    beyond = z.ravel()[nearest - 1]
    same = np.abs(z - beyond) < 2.0 * ON_PLANE * beyond
    carried: Bools = own & (z > 0) & (nearest > 0) & same
    return carried


def _open_patches(z: Depths, patches: Labels) -> NDArray[np.int64]:
    num = int(patches.max()) + 1
    area = np.bincount(patches.ravel(), minlength=num)
    known = np.bincount(patches[z > 0], minlength=num)
    large = area >= _LEAST_AREA * patches.size
    return np.flatnonzero(large & (known >= _LEAST_KNOWN) & (known < _MOST_KNOWN * area))


def _share_at(rim: _Rim, normal: Floats, height: float) -> float:
    return float((np.abs(rim.points @ normal - height) <= 2.0 * ON_PLANE * rim.depths).mean())


def _fitted_to(points: Floats, depths: Floats, level: Floats) -> Floats:
    """The plane [4] near `level` that most of the points lie on, half as tilted as they have it.

    A rim is carried inwards, so that of a top seen from one side the near part seems to be higher
    and the far part lower; and what is level in a capture is known to a degree only.
    """
    tilted = level
    for _ in range(5):
        at = _on(tilted, points, depths)
        if at.sum() < _LEAST_KNOWN:
            break
        tilted = fitted(points[at], 1.0 / depths[at])
        tilted = tilted * np.sign(tilted[:3] @ level[:3])
    if tilted[:3] @ level[:3] < np.cos(np.radians(_MOST_TILT_DEG)):
        tilted = level
    normal = tilted[:3] + level[:3]
    normal /= np.linalg.norm(normal)
    at = _on(tilted, points, depths)
    return np.append(normal, np.median((points @ normal)[at])) if at.any() else level


def _on(plane: Floats, points: Floats, depths: Floats) -> Bools:
    on: Bools = np.abs(points @ plane[:3] - plane[3]) < ON_PLANE * depths
    return on
