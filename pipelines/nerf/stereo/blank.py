"""The blank ground of pictures from which a thing was cut out.

Programs that cut a thing out of its photos leave one colour around it, white mostly, and pictures
whose surroundings are transparent are laid on white. That is no wall: matching carries the thing's
depth into it, and training paints it on whatever stands before the cameras. It is told by being the
same in all pictures to the last levels, which nothing that was photographed is.

Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.measure import label

from pipelines.nerf.stereo.dark import before_solid, solid_points
from pipelines.nerf.stereo.patch_colors import Bools, Bytes, Floats, at_border
from pipelines.nerf.stereo.shelves import ByView
from pipelines.nerf.stereo.views import StereoView
from pipelines.nerf.stereo.void import is_measured

_MOST_OFF = 6
"""Levels of 255 that a channel may differ from the ground: what JPEG leaves of one colour."""
_LEAST_OF_BORDER, _LEAST_VIEWS, _LEAST_SHARE = 0.5, 0.9, 0.15
"""Of a picture's border, how much has the colour; of how many views that is so; of all pictures,
how much is ground."""
_LEAST_HOLE = 0.001
"""Of the picture: what has the colour amid the thing and is as large may be looked through."""
_FOUND_SHARE, _SOLID_SHARE = 0.4, 0.9
"""Of the progress, at the end of each part."""

_LEAST_BRIGHT = 0.12
"""Of the ground's brightest channel: what is darker is looked at as the dark, in which a thing has
unlit sides."""

Color = tuple[int, int, int]


@dataclass(frozen=True)
class Blank:
    """masks: where each view's picture shows its blank ground, [H, W]; none where a capture has
    none. color: sRGB, 0 to 255; None without a ground. share: of all pictures. num_views: with one.
    """

    masks: list[Bools]
    color: Color | None
    share: float
    num_views: int


def find_blank(
    views: Sequence[StereoView],
    picture_of: Callable[[int], Bytes],
    depths: ByView[NDArray[np.float32]],
    measured: Sequence[NDArray[np.float32] | None] | None = None,
    on_share: Callable[[float], None] = lambda done: None,
) -> Blank:
    """The blank ground of a capture's pictures.

    picture_of: each view's, in colour, [H, W, 3] uint8, sRGB. depths: what is known so far, wrong
    on the ground. measured: what a sensor saw, as `depths`, None for a view without. on_share: told
    the share that is done; may raise.
    """
    nothing = [np.zeros(view.picture.shape, np.bool_) for view in views]
    borders = []
    for index, view in enumerate(views):
        there = view.picture >= 0.0
        borders.append(picture_of(index)[at_border(there)])
        on_share(0.5 * _FOUND_SHARE * (index + 1) / len(views))
    known = [np.median(border, axis=0) for border in borders if len(border)]
    if not known:
        return Blank(nothing, None, 0.0, 0)
    red, green, blue = (round(float(level)) for level in np.median(known, axis=0))
    color = (red, green, blue)
    num_views = sum(
        bool(len(border)) and float(_has(border, color).mean()) >= _LEAST_OF_BORDER
        for border in borders
    )
    if num_views < _LEAST_VIEWS * len(views) or max(color) <= 255 * _LEAST_BRIGHT:
        return Blank(nothing, None, 0.0, num_views)
    around = []
    for index, view in enumerate(views):
        around.append(like_blank(view, picture_of(index), color))
        on_share(_FOUND_SHARE * (0.5 + 0.5 * (index + 1) / len(views)))
    share = float(np.mean([mask.mean() for mask, _ in around]))
    if share < _LEAST_SHARE or is_measured([mask for mask, _ in around], measured):
        return Blank(nothing, None, 0.0, num_views)

    def on_solid(share: float) -> None:
        on_share(_FOUND_SHARE + (_SOLID_SHARE - _FOUND_SHARE) * share)

    solid = solid_points(views, depths, [mask | holes for mask, holes in around], on_solid)
    masks = []
    for index, view in enumerate(views):
        masks.append(blank_of(view, around[index], solid))
        on_share(_SOLID_SHARE + (1.0 - _SOLID_SHARE) * (index + 1) / len(views))
    return Blank(masks, color, float(np.mean([mask.mean() for mask in masks])), num_views)


def like_blank(view: StereoView, picture: Bytes, color: Color) -> tuple[Bools, Bools]:
    """[H, W] twice: what of one picture has the ground's colour and hangs together with its border,
    and what has it amid the thing: seen through a handle, or white on the thing itself."""
    there = view.picture >= 0.0
    plain = there & _has(picture, color)
    number: Any = label
    regions: NDArray[np.int64] = number(plain, connectivity=1)
    area = np.bincount(regions[plain], minlength=int(regions.max()) + 1)
    outer = np.bincount(regions[plain & at_border(there)], minlength=len(area)) > 0
    large = area >= _LEAST_HOLE * picture.shape[0] * picture.shape[1]
    around = plain & outer[regions]
    return around, plain & ~around & large[regions]


def blank_of(view: StereoView, seen: tuple[Bools, Bools], solid: Floats) -> Bools:
    """[H, W]: the ground of one picture, of what `like_blank` found in it. solid: [P, 3], world,
    points on the thing: what has the ground's colour before them is no hole."""
    around, holes = seen
    mask: Bools = around | (holes & ~before_solid(view, solid)) if holes.any() else around
    return mask


def _has(colors: Bytes, color: Color) -> Bools:
    """[...]: which of the colours [..., 3] are the one."""
    off = np.abs(colors.astype(np.int16) - np.array(color, np.int16)).max(axis=-1)
    same: Bools = off <= _MOST_OFF
    return same
