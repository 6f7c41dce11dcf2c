"""A solid without symmetry, coloured and textured, for tests of what writes meshes."""

from __future__ import annotations

import numpy as np

from pipelines.exports.mesh import TexturedMesh, TriangleMesh

VERTICES = np.array([[0.5, 0.0, 0.0], [2.0, 0.0, 0.0], [0.5, 3.0, 0.0], [0.5, 0.0, 5.0]])
"""[4, 3] world: 1.5 wide, 3 deep, 5 high."""
FACES = np.array([[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]], np.int32)
COLORS = np.array([[0.5, 0.0, 1.0], [1.0, 1.0, 1.0], [0.02, 0.02, 0.02], [0.25, 0.5, 0.75]])
NORMALS = np.array([[-1.0, -1, -1], [1, 0, 0], [0, 1, 0], [0, 0, 0]])
UV = np.array([[0.25, 0.25], [0.75, 0.25], [0.25, 0.75], [0.75, 0.75]])
QUARTERS = {(0, 0): (200, 30, 30), (0, 1): (30, 200, 30), (1, 0): (30, 30, 200), (1, 1): (9, 9, 9)}
"""Colours of the picture's quarters, by row and column from its top left: one for each vertex."""


def coloured() -> TriangleMesh:
    """With a colour on each vertex."""
    return TriangleMesh(VERTICES, FACES, COLORS, NORMALS)


def textured() -> TexturedMesh:
    """With a picture of four colours, whose middles are the vertices' places."""
    picture = np.zeros((64, 64, 3), np.uint8)
    for (row, column), color in QUARTERS.items():
        picture[32 * row : 32 * row + 32, 32 * column : 32 * column + 32] = color
    return TexturedMesh(VERTICES, FACES, NORMALS, UV, picture)


def y_up(points: np.ndarray) -> np.ndarray:
    """Z up to Y up, written out once more."""
    return np.array([[x, z, -y] for x, y, z in points.tolist()])
