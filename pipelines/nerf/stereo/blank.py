"""The blank ground of pictures from which a thing was cut out.

Programs that cut a thing out of its photos leave one colour around it, white mostly, and pictures
whose surroundings are transparent are laid on white. That is no wall: matching carries the thing's
depth into it, and training paints it on whatever stands before the cameras. It is told by being the
same in all pictures to the last levels, which nothing that was photographed is, but for what is
burnt out: the paper of a light tent. That fades into what is hardly darker, and is one ground with
it: half a paper that is nothing and half that is a plain surface becomes fog before the thing.

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

_BURNT_OUT, _MOST_EXACT, _EXACT_OFF = 250, 0.8, 1
"""A ground that was photographed, and is no colour that a program left: its brightest channel; of
what has its colour at a picture's border, how much is as near to it as `_EXACT_OFF`, in the median
picture. What a program laid is one colour but for JPEG near edges; of one tent's, up to .6 was."""
_PAPER_OFF, _PAPER_STEP = 40, 8
"""Levels that a paper may be darker than where it is burnt out, and from a pixel to the next. A
shadow's border is steeper, and so is a thing's."""

Color = tuple[int, int, int]


@dataclass(frozen=True)
class Blank:
    """masks: where each view's picture shows its blank ground, [H, W]; none where a capture has
    none. color: sRGB, 0 to 255; None without a ground. share: of all pictures. num_views: with one.
    is_paper: the ground was photographed, and fades.
    """

    masks: list[Bools]
    color: Color | None
    share: float
    num_views: int
    is_paper: bool = False


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
    is_paper = _is_paper(borders, color)
    seen = []
    for index, view in enumerate(views):
        seen.append(like_blank(view, picture_of(index), color, is_paper=is_paper))
        on_share(_FOUND_SHARE * (0.5 + 0.5 * (index + 1) / len(views)))
    share = float(np.mean([mask.mean() for mask, _ in seen]))
    if share < _LEAST_SHARE or is_measured([around for around, _ in seen], measured):
        return Blank(nothing, None, 0.0, num_views)

    def on_solid(share: float) -> None:
        on_share(_FOUND_SHARE + (_SOLID_SHARE - _FOUND_SHARE) * share)

    solid = solid_points(views, depths, [around | maybe for around, maybe in seen], on_solid)
    masks = []
    for index, view in enumerate(views):
        masks.append(blank_of(view, seen[index], solid))
        on_share(_SOLID_SHARE + (1.0 - _SOLID_SHARE) * (index + 1) / len(views))
    share = float(np.mean([mask.mean() for mask in masks]))
    return Blank(masks, color, share, num_views, is_paper)


def like_blank(
    view: StereoView, picture: Bytes, color: Color, *, is_paper: bool = False
) -> tuple[Bools, Bools]:
    """[H, W] twice: what of one picture has the ground's colour and hangs together with its border,
    and what may be ground unless something solid is there: what has its colour amid the thing, seen
    through a handle, or white on the thing itself; and what a paper fades into.

    is_paper: as of `Blank`.
    """
    there = view.picture >= 0.0
    plain = there & _has(picture, color)
    around = _regions_with(plain, plain & at_border(there))
    amid = plain & ~around
    maybe = amid & _large(amid)
    if is_paper:
        maybe |= _regions_with(plain | (there & _fades(picture, color)), around) & ~around
    return around, maybe


def _is_paper(borders: Sequence[Bytes], color: Color) -> bool:
    """borders: the colours at each picture's border, [N, 3]."""
    exact = [
        float(_has(border, color, _EXACT_OFF).sum()) / max(1, int(_has(border, color).sum()))
        for border in borders
    ]
    return max(color) >= _BURNT_OUT and float(np.median(exact)) < _MOST_EXACT


def _fades(picture: Bytes, color: Color) -> Bools:
    """[H, W]: what is little darker than a paper's colour, and as its neighbours are."""
    levels = picture.astype(np.int16)
    steep = np.zeros(levels.shape[:2], np.bool_)
    down = np.abs(np.diff(levels, axis=0)).max(axis=-1) > _PAPER_STEP
    right = np.abs(np.diff(levels, axis=1)).max(axis=-1) > _PAPER_STEP
    steep[1:] |= down
    steep[:-1] |= down
    steep[:, 1:] |= right
    steep[:, :-1] |= right
    fades: Bools = _has(picture, color, _PAPER_OFF) & ~steep
    return fades


def _regions_with(where: Bools, some: Bools) -> Bools:
    """[H, W]: what of `where` hangs together with a pixel of it that is in `some`."""
    regions, num = _numbered(where)
    wanted = np.bincount(regions[where & some], minlength=num) > 0
    found: Bools = where & wanted[regions]
    return found


def _large(where: Bools) -> Bools:
    """[H, W]: what of `where` is in a region that may be looked through."""
    regions, num = _numbered(where)
    large = np.bincount(regions[where], minlength=num) >= _LEAST_HOLE * where.size
    found: Bools = where & large[regions]
    return found


def _numbered(where: Bools) -> tuple[NDArray[np.int64], int]:
    """[H, W], the numbers from 1 of regions that hang together, 0 elsewhere; one above the last."""
    number: Any = label
    regions: NDArray[np.int64] = number(where, connectivity=1)
    return regions, int(regions.max()) + 1


def blank_of(view: StereoView, seen: tuple[Bools, Bools], solid: Floats) -> Bools:
    """[H, W]: the ground of one picture, of what `like_blank` found in it. solid: [P, 3], world,
    points on the thing: what has the ground's colour before them is no ground."""
    around, maybe = seen
    mask: Bools = around | (maybe & ~before_solid(view, solid)) if maybe.any() else around
    return mask


def _has(colors: Bytes, color: Color, most_off: int = _MOST_OFF) -> Bools:
    """[...]: which of the colours [..., 3] are the one, but for so many levels."""
    off = np.abs(colors.astype(np.int16) - np.array(color, np.int16)).max(axis=-1)
    same: Bools = off <= most_off
    return same
