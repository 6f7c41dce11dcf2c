"""Quadric decimation of one piece of a mesh, here or in a process of its own.

pyfqmr holds the interpreter until it is done, minutes for many millions of triangles: whoever waits
for it could neither tell that it goes on nor be cancelled. So large pieces are decimated by this
file, run as a script of numpy and pyfqmr alone, which can be waited for and killed.

Source: Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", 1997, as
pyfqmr does it.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import numpy as np
import pyfqmr
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Faces = NDArray[np.int32]

_OVERSHOOT = 1.02


def decimated(vertices: Floats, faces: Faces, triangles: int) -> tuple[Floats, Faces]:
    """About so many triangles of a piece of size 1. vertices: [V, 3]. faces: [F, 3].

    Open borders stay exactly where they are as long as the triangles suffice for them.
    """
    for keep_borders in (True, False):
        program: Any = pyfqmr.Simplify()
        program.setMesh(vertices, faces)
        program.simplify_mesh(triangles, preserve_border=keep_borders, verbose=False)
        fewer, corners, _ = program.getMesh()
        if len(corners) <= _OVERSHOOT * triangles:
            break
    return np.asarray(fewer, np.float64), np.asarray(corners, np.int32).reshape(-1, 3)


def main(read: Path, written: Path) -> None:
    """Read a piece, and write what is left of it."""
    with np.load(read) as piece:
        vertices, faces, triangles = piece["vertices"], piece["faces"], int(piece["triangles"])
    vertices, faces = decimated(vertices, faces, triangles)
    np.savez(written, vertices=vertices, faces=faces)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
