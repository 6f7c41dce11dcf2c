"""A thing that turns before a camera on a tripod: on a turntable, in a hand's reach, in a viewer
whose screen was recorded.

To structure from motion the room behind it stands still, and so does the camera; only of the thing
can poses be found, around which the camera then goes. What stands still around it is therefore cut
away, as if masks had come along (`photo_masks`, cut_out).

Each pixel's ground is the colour that most pictures have there. In a picture the ground is what has
that colour and reaches the border; the rest is the thing. What is plain on the thing has the same
colour in all pictures, too, but a border of pixels that change lies around it. A part that looks
the same from all sides, as a plain bottle, has none, and is lost.

Told only where a fourth of the picture stands still, has details of its own (else nothing is gained
by it: a plain ground has no features), and goes nearly all the way around something that changes
from each picture to the next.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy import ndimage

from pipelines.captures.photo_masks import cut_out
from pipelines.captures.pictures import evenly_picked
from pipelines.captures.small_pictures import load_small, small
from pipelines.stage import StageContext

Bools = NDArray[np.bool_]
Colors = NDArray[np.uint8]
Floats = NDArray[np.float32]

_LEAST_PICTURES, _MOST_PICTURES = 12, 32
"""Fewer tell no ground; more are not looked at for it."""
_LONG_SIDE_PX = 640
"""Pictures are looked at with this long side; what follows counts its pixels."""
_GLANCE_PX, _GLANCE_SPREAD = 160, 40.0
"""A first look, which settles nearly all captures: by this spread half of what it takes stays."""
_SHOWN = 0.4
"""Share of the pictures that show the ground of a pixel at least, for it to be known."""
_ALWAYS = 0.9
_SPREAD, _SPREAD_ALWAYS = 10.0, 18.0
"""Levels of 255 within which a ground stays in as many; more where all count, clipped ones, too."""
_LIKE = 14.0
"""Levels from its ground within which a pixel shows it."""
_BORDER = 0.02
"""Of the shorter side: what is so near the border tells how bright a picture is."""
_LEAST_STILL = 0.25
_LEAST_STILL_BORDER = 0.6
_DETAIL = 4.0
"""Levels a pixel, of a ground's gradient where it has details."""
_LEAST_DETAIL = 0.08
"""Share of what stands still that has some."""
_THING = (0.01, 0.6)
"""Share of the picture that the thing has, in nine pictures of ten."""
_MOST_OF_BOX = 0.9
"""Of its box; what fills that, in half of the pictures, is a window, as a recorded screen has."""
_CHANGED = 20.0
_LEAST_CHANGED = 0.15
"""Share of the thing that changes by more than that from one picture to the next, of those looked
at, in seven of ten."""
_OPENED_PX = 1
_LEAST_PIECE = 0.05
"""Of the largest piece; smaller ones are flicker."""


@dataclass(frozen=True)
class Ground:
    """What stands still around a thing. level: [h, w, 3], its colour. known: [h, w]."""

    level: Floats
    known: Bools

    def thing(self, picture: Colors) -> Bools:
        """[h, w], where a picture [h, w, 3] does not show it."""
        levelled = picture / _gain(picture, self.level)
        like = self.known & (np.abs(levelled - self.level) <= _LIKE).all(axis=2)
        across = np.ones((3, 3), np.bool_)
        opened = ndimage.binary_opening(like, across, iterations=_OPENED_PX)
        seed = np.zeros_like(opened)
        seed[[0, -1]], seed[:, [0, -1]] = opened[[0, -1]], opened[:, [0, -1]]
        reached = ndimage.binary_propagation(seed, mask=opened)
        reached = ndimage.binary_dilation(reached, across, iterations=_OPENED_PX) & like
        thing: Bools = ~reached
        pieces, _ = ndimage.label(thing, across)
        areas = np.bincount(pieces.ravel())
        areas[0] = 0
        thing &= (areas >= _LEAST_PIECE * areas.max())[pieces]
        return thing


def find_ground(files: Sequence[Path], ctx: StageContext) -> Ground | None:
    """What stands still around a thing that turns, in pictures of one size; None where nothing
    does. files: in the order in which they were taken. Raises Cancelled."""
    if len(files) < _LEAST_PICTURES:
        return None
    if not _may_stand_still([files[i] for i in evenly_picked(len(files), _LEAST_PICTURES)], ctx):
        return None
    picked = [files[i] for i in evenly_picked(len(files), _MOST_PICTURES)]
    pictures = load_small(picked, _LONG_SIDE_PX, "RGB", ctx)
    levelled = _levelled(pictures)
    ordered = np.sort(levelled, axis=0)
    level, spread = _densest(ordered, _SHOWN)
    always = _within(_densest(ordered, _ALWAYS)[1], _SPREAD_ALWAYS)
    ground = Ground(level, _within(spread, _SPREAD))
    if not _stands_still(always, level):
        return None
    things = [ground.thing(picture) for picture in pictures]
    shares = np.array([thing.mean() for thing in things])
    if ((shares < _THING[0]) | (shares > _THING[1])).mean() > 0.1:
        return None
    if np.median([_share_of_box(thing) for thing in things]) > _MOST_OF_BOX:
        return None
    changed = [
        _changed(levelled[i], levelled[i + 1], things[i] & things[i + 1])
        for i in range(len(things) - 1)
    ]
    return ground if np.quantile(changed, 0.3) >= _LEAST_CHANGED else None


