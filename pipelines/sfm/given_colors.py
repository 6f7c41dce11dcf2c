"""Colours of points, from the pictures that show them."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from pipelines.sfm.given_refinement import Refined
from pipelines.sfm.tracks import Integers


def colors_of(
    found: Refined,
    pictures: Sequence[Path],
    points: Integers,
    poll: Callable[[], None] = lambda: None,
) -> npt.NDArray[np.uint8]:
    """The colour of each of `points` [P] in the first picture that shows it, uint8 [P, 3].

    pictures: N, by the number of the image. poll: called before each is opened; may raise.
    """
    row_of = np.full(len(found.points), -1)
    row_of[points] = np.arange(len(points))
    wanted = np.flatnonzero(row_of[found.seen.track] >= 0)
    _, first = np.unique(found.seen.track[wanted], return_index=True)
    first = wanted[first]
    colors = np.full((len(points), 3), 128, np.uint8)
    for image in np.unique(found.seen.image[first]).tolist():
        poll()
        mine = first[found.seen.image[first] == image]
        with Image.open(pictures[image]) as opened:
            shown = np.asarray(opened.convert("RGB"))
        column, row = np.clip(
            found.seen.xy[mine].astype(np.int64), 0, (shown.shape[1] - 1, shown.shape[0] - 1)
        ).T
        colors[row_of[found.seen.track[mine]]] = shown[row, column]
    return colors
