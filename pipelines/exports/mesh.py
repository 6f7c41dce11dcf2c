"""A coloured triangle mesh: what surfaces are made as, and what the formats write."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class TriangleMesh:
    """vertices: [V, 3] world. faces: [F, 3] int32, counter-clockwise from outside.

    colors: [V, 3] in [0, 1], sRGB. normals: [V, 3], unit.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    colors: Floats
    normals: Floats


def empty_mesh() -> TriangleMesh:
    """A mesh without vertices."""
    none = np.zeros((0, 3))
    return TriangleMesh(none, np.zeros((0, 3), np.int32), none, none)
