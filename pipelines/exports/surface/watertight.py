"""A mesh closed all over, for those who print it: each edge has two faces that go opposite ways.

Where more than two faces meet at an edge they are taken away, and small loose pieces with them.
Holes are closed as the surface goes on (`pipelines.exports.surface.hole_patches`), however large,
or with a flat lid. The border of what was filmed gets a wall to a flat base beyond all of its
piece: under a thing that stands on a piece of table that is a plinth. Walls may cross each other
where a border winds, and lids what lies in a hole.

Symbols: V vertices, F faces, L vertices of a loop.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.borders import Loop, border_loops, knotted_edges
from pipelines.exports.surface.clean import in_large_pieces
from pipelines.exports.surface.holes import close_holes, diameter
from pipelines.exports.surface.rings import MeshRings
from pipelines.exports.surface.triangulation import in_plane

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Faces = NDArray[np.integer]

_SAME = 1e-6
"""Of the mesh's size: vertices so near each other are one, as in files with 32-bit places."""
_BASE = 0.02
"""How far the base is beyond its piece, of the mesh's size."""
_GOES_ON = 0.3
"""Cosine between faces at a loop and its own normal, in the mean, that is a hole's."""
_ALIKE = 0.3
"""Cosine between a border's own normal and down, for its base to lie below."""


def is_closed(faces: Faces) -> bool:
    """Whether each edge of faces [F, 3] has two, that go opposite ways."""
    return len(faces) > 0 and not border_loops(faces) and not knotted_edges(faces).any()


def why_open(faces: Faces) -> str:
    """What keeps faces [F, 3] from being closed."""
    if len(faces) == 0:
        return "it has no faces."
    num_open = sum(len(loop.vertices) for loop in border_loops(faces))
    num_knotted = int(knotted_edges(faces).sum())
    return f"{num_open} edges have one face, and {num_knotted} sides of faces meet more than one."


