"""Black rims around pictures, as undistorting leaves them: what all pictures of a size have in
common.

An app that takes a lens's bend out of its pictures leaves their borders black where the lens saw
nothing (a real Polycam export: 2 % of the pixels, up to 10 px deep). To everything that comes after
that would be a black frame that flies about with the camera.

A rim is black in every picture, reaches the border and not far inside, and at the border most
pictures are black nowhere else: a thing before black cloth has no rim.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TypeVar

import numpy as np
import PIL.Image
from numpy.typing import NDArray
from scipy.ndimage import binary_dilation, label

from pipelines.captures.pictures import evenly_picked
from pipelines.stage import StageContext

Bools = NDArray[np.bool_]
T = TypeVar("T", bound=np.generic)

_LEAST_PICTURES, _MOST_PICTURES = 8, 24
"""Fewer have too much in common; more are not looked at."""
_BLACK = 16
"""Of 255, the brightest channel at most: JPEG leaves noise beside an edge."""
_LEAST_BORDER = 0.1
"""Share of the outermost pixels that a rim has at least."""
_DEEPEST = 0.15
"""Of the longer side: what reaches farther inside is none."""
_MOST_BESIDE = 0.5
"""So much of a rim, a picture may be black at its border beside it, the median one."""
_GROWN_PX = 2
"""Pixels beside a rim are mixed with it."""


def common_rim(files: Sequence[Path], ctx: StageContext) -> Bools | None:
    """The rim [H, W] that pictures of one size have in common, and pixels mixed with it; None
    without one, and of few pictures. Raises Cancelled."""
    if len(files) < _LEAST_PICTURES:
        return None
    common: Bools | None = None
    shares = []
    for file in [files[index] for index in evenly_picked(len(files), _MOST_PICTURES)]:
        ctx.check_cancelled()
        with PIL.Image.open(file) as opened:
            red, green, blue = map(np.asarray, opened.convert("RGB").split())
        black = np.maximum(np.maximum(red, green), blue) <= _BLACK
        common = black if common is None else common & black
        if _border(common).mean() < _LEAST_BORDER:
            return None
        shares.append(_reaching_border(black).mean())
    if common is None:
        return None
    rim = _reaching_border(common)
    rows, columns = np.nonzero(rim)
    height, width = rim.shape
    deep = np.minimum.reduce([rows, columns, height - 1 - rows, width - 1 - columns]).max()
    beside = np.median(shares) - rim.mean()
    if deep > _DEEPEST * max(height, width) or beside > _MOST_BESIDE * rim.mean():
        return None
    grown: Bools = binary_dilation(rim, iterations=_GROWN_PX)
    return grown


def _border(picture: NDArray[T]) -> NDArray[T]:
    """The outermost pixels."""
    return np.concatenate([picture[0], picture[-1], picture[1:-1, 0], picture[1:-1, -1]])


def _reaching_border(black: Bools) -> Bools:
    """What hangs together with the outermost pixels."""
    parts, _ = label(black)
    reaching: Bools = np.isin(parts, np.setdiff1d(_border(parts), [0]))
    return reaching
