"""A point cloud as text: a line `x y z red green blue nx ny nz` for each point.

The first line is a comment that names the columns and the frame. Positions are told to a
hundred-millionth of the cloud's extent, also in map coordinates.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.formats.numbers import position_decimals, rows
from pipelines.exports.frame import Frame

Floats = NDArray[np.float64]

_LINE = " ".join(["{}"] * 9) + "\n"
_NORMAL_DECIMALS = 5


def write_points(
    path: Path,
    points: Floats,
    colors: NDArray[np.uint8],
    normals: Floats,
    frame: Frame,
    on_progress: Callable[[float], None] = lambda done: None,
) -> None:
    """Write a cloud of the world. points, normals: [P, 3]. colors: [P, 3], sRGB.

    on_progress: told the share that is written; may raise.
    """
    places, turned = frame.of_world(points), frame.of_world(normals)
    decimals = [position_decimals(places)] * 3 + [0] * 3 + [_NORMAL_DECIMALS] * 3
    with path.open("wb") as file:
        file.write(f"# x y z red green blue nx ny nz; {'; '.join(frame.lines())}\n".encode("ascii"))
        columns = [part[:, axis] for part in (places, colors, turned) for axis in range(3)]
        for text in rows(_LINE, columns, decimals, on_progress):
            file.write(text)
