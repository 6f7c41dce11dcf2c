"""What a fused mesh is cleaned of, and how it is made smaller."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from pipelines.exports.mesh import TriangleMesh, empty_mesh
from pipelines.exports.reduction import reduced
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.scene.bounds import SceneBounds

_MIN_COMPONENT_SHARE = 0.02
_DROP_SHARE = 0.2


def clean(
    mesh: TriangleMesh,
    bounds: SceneBounds,
    max_faces: int,
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """Drop what lies outside the bounds and small loose pieces, and simplify.

    Simplification (`pipelines.exports.reduction`) is to about `max_faces`. It tears thin bridges
    between pieces, so loose ones are dropped before, where they would take their share of the
    faces, and after. May return a mesh without vertices. on_progress: told the share that is done;
    may raise.
    """
    inside = bounds.contains(mesh.vertices)
    faces = mesh.faces[inside[mesh.faces].all(axis=1)]
    if len(faces) == 0:
        return empty_mesh()
    origin = (bounds.box_min + bounds.box_max) / 2.0
    legacy = to_open3d(replace(mesh, faces=faces), origin)
    _drop_small_pieces(legacy)
    on_progress(_DROP_SHARE)
    if len(legacy.triangles) > max_faces:
        legacy = to_open3d(
            reduced(
                from_open3d(legacy, origin),
                max_faces,
                lambda done: on_progress(_DROP_SHARE + (1.0 - _DROP_SHARE) * done),
            ),
            origin,
        )
    legacy.remove_degenerate_triangles()
    _drop_small_pieces(legacy)
    return from_open3d(legacy, origin)


def _drop_small_pieces(legacy: Any) -> None:
    """Take away connected pieces with less than 2 % of the largest one's area, in place."""
    labels, _, piece_areas = legacy.cluster_connected_triangles()
    areas = np.asarray(piece_areas)
    if len(areas) == 0:
        return
    small = areas < _MIN_COMPONENT_SHARE * areas.max()
    legacy.remove_triangles_by_mask(small[np.asarray(labels)])
    legacy.remove_unreferenced_vertices()
