"""The dark, in which nothing can be known.

Who takes pictures of a thing before black cloth, or by one lamp, has its surroundings black in all
of them. That is plain: matching carries the thing's depth into it, views agree, and a black sheet
hangs around the thing, as sheets of sky do. A black patch of a picture shows either
nothing, or the thing's unlit side. Surfaces tell which: what other views see lit, and hardly any
view has for black, is solid, and a black pixel before or behind it is no look past the thing.

Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.maps import back_project
from pipelines.nerf.stereo.patch_colors import (
    Bools,
    Bytes,
    Floats,
    PatchColors,
)
from pipelines.nerf.stereo.patches import Labels, shelved_patches
from pipelines.nerf.stereo.shelves import ByView, Shelf
from pipelines.nerf.stereo.views import StereoView
from pipelines.nerf.stereo.void import is_measured

_MOST_BRIGHT, _MOST_SPREAD = 0.12, 0.04
"""Of colours: the mean of the brightest channel; standard deviation."""
_LEAST_SHARE, _LEAST_VIEWS, _MOST_MASKED = 0.15, 0.5, 0.2
"""So much of all pictures is black, and so many of them show some of it; no more of them is masked,
as what is around a thing that somebody has cut out is nothing anyhow, and the thing may be black.
The blackest of the rooms at hand has 5 % of such patches, a thing before black cloth 30 to 60 %."""
_POINTS_PER_PX, _MOST_DARK, _BESIDE = 10.0, 0.2, 0.5
"""Points on surfaces that are asked, in all, per pixel of one picture: enough for one taken from a
third of the distance. A solid one is black in no more of the views that look at it from the same
side as the one that has it, by the cosine of the angle between them. From the other side one may
see an unlit back of it."""
_LEAST_SOLID = 5
"""Pixels of a square of nine with solid points, where its middle is not nothing."""
_BLACK_SHARE, _SOLID_SHARE = 0.5, 0.9
"""Of the progress, at the end of each part."""


@dataclass(frozen=True)
class Dark:
    """masks: where each view's picture shows nothing but the dark, [H, W]; none where a capture
    is not filmed in it.

    share: of all pictures. num_views: with black patches.
    """

    masks: list[Bools]
    share: float
    num_views: int


def find_dark(
    views: Sequence[StereoView],
    picture_of: Callable[[int], Bytes],
    depths: ByView[NDArray[np.float32]],
    measured: Sequence[NDArray[np.float32] | None] | None = None,
    patches: Shelf | None = None,
    on_share: Callable[[float], None] = lambda done: None,
) -> Dark:
    """The dark in a capture's pictures.

    picture_of: each view's, in colour, [H, W, 3] uint8, sRGB. depths: what is known so far, wrong
    in the dark. measured: what a sensor saw, as `depths`, None for a view without. patches: a shelf
    for the pictures' `patches_of`, or with them. on_share: told the share that is done; may raise.
    """
    black = []
    for index, view in enumerate(views):
        patch_numbers = shelved_patches(view, index, patches)
        black.append(like_dark(view, picture_of(index), patch_numbers))
        on_share(_BLACK_SHARE * (index + 1) / len(views))
    nothing = [np.zeros_like(mask) for mask in black]
    num_views = sum(bool(mask.any()) for mask in black)
    share = float(np.mean([mask.mean() for mask in black]))
    masked = float(np.mean([(view.picture < 0.0).mean() for view in views]))
    too_little = num_views < _LEAST_VIEWS * len(views) or share < _LEAST_SHARE
    if too_little or masked > _MOST_MASKED:
        return Dark(nothing, 0.0, num_views)

    def on_solid(share: float) -> None:
        on_share(_BLACK_SHARE + (_SOLID_SHARE - _BLACK_SHARE) * share)

    solid = solid_points(views, depths, black, on_solid)
    masks = []
    for index, (view, mask) in enumerate(zip(views, black, strict=True)):
        masks.append(mask & ~before_solid(view, solid))
        on_share(_SOLID_SHARE + (1.0 - _SOLID_SHARE) * (index + 1) / len(views))
    if is_measured(masks, measured):
        return Dark(nothing, 0.0, num_views)
    return Dark(masks, float(np.mean([mask.mean() for mask in masks])), num_views)


def like_dark(view: StereoView, picture: Bytes, patches: Labels | None = None) -> Bools:
    """[H, W]: what of one picture is plain and black, as `find_dark` reads it.

    Patches at the picture's border, and others that look like them.
    """
    seen = PatchColors.of(view, picture, patches)
    looks = (seen.mean.max(axis=-1) <= _MOST_BRIGHT) & (seen.spread <= _MOST_SPREAD)
    looks &= seen.area > 0
    sure = looks & seen.is_large
    if not sure.any():
        return np.zeros_like(seen.there)
    return seen.with_fringes(looks & seen.alike(sure))


def solid_points(
    views: Sequence[StereoView],
    depths: ByView[NDArray[np.float32]],
    dark: Sequence[Bools],
    on_share: Callable[[float], None] = lambda done: None,
) -> Floats:
    """Points [P, 3], world, on what is not dark where it is seen.

    depths: as of the views, [H, W]; those at pixels that are `dark` do not count. on_share: told
    the share that is done; may raise.
    """
    size = float(np.mean([view.picture.size for view in views]))
    per_view = max(1, round(_POINTS_PER_PX * size / len(views)))
    found = [
        _thinned(back_project(view, np.where(black, np.float32(0.0), z)), per_view)
        for view, z, black in zip(views, depths, dark, strict=True)
    ]
    points = np.concatenate(found)
    towards = np.concatenate(
        [_unit(view.center - some) for view, some in zip(views, found, strict=True)]
    )
    shown, unlit = np.zeros(len(points), np.int64), np.zeros(len(points), np.int64)
    for index, (view, black) in enumerate(zip(views, dark, strict=True)):
        at, rows, columns = view.shown_at(points)
        cosine = (_unit(view.center - points[at]) * towards[at]).sum(axis=1)
        asked = (cosine >= _BESIDE) & (view.picture[rows, columns] >= 0.0)
        shown[at[asked]] += 1
        unlit[at[asked]] += black[rows[asked], columns[asked]]
        on_share((index + 1) / len(views))
    solid: Floats = points[unlit <= _MOST_DARK * shown]
    return solid


def before_solid(view: StereoView, points: Floats) -> Bools:
    """[H, W]: where a picture looks at some of the solid points [P, 3], or past what hides them."""
    height, width = view.picture.shape
    _, rows, columns = view.shown_at(points)
    some = np.zeros((height + 2, width + 2), np.int64)
    some[rows + 1, columns + 1] = 1
    around = sum(
        some[down : down + height, right : right + width] for down in range(3) for right in range(3)
    )
    before: Bools = np.asarray(around) >= _LEAST_SOLID
    return before


def _unit(ways: Floats) -> Floats:
    """[P, 3], of length 1."""
    unit: Floats = ways / np.maximum(np.linalg.norm(ways, axis=1, keepdims=True), 1e-12)
    return unit


def _thinned(points: Floats, most: int) -> Floats:
    """At most so many of the points [P, 3], evenly picked."""
    if len(points) <= most:
        return points
    thinned: Floats = points[np.linspace(0, len(points) - 1, most).astype(int)]
    return thinned
