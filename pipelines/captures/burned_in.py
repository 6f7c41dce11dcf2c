"""What was laid over pictures after they were taken: bars, a date, a logo, a recorded screen's
buttons. The scene moves beneath it, and it stays.

To structure from motion it is a thing that flies along with the camera and matches better than any
other. It is told by its edges: whatever a hand-held camera shows, at no pixel do nine of ten
pictures have the same gradient. Opaque parts without edges hang together with these and do not
change; through others the scene shines. Straight edges alone are none of it: a camera that slides
along a shelf keeps those, too. Nor is what the scene around hardly moves against: the thing that
a gimbal or a drone keeps in the middle of its circle, and what is far ahead.

Where much beside it stays as well, the camera stood still, or things stood before a plain ground:
then nothing is told. The median gradient after Dekel et al., "On the effectiveness of visible
watermarks", CVPR 2017.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy import ndimage

from pipelines.captures.pictures import evenly_picked
from pipelines.captures.small_pictures import load_small
from pipelines.captures.video_frames import Crop
from pipelines.stage import StageContext

Bools = NDArray[np.bool_]
Floats = NDArray[np.float32]

_LEAST_PICTURES, _FEW, _MOST_PICTURES = 12, 24, 32
"""Fewer have too much in common, few may have some; more are not looked at."""
_LONG_SIDE_PX = 640
"""Pictures are looked at with this long side; what follows counts its pixels."""
_LEAST_GRADIENT = 3.0
"""Levels of 255 per pixel that an edge has in the median picture."""
_SAME, _SAME_OF_FEW, _SAME_BESIDE = 0.9, 0.95, 0.7
"""Share of the pictures that have at least half of that edge; where such an edge goes on, less is
enough, as where the scene shines through."""
_MOST_CHANGE = 8.0
"""Levels of 255 between the tenths below and above: what changes less stays."""
_LEAST_EDGE_PX = 40
"""Fewer pixels of edges in one part are chance."""
_LEAST_ACROSS = 0.05
"""Of a part's gradients, those across their main direction: straight edges have none."""
_LEAST_MOVED = 0.5
"""Of how the whole picture changes from one to the next, for its texture: a ring around a part."""
_RING_PX = (8, 13)
_LEAST_TEXTURE = 1.0
"""Levels of 255 per pixel; in a ring with less nothing can be seen to move."""
_GAP_PX, _GROWN_PX = 3, 3
"""What lies between edges closer than twice this belongs to them; so does what is beside them."""
_LARGEST_HOLE = 0.002
"""Of the picture, that belongs to what is around it: through a frame the scene is seen."""
_MOST_STILL = 0.1
"""Share of all the rest that stays at most."""
_MOST_COVERED = 0.5
_BAR = 0.97
"""Share of a row or column that stays, in a bar; half of that past its border."""
_BORDER_PX = 4


@dataclass(frozen=True)
class BurnedIn:
    """What pictures of one size [H, W] have laid over them.

    mask: [H, W] of all of it. crop: what is left between bars along the whole of a side, None
    without any.
    """

    mask: Bools
    crop: Crop | None

    @property
    def share(self) -> float:
        """Of the picture, what is covered."""
        return float(self.mask.mean())


def find_burned_in(files: Sequence[Path], ctx: StageContext) -> BurnedIn | None:
    """What lies over pictures of one size, from different places; None where nothing does.

    files: in the order in which they were taken. Raises Cancelled.
    """
    if len(files) < _LEAST_PICTURES:
        return None
    picked = [files[i] for i in evenly_picked(len(files), _MOST_PICTURES)]
    pictures = load_small(picked, _LONG_SIDE_PX, "L", ctx).astype(np.float32)
    with PIL.Image.open(picked[0]) as opened:
        size = opened.size
    edges, toward = _steady_edges(pictures)
    if edges.sum() < _LEAST_EDGE_PX:
        return None
    low, high = np.quantile(pictures, (0.1, 0.9), axis=0)
    still: Bools = high - low <= _MOST_CHANGE
    rows, columns = _bars(still | edges)
    inner = np.zeros_like(edges)
    inner[rows, columns] = True
    laid = _laid_over(edges, toward, still, _Motion.of(pictures)) | ~inner
    covered = laid & inner
    if (still & ~laid).sum() > _MOST_STILL * max((~laid).sum(), 1):
        return None
    if not covered.any() and inner.all():
        return None
    if covered.sum() > _MOST_COVERED * inner.sum():
        return None
    return BurnedIn(_enlarged(laid, size), _crop(rows, columns, edges.shape, size))


def _steady_edges(pictures: Floats) -> tuple[Bools, Floats]:
    """Where most pictures [N, h, w] have one edge, [h, w], and their median gradient, [2, h, w]."""
    down, right = np.zeros_like(pictures), np.zeros_like(pictures)
    down[:, 1:-1] = (pictures[:, 2:] - pictures[:, :-2]) / 2
    right[:, :, 1:-1] = (pictures[:, :, 2:] - pictures[:, :, :-2]) / 2
    toward: Floats = np.stack([np.median(down, axis=0), np.median(right, axis=0)])
    size = np.hypot(*toward)
    along = (down * toward[0] + right * toward[1]) / np.maximum(size, 1e-3)
    same = (along > 0.5 * size).mean(axis=0)
    wanted = _SAME_OF_FEW if len(pictures) < _FEW else _SAME
    edges: Bools = ndimage.binary_propagation(
        (size > _LEAST_GRADIENT) & (same >= wanted),
        structure=np.ones((3, 3)),
        mask=(size > _LEAST_GRADIENT) & (same >= _SAME_BESIDE),
    )
    return edges, toward


