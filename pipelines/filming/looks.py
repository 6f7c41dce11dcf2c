"""How a picture looks: how blurred it is and in which direction, how bright, how much is clipped.

Blur is measured against the picture itself, not against other pictures: gradients between
neighbouring pixels are compared with those between blocks of 4 x 4, direction by direction. Sharp
pictures of whatever content have much the same ratio, since natural scenes look alike at all scales
(Field, "Relations between the statistics of natural images and the response properties of cortical
cells", 1987); blur takes the fine gradients away, motion blur those along the motion alone.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image
from scipy import ndimage

Floats = npt.NDArray[np.float32]

SIDE_PX = 640
"""Pictures are looked at with this long side; blur is told in pixels of it."""
BLURRED_PX = 3.0
"""From here on a picture is blurred: half a percent of its long side. Sharp pictures of the real
captures have 0.9 to 1.8; smeared by 4 pixels they have 2.6 to 3.2, by 8 pixels 4 and more."""
_BLOCK = 4
_EDGE = 0.37
"""Ratio of the energies of fine and coarse gradients of a sharp edge."""
_SMEARED = 2.4
"""Blur at a scale, in its pixels, from which the next coarser scale tells how much it is."""
_SCALES = 3
_PLAIN = 2e-4
"""Energy of coarse gradients (of luma in [0, 1]) below which there is nothing to see blurred."""
_DARK, _BRIGHT = 12, 250
_BLACK, _WHITE = 1, 254
"""A ground that was filled in, give or take what packing as JPEG does."""
_PLAIN_EDGES, _MOST_GROUND = 0.75, 0.98


@dataclass(frozen=True)
class Look:
    """What was measured of one picture.

    blur_px: width over which edges are smeared, in pixels of SIDE_PX; None where too little is to
    be seen. streak: by how much more it is smeared in one direction than across, 1 for none.
    luma: mean, in [0, 1], without a black ground. dark, bright: shares of pixels that are nearly
    black, or clipped, each without a ground of that colour (see `_ground`).
    """

    blur_px: float | None
    streak: float
    luma: float
    dark: float
    bright: float

    @property
    def is_blurred(self) -> bool:
        """Whether it is blurred enough to matter."""
        return self.blur_px is not None and self.blur_px >= BLURRED_PX


def look_at(path: Path) -> tuple[Look, Image.Image]:
    """Measure a picture file; the picture itself comes back too, reduced to SIDE_PX.

    Raises OSError where it cannot be read.
    """
    with Image.open(path) as opened:
        opened.draft("RGB", (SIDE_PX, SIDE_PX))  # a JPEG is decoded at an eighth, quarter or half
        picture = opened.convert("RGB")
    factor = SIDE_PX / max(picture.size)
    if factor < 1:
        size = (max(1, round(picture.width * factor)), max(1, round(picture.height * factor)))
        picture = picture.resize(size, Image.Resampling.BOX)
    return measure(np.asarray(picture.convert("L"))), picture


def measure(luma: npt.NDArray[np.uint8]) -> Look:
    """luma: [H, W], the long side about SIDE_PX."""
    blur_px, streak = _blur((luma / np.float32(255.0)).astype(np.float32))
    black, white = _ground(luma <= _BLACK), _ground(luma >= _WHITE)
    return Look(
        blur_px=blur_px,
        streak=streak,
        luma=float(luma[~black].mean()) / 255.0,
        dark=float((luma[~black] <= _DARK).mean()),
        bright=float((luma[~white] >= _BRIGHT).mean()),
    )


def _ground(plain: npt.NDArray[np.bool_]) -> npt.NDArray[np.bool_]:
    """What lies around a subject that was cut out or rendered, and says nothing of the light.

    plain: [H, W], where the picture is quite black, or quite white. Returns [H, W], what hangs
    together with the edges where these are plain most of the way round (a burnt-out sky has the
    upper edge and parts of two more); nothing else, and nothing where no subject would be left.
    """
    nothing = np.zeros_like(plain)
    edges = np.concatenate([plain[0], plain[-1], plain[1:-1, 0], plain[1:-1, -1]])
    if edges.mean() < _PLAIN_EDGES:
        return nothing
    labels, _ = ndimage.label(plain)
    at_edges = np.unique(np.concatenate([labels[0], labels[-1], labels[1:-1, 0], labels[1:-1, -1]]))
    ground: npt.NDArray[np.bool_] = plain & np.isin(labels, at_edges)
    return nothing if ground.mean() > _MOST_GROUND else ground


def _blur(luma: Floats) -> tuple[float | None, float]:
    """Blur in pixels and how much it is streaked. luma: [H, W] in [0, 1].

    Each scale sees blur up to its own 4 pixels or so; the coarsest that sees any tells how much,
    where the finest would already have noise in place of what the blur took.
    """
    found: tuple[float | None, float] = (None, 1.0)
    for scale in range(_SCALES):
        if min(luma.shape) < 8 * _BLOCK:
            break
        along, across = _smear(luma)
        if along is None or across is None:
            break
        if found[0] is None or along >= _SMEARED:
            found = (along * 2**scale, along / across)
        luma = _blocks(luma, 2)
    return found


def _smear(luma: Floats) -> tuple[float | None, float | None]:
    """Widths of edges, in pixels: in the direction that is smeared most, and in the other."""
    fine, coarse = _gradients(luma), _gradients(_blocks(luma, _BLOCK))
    if np.trace(coarse) < _PLAIN or np.linalg.det(coarse) < 1e-3 * np.trace(coarse) ** 2:
        return None, None
    ratios = np.linalg.eigvals(np.linalg.solve(coarse, fine)).real
    low, high = float(max(ratios.min(), 1e-4)), float(max(ratios.max(), 1e-4))
    return _EDGE / low, _EDGE / high


def _gradients(luma: Floats) -> npt.NDArray[np.float64]:
    """The mean outer product of differences between neighbours, [2, 2]."""
    right = (luma[:, 1:] - luma[:, :-1])[:-1].ravel()
    down = (luma[1:] - luma[:-1])[:, :-1].ravel()
    mixed = float(right @ down)
    return np.array([[float(right @ right), mixed], [mixed, float(down @ down)]]) / right.size


def _blocks(luma: Floats, size: int) -> Floats:
    """Means of blocks of size x size; what is left over at the far sides is cut off."""
    rows, columns = (length // size for length in luma.shape)
    cropped = luma[: rows * size, : columns * size]
    means: Floats = cropped.reshape(rows, size, columns, size).mean(axis=(1, 3), dtype=np.float32)
    return means