def cut_turntable(
    out: Path, files: Sequence[str], quality: int, ctx: StageContext
) -> dict[str, str]:
    """Lay pictures on white where they show what stands still around a thing that turns.

    files: below `out`, in the order in which they were taken. quality: of those that are JPEG.
    Returns the files of what they were cut out by, below `out`, too; none where nothing turns or
    pictures are of several sizes. Raises Cancelled.
    """
    paths = [out / file for file in files]
    if len({_size_of(path) for path in paths}) != 1:
        return {}
    ground = find_ground(paths, ctx)
    if ground is None:
        return {}
    (out / "cuts").mkdir(exist_ok=True)
    cuts = {file: f"cuts/{Path(file).stem}.png" for file in files}
    for file, cut in cuts.items():
        _cut_away(ground, out / file, out / cut, quality, ctx)
    return cuts


TURNTABLE_NOTE = (
    "The camera stood still, and a thing turned before it: what stands still around the thing was "
    "cut away."
)


def _size_of(path: Path) -> tuple[int, int]:
    with PIL.Image.open(path) as opened:
        return opened.size


def _may_stand_still(files: Sequence[Path], ctx: StageContext) -> bool:
    """Whether it is worth a closer look, by a few pictures of hardly any size."""
    ordered = np.sort(_levelled(load_small(files, _GLANCE_PX, "RGB", ctx)), axis=0)
    still = _within(_densest(ordered, _ALWAYS)[1], _GLANCE_SPREAD)
    return bool(still.mean() >= _LEAST_STILL / 2.0)


def _cut_away(ground: Ground, file: Path, target: Path, quality: int, ctx: StageContext) -> None:
    """Lay a picture on white where it shows the ground, and write what is left as a mask."""
    thing = ground.thing(small(file, _LONG_SIDE_PX, "RGB", ctx))
    with PIL.Image.open(file) as opened:
        picture = opened.convert("RGB")
        kind = opened.format
    reduced = PIL.Image.fromarray(np.where(thing, np.uint8(255), np.uint8(0)))
    mask = reduced.resize(picture.size, PIL.Image.Resampling.BILINEAR)
    plain = cut_out(picture, mask)
    if kind == "PNG":
        plain.save(file, "PNG", compress_level=3)
    else:
        plain.save(file, "JPEG", quality=quality, subsampling=0)
    mask.point([255 * (value >= 128) for value in range(256)]).save(target)


def _levelled(pictures: Colors) -> Colors:
    """Pictures [N, h, w, 3] as bright as the median one."""
    usual = np.median(pictures, axis=0).astype(np.float32)
    levelled = [np.clip(picture / _gain(picture, usual), 0, 255) for picture in pictures]
    return np.stack(levelled).astype(np.uint8)


def _gain(picture: Colors, usual: Floats) -> Floats:
    """By how much a picture is brighter than usual at its border, for each channel."""
    rim = max(1, round(_BORDER * min(picture.shape[:2])))
    at_border = np.ones(picture.shape[:2], np.bool_)
    at_border[rim:-rim, rim:-rim] = False
    border = usual[at_border]
    bright = (border.min(axis=1) > 16) & (border.max(axis=1) < 240)
    if bright.sum() < 16:
        return np.ones(3, np.float32)
    brighter = picture[at_border][bright] / border[bright]
    gain: Floats = np.median(brighter, axis=0).astype(np.float32)
    return np.clip(gain, 0.5, 2.0)


def _within(spread: Floats, most: float) -> Bools:
    """[h, w], where all channels [h, w, 3] stay."""
    stays: Bools = spread.max(axis=2) <= most
    return stays


def _densest(ordered: Colors, share: float) -> tuple[Floats, Floats]:
    """Of values sorted along axis 0, the narrowest span that holds that share of them: its middle
    and its width, [h, w, 3]. Source: the half of that kind is Rousseeuw's least median of squares,
    JASA 1984."""
    most = len(ordered) - 1
    held = min(most, max(1, math.ceil(share * len(ordered)) - 1))
    best = np.full(ordered.shape[1:], 255, np.uint8)
    middle = np.zeros(ordered.shape[1:], np.float32)
    for start in range(len(ordered) - held):
        low, high = ordered[start], ordered[start + held]
        closer = high - low < best
        best = np.where(closer, high - low, best)
        middle = np.where(closer, (low.astype(np.float32) + high) / 2, middle)
    return middle, best.astype(np.float32)


def _stands_still(always: Bools, level: Floats) -> bool:
    """Whether enough of the picture does, around the rest, and has details of its own."""
    border = np.concatenate([always[0], always[-1], always[:, 0], always[:, -1]])
    if always.mean() < _LEAST_STILL or border.mean() < _LEAST_STILL_BORDER:
        return False
    inside = ndimage.binary_erosion(always, iterations=2)
    gradient = np.hypot(*np.gradient(level.mean(axis=2)))
    return bool((gradient[inside] > _DETAIL).mean() >= _LEAST_DETAIL) if inside.any() else False


def _share_of_box(thing: Bools) -> float:
    """Of the smallest box around a thing, the share that it has."""
    rows, columns = np.flatnonzero(thing.any(axis=1)), np.flatnonzero(thing.any(axis=0))
    if not len(rows):
        return 0.0
    return float(thing[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1].mean())


def _changed(one: Colors, two: Colors, where: Bools) -> float:
    """Of a part of two pictures, the share that is another colour in the second."""
    if not where.any():
        return 0.0
    apart = np.abs(one[where].astype(np.float32) - two[where]).max(axis=1)
    return float((apart > _CHANGED).mean())
