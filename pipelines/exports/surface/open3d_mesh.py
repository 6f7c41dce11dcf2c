"""Meshes to open3d and back."""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d

from pipelines.exports.mesh import Floats, TriangleMesh, empty_mesh

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_geometry: Any = open3d.geometry
_utility: Any = open3d.utility


def from_open3d(legacy: Any, origin: Floats) -> TriangleMesh:
    """open3d's mesh with fresh normals, moved from a frame at `origin` [3] to the world."""
    if len(legacy.triangles) == 0:
        return empty_mesh()
    legacy.compute_vertex_normals()
    return TriangleMesh(
        vertices=np.asarray(legacy.vertices, np.float64) + origin,
        faces=np.asarray(legacy.triangles, np.int32),
        colors=np.clip(np.asarray(legacy.vertex_colors, np.float64), 0.0, 1.0),
        normals=np.asarray(legacy.vertex_normals, np.float64),
    )


def to_open3d(mesh: TriangleMesh, origin: Floats) -> Any:
    """The mesh without normals, in a frame at `origin` [3], where its numbers are small."""
    legacy = _geometry.TriangleMesh(
        _utility.Vector3dVector(mesh.vertices - origin), _utility.Vector3iVector(mesh.faces)
    )
    legacy.vertex_colors = _utility.Vector3dVector(mesh.colors)
    return legacy