@dataclass(frozen=True)
class _Motion:
    """By how many levels pictures change from each to the next, in the median, and the gradient
    that they have in the mean; [h, w]."""

    change: Floats
    texture: Floats

    @classmethod
    def of(cls, pictures: Floats) -> _Motion:
        """Of pictures [N, h, w] in order."""
        change = np.median(np.abs(np.diff(pictures, axis=0)), axis=0)
        texture = np.zeros_like(pictures[0])
        for picture in pictures:
            texture += np.hypot(*np.gradient(picture))
        return cls(change.astype(np.float32), texture / len(pictures))

    def goes_past(self, part: Bools, stays: Bools) -> bool:
        """Whether the scene around a part moves as it does elsewhere, beside all that stays."""
        near, far = (ndimage.binary_dilation(part, iterations=reach) for reach in _RING_PX)
        ring, away = far & ~near & ~stays, ~far & ~stays
        if not ring.any() or not away.any() or self.texture[ring].mean() < _LEAST_TEXTURE:
            return True
        moved = self.change[ring].sum() / self.texture[ring].sum()
        elsewhere = self.change[away].sum() / max(self.texture[away].sum(), 1e-6)
        return bool(moved > _LEAST_MOVED * elsewhere)


def _laid_over(edges: Bools, toward: Floats, still: Bools, motion: _Motion) -> Bools:
    """Parts with enough edges in more than one direction that the scene goes past, and what stays
    beside them, [h, w]."""
    near = ndimage.binary_dilation(edges, iterations=_GAP_PX)
    closed = ndimage.binary_erosion(near, iterations=_GAP_PX, border_value=1) | edges
    # Specks of what stays by chance hang together with nothing.
    stays = closed | still
    parts, _ = ndimage.label(stays, np.ones((3, 3)))
    kept = [
        part
        for part in np.unique(parts[edges])
        if _is_drawn(toward[:, edges & (parts == part)].astype(np.float64))
        and motion.goes_past(parts == part, stays)
    ]
    laid = np.isin(parts, kept)
    holes, _ = ndimage.label(~laid)
    small = np.bincount(holes.ravel()) <= _LARGEST_HOLE * laid.size
    laid |= small[holes]
    grown: Bools = ndimage.binary_dilation(laid, iterations=_GROWN_PX)
    return grown


def _is_drawn(gradients: NDArray[np.float64]) -> bool:
    """Whether gradients [2, K] are of something drawn: many, and not all of one straight edge."""
    if gradients.shape[1] < _LEAST_EDGE_PX:
        return False
    across, along = np.linalg.eigvalsh(gradients @ gradients.T)
    return bool(across > _LEAST_ACROSS * along)


def _bars(stays: Bools) -> tuple[slice, slice]:
    """The rows and columns [h, w] between bars, which stay along the whole of a side."""
    rows = _between_ends(stays.mean(axis=1))
    columns = _between_ends(stays[rows].mean(axis=0))
    return rows, columns


def _between_ends(shares: NDArray[np.float64]) -> slice:
    """What is between two ends whose shares are high and fall off at once; all without such."""
    low = shares < _BAR
    if not low.any():
        return slice(0, len(shares))
    first, last = int(np.argmax(low)), len(low) - int(np.argmax(low[::-1]))
    near, far = _BORDER_PX, 3 * _BORDER_PX
    if not np.median(shares[first + near : first + far]) < 0.5 * _BAR:
        first = 0
    if not np.median(shares[max(0, last - far) : max(0, last - near)]) < 0.5 * _BAR:
        last = len(shares)
    return slice(first, last)


def _crop(
    rows: slice, columns: slice, small: tuple[int, ...], size: tuple[int, int]
) -> Crop | None:
    """What lies between bars, in pixels of the picture of that size (W, H)."""
    if (rows, columns) == (slice(0, small[0]), slice(0, small[1])):
        return None
    across, down = size[0] / small[1], size[1] / small[0]
    # One small pixel more on each side with a bar: it is mixed with it.
    left = round((columns.start + 1) * across) if columns.start else 0
    right = round((columns.stop - 1) * across) if columns.stop < small[1] else size[0]
    top = round((rows.start + 1) * down) if rows.start else 0
    bottom = round((rows.stop - 1) * down) if rows.stop < small[0] else size[1]
    return Crop(left, top, right - left, bottom - top)


def _enlarged(mask: Bools, size: tuple[int, int]) -> Bools:
    """The mask [h, w] as large as the pictures (W, H)."""
    large = PIL.Image.fromarray(mask).resize(size, PIL.Image.Resampling.NEAREST)
    return np.asarray(large, np.bool_)
