"""The sky, at which nothing stands.

A patch of sky is plain, so matching carries onto it the depth of what it borders on, and many
views agree: sheets of sky hang around a statue. Nothing in two pictures speaks against them. So the
sky is told by what one picture shows and by what is far: a plain, bright and not warm patch at the
picture's border, all of it above the horizon, without a point of structure from motion in it; and
in the capture such patches border on what is far away, as walls and ceilings of rooms do not.

Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.stereo.patch_colors import (
    Bools,
    Bytes,
    Floats,
    PatchColors,
    grown,
)
from pipelines.nerf.stereo.patches import Labels, shelved_patches
from pipelines.nerf.stereo.planes import ray_grid
from pipelines.nerf.stereo.shelves import ByView, Shelf
from pipelines.nerf.stereo.views import StereoView
from pipelines.nerf.stereo.void import is_measured

_MOST_SPREAD, _LEAST_BRIGHT, _LEAST_EACH, _MOST_WARM = 0.06, 0.8, 0.3, 0.03
"""Of colours: standard deviation; the mean of the brightest channel and of each; and how much more
red than blue."""
_HORIZON_DEG, _LOW_PERCENT = -3.0, 5
"""All but so few pixels of a patch are above the horizon, which is known to some degrees."""
_MOST_POINTS = 1e-3
"""Points of structure from motion, a few of which are always wrong, per pixel of what is inside a
patch."""
_RING_FROM_PX, _RING_TO_PX = 3, 12
_FAR, _FAR_PERCENT, _LEAST_FAR = 3.0, 90, 0.3
"""In that share of the views a tenth of what is known around their patches is so many times as far
as the median of all that they know. Not more of it: patches' own wrong depths lie there, too."""
_LEAST_VIEWS, _LEAST_SHARE = 3, 0.01
"""So many views show it, and so much of all pictures is it."""


@dataclass(frozen=True)
class Sky:
    """masks: what of each view's picture is sky, [H, W]; none where the capture shows no sky.

    share: of all pictures. num_views: that show some, or may. far: in what share of these it
    borders on what is far away.
    """

    masks: list[Bools]
    share: float
    num_views: int
    far: float


def find_sky(
    views: Sequence[StereoView],
    picture_of: Callable[[int], Bytes],
    depths: ByView[NDArray[np.float32]],
    up: Floats,
    points: Floats,
    measured: Sequence[NDArray[np.float32] | None] | None = None,
    patches: Shelf | None = None,
    on_share: Callable[[float], None] = lambda done: None,
) -> Sky:
    """The sky in a capture's pictures.

    picture_of: each view's, in colour, [H, W, 3] uint8, sRGB. depths: what is known so far, wrong
    where the sky is. up: [3], unit. points: [P, 3], world, on what was told apart from anything
    else. measured: what a sensor saw, as `depths`, None for a view without; of the sky it sees
    nothing. patches: a shelf for the pictures' `patches_of`, or with them. on_share: told the share
    that is done; may raise.
    """

    def look(index: int) -> tuple[Bools, bool | None]:
        view, z = views[index], depths[index]
        parts = shelved_patches(view, index, patches)
        mask = like_sky(view, picture_of(index), up, points, parts)
        if not mask.any() or not (z > 0).any():
            return mask, None
        ring = grown(mask, _RING_TO_PX) & ~grown(mask, _RING_FROM_PX) & (z > 0)
        farthest = np.percentile(z[ring], _FAR_PERCENT) if ring.any() else 0.0
        return mask, bool(farthest >= _FAR * np.median(z[z > 0]))

    found, is_far = [], []
    for index, (mask, far_behind) in enumerate(each_ahead(look, range(len(views)))):
        found.append(mask)
        is_far += [] if far_behind is None else [far_behind]
        on_share((index + 1) / len(views))
    far = float(np.mean(is_far)) if is_far else 0.0
    num_views = sum(bool(mask.any()) for mask in found)
    share = float(np.mean([mask.mean() for mask in found]))
    too_little = num_views < _LEAST_VIEWS or share < _LEAST_SHARE
    if too_little or far < _LEAST_FAR or is_measured(found, measured):
        found, share = [np.zeros_like(mask) for mask in found], 0.0
    return Sky(found, share, num_views, far)


def like_sky(
    view: StereoView, picture: Bytes, up: Floats, points: Floats, patches: Labels | None = None
) -> Bools:
    """[H, W]: what of one picture may be sky, and is, where its capture shows any.

    As `find_sky`; patches: the picture's `patches_of`, where they are known. Small patches, and
    what the picture's border does not touch, are sky where they look like a patch of it that is
    found, and are as high.
    """
    seen = PatchColors.of(view, picture, patches)
    labels, mean = seen.labels, seen.mean
    rows_columns = view.seen_at(points)[1:]
    on_inside = labels[rows_columns][seen.inside[rows_columns]]
    num_points = np.bincount(on_inside, minlength=len(mean))
    looks = (seen.spread <= _MOST_SPREAD) & (mean.max(axis=-1) >= _LEAST_BRIGHT)
    looks &= (mean.min(axis=-1) >= _LEAST_EACH) & (mean[:, 0] - mean[:, 2] <= _MOST_WARM)
    looks &= (seen.area > 0) & (num_points <= _MOST_POINTS * seen.num_inside)
    height = _elevation(view, up)
    lowest = np.full(len(mean), -np.inf)
    for patch in np.flatnonzero(looks):
        lowest[patch] = np.percentile(height[seen.there & (labels == patch)], _LOW_PERCENT)
    sure = looks & seen.is_large & (lowest > _HORIZON_DEG)
    if not sure.any():
        return np.zeros_like(seen.there)
    also = looks & seen.alike(sure) & (lowest >= lowest[sure].min())
    return seen.with_fringes(sure | also)


def _elevation(view: StereoView, up: Floats) -> Floats:
    """[H, W], degrees above the horizon that each pixel looks."""
    x, y = ray_grid(view)
    a, b, c = up @ view.world_from_camera[:, :3]
    elevation: Floats = np.degrees(np.arcsin((x * a + y * b + c) / np.sqrt(x * x + y * y + 1.0)))
    return elevation
