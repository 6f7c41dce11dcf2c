"""What a fused mesh is cleaned of, and how it is made smaller."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.exports.mesh import Floats, TriangleMesh, empty_mesh
from pipelines.exports.reduction import reduced
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.scene.bounds import SceneBounds

_MIN_SHARE = 0.02
_MIN_SURE_SHARE = 0.0005
"""Of the largest piece's area: what is less is a crumb; a crumb, however many views show it."""
_SURE_VIEWS, _SURE_THROUGH = 5.0, 0.5
"""So many views show each face of a piece in the mean, and so many of them, at most, see through
it: a lamp, a stool whose legs are too thin for the mesh."""
_INSIDE_SHARE, _DROP_SHARE = 0.1, 0.2

LooksAt = Callable[[Floats], NDArray[np.float64]]
"""Of points [P, 3] how many views show them, and how many look through them: [P, 2]."""


def clean(
    mesh: TriangleMesh,
    bounds: SceneBounds,
    max_faces: int,
    on_progress: Callable[[float], None] = lambda done: None,
    looks_at: LooksAt | None = None,
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
    on_progress(_INSIDE_SHARE)
    large = mesh.with_faces(faces[in_large_pieces(mesh.vertices, faces, looks_at)])
    on_progress(_DROP_SHARE)
    if len(large.faces) > max_faces:
        large = reduced(
            large,
            max_faces,
            lambda done: on_progress(_DROP_SHARE + (1.0 - _DROP_SHARE) * done),
        )
    a, b, c = large.faces.T
    faces = large.faces[(a != b) & (b != c) & (c != a)]
    large = large.with_faces(faces[in_large_pieces(large.vertices, faces, looks_at)])
    # Its numbers are small there, which normals are made of.
    origin = (bounds.box_min + bounds.box_max) / 2.0
    return from_open3d(to_open3d(large, origin), origin)


def in_large_pieces(
    vertices: Floats, faces: NDArray[np.integer], looks_at: LooksAt | None = None
) -> NDArray[np.bool_]:
    """[F]: faces [F, 3] of pieces with at least 2 % of the largest one's area, or with .05 % where
    five views show each of their faces in the mean, and half as many look through them at most.

    A piece is what hangs together by edges.
    """
    if len(faces) == 0:
        return np.zeros(0, np.bool_)
    piece = piece_of_faces(faces, len(vertices))
    first = vertices[faces[:, 0]]
    across = np.cross(vertices[faces[:, 1]] - first, vertices[faces[:, 2]] - first)
    areas = np.bincount(piece, np.linalg.norm(across, axis=1))
    kept = areas >= _MIN_SHARE * areas.max()
    small = ~kept & (areas >= _MIN_SURE_SHARE * areas.max())
    if looks_at is not None and small.any():
        asked = np.flatnonzero(small[piece])
        there, through = (
            np.bincount(piece[asked], looks, len(areas))
            for looks in looks_at(vertices[faces[asked]].mean(axis=1)).T
        )
        enough = there >= _SURE_VIEWS * np.bincount(piece, minlength=len(areas))
        kept |= small & enough & (through <= _SURE_THROUGH * there)
    of_faces: NDArray[np.bool_] = kept[piece]
    return of_faces


def piece_of_faces(faces: NDArray[np.integer], num_vertices: int) -> NDArray[np.integer]:
    """[F], which piece each of faces [F, 3] belongs to, counted from 0: what shares edges."""
    starts, ends = (faces[:, order].T.reshape(-1) for order in ([0, 1, 2], [1, 2, 0]))
    edge = np.minimum(starts, ends).astype(np.int64) * num_vertices + np.maximum(starts, ends)
    order = np.argsort(edge)
    same = np.flatnonzero(edge[order[1:]] == edge[order[:-1]])
    count = len(faces)
    one, two = order[same] % count, order[same + 1] % count
    links = coo_array((np.ones(len(same), np.int8), (one, two)), (count, count))
    piece: NDArray[np.integer] = connected_components(links, directed=False)[1]
    return piece
