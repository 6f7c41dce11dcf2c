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
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.morphology import dilation, erosion
from skimage.segmentation import expand_labels

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.agreement import AGREE, SEE_THROUGH
from pipelines.nerf.stereo.engines import KERNELS, Engine
from pipelines.nerf.stereo.maps import SKY, DepthMap, MapShelf, surface_points, votes_of_others
from pipelines.nerf.stereo.neighbours import choose_neighbours
from pipelines.nerf.stereo.patches import Labels, even_patches, patches_of
from pipelines.nerf.stereo.planes import ray_grid
from pipelines.nerf.stereo.shelves import MEMORY, ByView, Shelf, Shelves
from pipelines.nerf.stereo.views import StereoView

Bools = NDArray[np.bool_]
Bytes = NDArray[np.uint8]
Floats = NDArray[np.float64]

_LEAST_AREA = 0.005
"""Of the picture. Smaller patches, and what the picture's border does not touch, are sky where they
look like a patch of it that is found, and are as high."""
_BORDER_PX = 6
_MOST_SPREAD, _LEAST_BRIGHT, _LEAST_EACH, _MOST_WARM = 0.06, 0.8, 0.3, 0.03
"""Of colours in [0, 1]: standard deviation; the mean of the brightest channel and of each; and how
much more red than blue."""
_ALIKE, _FRINGE_PX = 0.08, 4
"""Two colours are alike; pixels so near to a patch of sky that have its colour are sky, too."""
_HORIZON_DEG, _LOW_PERCENT = -3.0, 5
"""All but so few pixels of a patch are above the horizon, which is known to some degrees."""
_MOST_POINTS, _POINTS_INSIDE_PX = 1e-3, 4
"""Points of structure from motion, a few of which are always wrong, per pixel of what is so far
inside a patch."""
_RING_FROM_PX, _RING_TO_PX = 3, 12
_FAR, _FAR_PERCENT, _LEAST_FAR = 3.0, 90, 0.3
"""In that share of the views a tenth of what is known around their patches is so many times as far
as the median of all that they know. Not more of it: patches' own wrong depths lie there, too."""
_LEAST_VIEWS, _LEAST_SHARE, _MOST_MEASURED = 3, 0.01, 0.2
"""So many views show it, so much of all pictures is it, and a sensor measures no more of it."""
_RIM_PX = 1
"""Pixels of a patch so near to its border may show what stands before the sky."""
_BEHIND_ALL = 1e3
"""How far the sky is to be thought of, in the largest depth that is known."""


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
    found, is_far, is_measured = [], [], [np.zeros(0, np.bool_)]
    for index, view in enumerate(views):
        if patches is not None and not patches.has(index):
            patches[index] = patches_of(view.picture)
        known = None if patches is None else patches[index]
        mask = like_sky(view, picture_of(index), up, points, known)
        z = depths[index]
        if mask.any() and (z > 0).any():
            ring = _grown(mask, _RING_TO_PX) & ~_grown(mask, _RING_FROM_PX) & (z > 0)
            farthest = np.percentile(z[ring], _FAR_PERCENT) if ring.any() else 0.0
            is_far.append(bool(farthest >= _FAR * np.median(z[z > 0])))
        seen = None if measured is None else measured[index]
        if seen is not None:
            is_measured.append(seen[mask] > 0)
        found.append(mask)
        on_share((index + 1) / len(views))
    far = float(np.mean(is_far)) if is_far else 0.0
    num_views = sum(bool(mask.any()) for mask in found)
    known_to_sensor = np.concatenate(is_measured)
    is_near = len(known_to_sensor) > 0 and bool(known_to_sensor.mean() > _MOST_MEASURED)
    share = float(np.mean([mask.mean() for mask in found]))
    too_little = num_views < _LEAST_VIEWS or share < _LEAST_SHARE
    if too_little or far < _LEAST_FAR or is_near:
        found, share = [np.zeros_like(mask) for mask in found], 0.0
    return Sky(found, share, num_views, far)


def like_sky(
    view: StereoView, picture: Bytes, up: Floats, points: Floats, patches: Labels | None = None
) -> Bools:
    """[H, W]: what of one picture may be sky, and is, where its capture shows any.

    As `find_sky`; patches: the picture's `patches_of`, where they are known.
    """
    there = view.picture >= 0.0
    labels = even_patches(view.picture, patches)
    num = int(labels.max()) + 1
    area = np.bincount(labels[there], minlength=num)
    inside = there & (_shrunk_labels(labels) == labels)
    pixels = np.bincount(labels[inside], minlength=num)
    # What stands before a patch frays into it: its colours are those of its inside, if it has one.
    told = inside | (there & (pixels == 0)[labels])
    mean, spread = _colors_of(labels[told], picture[told], num)
    rows_columns = view.seen_at(points)[1:]
    num_points = np.bincount(labels[rows_columns][inside[rows_columns]], minlength=num)
    looks = (spread <= _MOST_SPREAD) & (mean.max(axis=-1) >= _LEAST_BRIGHT)
    looks &= (mean.min(axis=-1) >= _LEAST_EACH) & (mean[:, 0] - mean[:, 2] <= _MOST_WARM)
    looks &= (area > 0) & (num_points <= _MOST_POINTS * pixels)
    height = _elevation(view, up)
    lowest = np.full(num, -np.inf)
    for patch in np.flatnonzero(looks):
        lowest[patch] = np.percentile(height[there & (labels == patch)], _LOW_PERCENT)
    touching = np.bincount(labels[there & _at_border(there)], minlength=num) > 0
    sure = looks & touching & (area >= _LEAST_AREA * there.size) & (lowest > _HORIZON_DEG)
    if not sure.any():
        return np.zeros_like(there)
    apart = np.abs(mean[:, None] - mean[None, sure]).max(axis=-1).min(axis=-1)
    also = looks & (apart <= _ALIKE) & (lowest >= lowest[sure].min())
    found: Bools = (sure | also)[labels] & there
    # Patches end before the things that they surround do.
    expand: Any = expand_labels
    own = expand(np.where(found, labels + 1, 0), _FRINGE_PX)
    off = np.abs(picture / 255.0 - mean[np.maximum(own - 1, 0)]).max(axis=-1)
    fringed: Bools = found | (there & (own > 0) & (off <= _ALIKE))
    return fringed


