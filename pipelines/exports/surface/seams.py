"""Where the surface of one shell meets that of the next: no crack between the two.

Each shell is fused by itself, with voxels of its own, and the next one begins a voxel within its
border. What two fusions, or two planes that parts were laid on, make of one table lies a fraction
of a voxel apart; who looks along the table sees a line of nothing there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.mesh import Floats, TriangleMesh
from pipelines.exports.surface.clean import piece_of_faces
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.exports.surface.shells import Shell

_BAND = 4.0
"""Outer voxels beyond the inner surface's border, over which the outer one goes back to its own."""
_SAME, _ANOTHER = 1.0, 2.0
"""Outer voxels between the two up to which they are one surface, and from which they are two."""
_ALIKE = 0.7
"""Cosine between the normals of what may be one surface."""
_INNER_SHARE = 0.9
"""Of a piece's vertices within the inner shell's bounds: what refining moved may leave them."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def seamless(mesh: TriangleMesh, shells: Sequence[Shell]) -> TriangleMesh:
    """The mesh with the beginning of each shell's surface laid on that of the shells within.

    shells: from the innermost one. Pieces of different shells share no vertices.
    """
    if len(mesh.faces) == 0 or len(shells) < 2:
        return mesh
    origin = mesh.vertices.mean(axis=0)
    vertices = mesh.vertices - origin
    piece = piece_of_faces(mesh.faces, len(vertices))
    of_vertex = np.zeros(len(vertices), np.int64)
    of_vertex[mesh.faces] = piece[:, None]
    size = np.bincount(of_vertex)
    for inner, outer in pairwise(shells):
        within = inner.bounds.contains(vertices + origin)
        is_inner = np.bincount(of_vertex, within) > _INNER_SHARE * size
        faces = mesh.faces[is_inner[piece]]
        beyond = np.flatnonzero(~is_inner[of_vertex])
        if len(faces) and len(beyond):
            vertices[beyond] += _moves(
                vertices, faces, vertices[beyond], mesh.normals[beyond], outer.voxel
            )
    moved = replace(mesh, vertices=vertices + origin)
    return from_open3d(to_open3d(moved, origin), origin)


def _moves(
    vertices: Floats,
    faces: NDArray[np.int32],
    points: Floats,
    normals: Floats,
    voxel: float,
) -> Floats:
    """What brings points [P, 3] onto a surface that they go on from."""
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor(vertices.astype(np.float32)), _core.Tensor(faces.astype(np.uint32))
    )
    found = scene.compute_closest_points(_core.Tensor(points.astype(np.float32)))
    way = found["points"].numpy() - points
    across = found["primitive_normals"].numpy().astype(np.float64)
    across /= np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-12)
    off = (way * across).sum(axis=1)
    aside = np.sqrt(np.maximum((way * way).sum(axis=1) - off * off, 0.0))
    share = np.clip(1.0 - aside / (_BAND * voxel), 0.0, 1.0)
    share *= np.clip((_ANOTHER - np.abs(off) / voxel) / (_ANOTHER - _SAME), 0.0, 1.0)
    share *= (normals * across).sum(axis=1) >= _ALIKE
    moves: Floats = (share * off)[:, None] * across
    return moves