def made_watertight(
    mesh: TriangleMesh,
    down: Floats | None = None,
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """The mesh closed all over; as it is where nothing of it can be.

    down: [3], unit, into what carries the thing, where that is known: bases lie so. on_progress:
    told the share that is done; may raise.
    """
    mended = _mended(mesh)
    if len(mended.faces) == 0:
        return mesh
    size = float(np.linalg.norm(np.ptp(mended.vertices, axis=0)))
    limit = np.full(1, size)
    whole = close_holes(mended, lambda points: limit.repeat(len(points)), (), on_progress).mesh
    loops = border_loops(whole.faces)
    sizes = [diameter(whole.vertices[loop.vertices]) for loop in loops]
    piece_of = _pieces(whole.faces, len(whole.vertices))
    based: set[int] = set()
    for index in sorted(range(len(loops)), key=lambda index: -sizes[index]):
        on_progress(1.0)
        loop = loops[index]
        piece = int(piece_of[loop.vertices[0]])
        if piece not in based and _is_outer(whole, loop):
            beyond = np.flatnonzero(piece_of == piece)
            out = _out_of(whole.vertices, loop)
            way = down if down is not None and float(down @ out) > _ALIKE else out
            whole = _with_base(whole, loop, way, beyond, _BASE * size)
        else:
            whole = _with_lid(whole, loop)
        based.add(piece)
    rings = MeshRings(whole.faces, len(whole.vertices))
    return replace(whole, normals=rings.normals(whole.vertices))


def _mended(mesh: TriangleMesh) -> TriangleMesh:
    """The mesh with vertices at one place as one, no knots and no small pieces."""
    origin = mesh.vertices.min(axis=0)
    size = float(np.ptp(mesh.vertices, axis=0).max()) or 1.0
    steps = np.round((mesh.vertices - origin) / (_SAME * size)).astype(np.int64)
    _, first, same = np.unique(steps, axis=0, return_index=True, return_inverse=True)
    faces = first[same.reshape(-1)][mesh.faces]
    while True:
        faces = _plain(faces)
        if len(faces) == 0:
            break
        knotted = knotted_edges(faces).reshape(-1, 3).any(axis=1)
        if not knotted.any():
            break
        faces = faces[~knotted]
    if len(faces):
        faces = faces[in_large_pieces(mesh.vertices, faces)]
    return mesh.with_faces(faces.astype(np.int32))


def _plain(faces: Ints) -> Ints:
    """Faces with three corners, each of them once."""
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    _, first = np.unique(np.sort(faces, axis=1), axis=0, return_index=True)
    kept: Ints = faces[np.sort(first)]
    return kept


def _pieces(faces: Faces, count: int) -> Ints:
    """[V], a number for each of the connected pieces."""
    pairs = faces[:, [0, 1, 1, 2]].reshape(-1, 2).T
    links = coo_array((np.ones(pairs.shape[1], np.int8), (pairs[0], pairs[1])), (count, count))
    label: Ints = connected_components(links, directed=False)[1].astype(np.int64)
    return label


def _across(vertices: Floats, faces: Faces) -> Floats:
    """[F, 3], the normals of faces, twice as long as their areas."""
    corners = vertices[faces]
    normals: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals


def _out_of(vertices: Floats, loop: Loop) -> Floats:
    """[3], unit: out of the mesh through a loop."""
    rim = vertices[loop.vertices]
    local = rim - rim.mean(axis=0)
    out = np.cross(local, np.roll(local, -1, axis=0)).sum(axis=0)
    length = float(np.linalg.norm(out))
    return out / length if length > 0.0 else np.array([0.0, 0.0, -1.0])


def _is_outer(mesh: TriangleMesh, loop: Loop) -> bool:
    """Whether the surface lies within a loop or beside it, and not all around."""
    normals = _across(mesh.vertices, mesh.faces[loop.faces])
    toward = normals @ _out_of(mesh.vertices, loop)
    return float(toward.sum()) < _GOES_ON * float(np.linalg.norm(normals, axis=1).sum())


def _flat(points: Floats, out: Floats) -> Floats:
    """[L, 2], points [L, 3] as seen from outside."""
    side = np.cross(out, np.eye(3)[np.abs(out).argmin()])
    side /= np.linalg.norm(side)
    seen: Floats = points @ np.stack([side, np.cross(out, side)], axis=1)
    return seen


def _with_lid(mesh: TriangleMesh, loop: Loop) -> TriangleMesh:
    """The mesh with a flat lid on a loop, or a tent where an edge would get a third face."""
    rim = mesh.vertices[loop.vertices]
    lid = loop.vertices[in_plane(_flat(rim, _out_of(mesh.vertices, loop)))]
    at_rim = np.zeros(len(mesh.vertices), np.bool_)
    at_rim[loop.vertices] = True
    near = mesh.faces[at_rim[mesh.faces].any(axis=1)]
    if not knotted_edges(np.concatenate([near, lid])).any():
        return replace(mesh, faces=np.concatenate([mesh.faces, lid]).astype(np.int32))
    top = np.full(len(rim), len(mesh.vertices))
    tent = np.stack([loop.vertices, np.roll(loop.vertices, -1), top], axis=1)
    return TriangleMesh(
        np.concatenate([mesh.vertices, rim.mean(axis=0, keepdims=True)]),
        np.concatenate([mesh.faces, tent]).astype(np.int32),
        np.concatenate([mesh.colors, mesh.colors[loop.vertices].mean(axis=0, keepdims=True)]),
        np.concatenate([mesh.normals, _out_of(mesh.vertices, loop)[None]]),
    )


def _with_base(
    mesh: TriangleMesh, loop: Loop, out: Floats, piece: Ints, depth: float
) -> TriangleMesh:
    """The mesh with a wall from a border to a plane beyond its piece, and what closes that.

    out: [3], unit, the way of the wall. piece: its vertices. depth: how far beyond.
    """
    rim = mesh.vertices[loop.vertices]
    level = float((mesh.vertices[piece] @ out).max()) + depth
    foot = rim + (level - rim @ out)[:, None] * out
    below = len(mesh.vertices) + np.arange(len(rim))
    after, below_after = np.roll(loop.vertices, -1), np.roll(below, -1)
    parts = [
        mesh.faces,
        np.stack([loop.vertices, after, below_after], axis=1),
        np.stack([loop.vertices, below_after, below], axis=1),
        below[in_plane(_flat(foot, out))],
    ]
    return TriangleMesh(
        np.concatenate([mesh.vertices, foot]),
        np.concatenate(parts).astype(np.int32),
        np.concatenate([mesh.colors, mesh.colors[loop.vertices]]),
        np.concatenate([mesh.normals, np.tile(out, (len(rim), 1))]),
    )