def _colors_of(labels: Labels, colors: Bytes, num: int) -> tuple[Floats, Floats]:
    """Mean colour [num, 3] in [0, 1] of each patch, and the largest standard deviation [num].

    labels: [K]. colors: [K, 3], sRGB.
    """
    count = np.maximum(np.bincount(labels, minlength=num), 1)
    channels = (colors / 255.0).T
    mean = np.stack([np.bincount(labels, c, num) / count for c in channels], axis=-1)
    square = np.stack([np.bincount(labels, c * c, num) / count for c in channels], axis=-1)
    return mean, np.sqrt(np.maximum(square - mean**2, 0.0)).max(axis=-1)


def _elevation(view: StereoView, up: Floats) -> Floats:
    """[H, W], degrees above the horizon that each pixel looks."""
    x, y = ray_grid(view)
    a, b, c = up @ view.world_from_camera[:, :3]
    elevation: Floats = np.degrees(np.arcsin((x * a + y * b + c) / np.sqrt(x * x + y * y + 1.0)))
    return elevation


def _at_border(there: Bools) -> Bools:
    """[H, W]: what lies at the border of what a picture has."""
    padded = np.pad(there, _BORDER_PX)
    inner: Bools = _shrunk(padded, _BORDER_PX)[_BORDER_PX:-_BORDER_PX, _BORDER_PX:-_BORDER_PX]
    return there & ~inner


def _shrunk_labels(labels: Labels) -> Labels:
    """The labels, -1 where another one is near."""
    square = _square(_POINTS_INSIDE_PX)
    alone = dilation(labels, square) == erosion(labels, square)
    inner: Labels = np.where(alone, labels, -1).astype(np.int32)
    return inner


def _square(radius: int) -> Bytes:
    return np.ones((2 * radius + 1, 2 * radius + 1), np.uint8)


def _grown(mask: Bools, radius: int) -> Bools:
    grown: Bools = dilation(mask, _square(radius))
    return grown


def _shrunk(mask: Bools, radius: int) -> Bools:
    """Without what is so near to its border; the picture's own is none."""
    padded = np.pad(~mask, radius, mode="edge")
    shrunk: Bools = ~_grown(padded, radius)[radius:-radius, radius:-radius]
    return shrunk


def without(
    sky: Sky,
    views: Sequence[StereoView],
    maps: MapShelf,
    config: StereoConfig,
    on_share: Callable[[float], None] = lambda done: None,
    engine: Engine = KERNELS,
    shelves: Shelves = MEMORY,
) -> MapShelf:
    """The maps with nothing where the sky is, nor where more neighbours see it than agree.

    The sky's pixels, but for those at its rim, have `SKY` for votes.
    """
    open_sky = [_shrunk(mask, _RIM_PX) for mask in sky.masks]
    cleared = shelves.scratch("without sky", len(views))
    beyond = shelves.scratch("sky alone", len(views))
    farthest = np.float32(_BEHIND_ALL * max(float(z.max(initial=0.0)) for z in maps.z))
    for index, z in enumerate(maps.z):
        cleared[index] = np.where(sky.masks[index], np.float32(0.0), z)
        beyond[index] = np.where(open_sky[index], farthest, np.float32(0.0))
    seen = surface_points(views, cleared)
    neighbours = choose_neighbours(views, seen, config.num_neighbours, config.best_angle_deg)
    kept = MapShelf.kept(shelves, "sky", len(views), fresh=True)
    for index in range(len(views)):
        given = index, views, cleared, neighbours[index], config, engine
        agree = votes_of_others(cleared[index], *given)[0][AGREE]
        given = index, views, beyond, neighbours[index], config, engine
        through = votes_of_others(cleared[index], *given)[0][SEE_THROUGH]
        stays = (cleared[index] > 0) & (through <= agree)
        told = np.where(stays, maps[index].votes, 0)
        kept[index] = DepthMap(
            np.where(stays, cleared[index], np.float32(0.0)),
            np.where(open_sky[index], SKY, told).astype(np.uint8),
        )
        on_share((index + 1) / len(views))
    return kept
