"""A point cloud as text: a line `x y z red green blue nx ny nz` for each point.

The first line is a comment that names the columns and the frame.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.frame import Frame

Floats = NDArray[np.float64]

_ROWS = 50_000
_LINE = "%.12g %.12g %.12g %d %d %d %.5f %.5f %.5f\n"


def write_points(
    path: Path, points: Floats, colors: NDArray[np.uint8], normals: Floats, frame: Frame
) -> None:
    """Write a cloud of the world. points, normals: [P, 3]. colors: [P, 3], sRGB."""
    with path.open("w", encoding="ascii", newline="\n") as file:
        file.write(f"# x y z red green blue nx ny nz; {'; '.join(frame.lines())}\n")
        for start in range(0, len(points), _ROWS):
            part = slice(start, start + _ROWS)
            rows = np.concatenate(
                (frame.of_world(points[part]), colors[part], frame.of_world(normals[part])), axis=1
            ).tolist()
            file.write("".join([_LINE % tuple(row) for row in rows]))
