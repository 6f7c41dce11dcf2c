"""A fused mesh without the noise of its voxels, its edges kept.

Depths that are averaged in voxels leave a surface whose triangles tremble, where views are few as
in rooms, by a good part of a voxel: what has texture looks crumpled in any light. So first the
triangles' normals are smoothed, each with those of all triangles that touch it, the less the more
they differ (as a box's sides do):

    n_i <- sum_j A_j exp(-|n_i - n_j|^2 / 2 s^2) n_j, of length 1

and then vertices move until triangles have these normals, each by the mean, over the triangles
around it, of the way along the triangle's normal to its middle. Sources: Zheng, Fu, Au, Tai,
"Bilateral Normal Filtering for Mesh Denoising", TVCG 2011; Sun, Rosin, Martin, Langbein, "Fast and
Effective Feature-Preserving Mesh Denoising", TVCG 2007, for the vertices.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.rings import MeshRings

Floats = NDArray[np.float64]

_ANGLE_DEG = 25.0
"""Normals that differ by so much weigh exp(-1/2) as much: noise turns them by 15 degrees in the
median, edges by 90. With 35 a right angle is rounded by a third of a voxel."""
_NORMAL_ROUNDS, _VERTEX_ROUNDS = 10, 10
_MOST_MOVED = 0.5
"""Edges: 19 of 20 vertices go less far, and what would go farther is a spike."""
_SHEET_ROUNDS = 5
_THIN, _FOLDED = 0.47, 0.57
"""Length of the mean normal around a vertex, so many rings: about a tube three edges wide at most,
and along a noisy fold of a right angle at least. In between moves fade."""
_PORTION = 100_000
"""Of the triangles at a time: each has about twelve beside it."""


def denoised(
    mesh: TriangleMesh, on_progress: Callable[[float], None] = lambda done: None
) -> TriangleMesh:
    """The mesh with its vertices moved; those on open borders stay, as do faces and colours.

    on_progress: told the share that is done; may raise.
    """
    if len(mesh.faces) == 0:
        return mesh
    faces = mesh.faces
    origin = mesh.vertices.mean(axis=0)
    vertices = mesh.vertices - origin
    rings = MeshRings(faces, len(vertices))
    begun, farthest = vertices, _MOST_MOVED * rings.edge_lengths(vertices)
    beside = _touching(faces, len(vertices))
    across = _across(vertices, faces)
    double_area = np.linalg.norm(across, axis=1)
    normals = across / np.maximum(double_area, 1e-30)[:, None]
    rounds = _NORMAL_ROUNDS + _VERTEX_ROUNDS
    for done in range(_NORMAL_ROUNDS):
        on_progress(done / rounds)
        normals = np.concatenate(
            [
                _smoothed(normals, double_area, beside, slice(first, first + _PORTION))
                for first in range(0, len(faces), _PORTION)
            ]
        )
    del beside  # the largest of all
    corner, face = faces.ravel(), np.repeat(np.arange(len(faces)), 3)
    around = np.maximum(np.bincount(corner, minlength=len(vertices)), 1)[:, None]
    for done in range(_NORMAL_ROUNDS, rounds):
        on_progress(done / rounds)
        middle = vertices[faces].mean(axis=1)
        way = ((middle[face] - vertices[corner]) * normals[face]).sum(axis=1, keepdims=True)
        moves = _sums(corner, way * normals[face], len(vertices)) / around
        moves[rings.on_border] = 0.0
        vertices = vertices + moves
    moves = _sheet(begun, rings)[:, None] * (vertices - begun)
    length = np.linalg.norm(moves, axis=1)
    vertices = begun + np.minimum(1.0, farthest / np.maximum(length, 1e-30))[:, None] * moves
    on_progress(1.0)
    return replace(mesh, vertices=vertices + origin, normals=rings.normals(vertices))


def _sheet(vertices: Floats, rings: MeshRings) -> Floats:
    """[V] in [0, 1]: 1 where the surface around a vertex is a sheet, folded at most, and 0 where it
    closes around something thin, which would become facets."""
    straight = rings.straightness(vertices, _SHEET_ROUNDS)
    sheet: Floats = np.clip((straight - _THIN) / (_FOLDED - _THIN), 0.0, 1.0)
    return sheet


def _touching(faces: NDArray[np.integer[Any]], num_vertices: int) -> csr_array:
    """[F, F]: what is not 0 where two faces have a corner in common, and of each with itself."""
    corners = np.repeat(np.arange(len(faces)), 3), faces.ravel()
    of_face = coo_array((np.ones(faces.size, np.float32), corners), (len(faces), num_vertices))
    touching: csr_array = (of_face.tocsr() @ of_face.tocsr().T).tocsr()
    return touching


def _smoothed(normals: Floats, area: Floats, beside: csr_array, some: slice) -> Floats:
    """Some of the normals [F, 3], each the mean of those beside it. area: [F]."""
    begin, end, _ = some.indices(len(normals))
    others = beside.indices[beside.indptr[begin] : beside.indptr[end]]
    own = np.repeat(np.arange(begin, end), np.diff(beside.indptr[begin : end + 1]))
    near = normals[others]
    apart = ((normals[own] - near) ** 2).sum(axis=1)
    weight = area[others] * np.exp(-apart / (4.0 * (1.0 - np.cos(np.radians(_ANGLE_DEG)))))
    total = _sums(own - begin, weight[:, None] * near, end - begin)
    smooth: Floats = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-30)
    return smooth


def _across(vertices: Floats, faces: NDArray[np.integer[Any]]) -> Floats:
    """[F, 3]: along each face's normal, as long as twice its area."""
    corners = vertices[faces]
    across: Floats = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return across


def _sums(at: NDArray[np.integer[Any]], values: Floats, count: int) -> Floats:
    """[count, 3]: the sums of values [N, 3] by their numbers [N]."""
    return np.stack([np.bincount(at, column, minlength=count) for column in values.T], axis=1)
