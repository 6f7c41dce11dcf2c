"""A coloured triangle mesh: what surfaces are made as, and what the formats write."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_VERTICES_SHARE = 0.6
"""Of putting a mesh in order: when its vertices are."""


@dataclass(frozen=True)
class TriangleMesh:
    """vertices: [V, 3] world. faces: [F, 3] int32, counter-clockwise from outside.

    colors: [V, 3] in [0, 1], sRGB. normals: [V, 3], unit.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    colors: Floats
    normals: Floats

    def with_faces(self, faces: NDArray[np.int32]) -> TriangleMesh:
        """Some of its faces, with the vertices that they have."""
        kept, flat = np.unique(faces, return_inverse=True)
        return TriangleMesh(
            vertices=self.vertices[kept],
            faces=flat.reshape(-1, 3).astype(np.int32),
            colors=self.colors[kept],
            normals=self.normals[kept],
        )


@dataclass(frozen=True)
class TexturedMesh:
    """A triangle mesh with a picture on it; a vertex is there once for each of its places in it.

    vertices: [V, 3] world. faces: [F, 3] int32, counter-clockwise from outside. normals: [V, 3],
    unit. uv: [V, 2] in [0, 1] from the texture's top left corner, right and down.
    texture: [H, W, 3] uint8, sRGB.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    normals: Floats
    uv: Floats
    texture: NDArray[np.uint8]


def shifted(mesh: TriangleMesh | TexturedMesh, by: Floats) -> TriangleMesh | TexturedMesh:
    """A mesh elsewhere. by: [3]."""
    return replace(mesh, vertices=mesh.vertices + by)


def empty_mesh() -> TriangleMesh:
    """A mesh without vertices."""
    none = np.zeros((0, 3))
    return TriangleMesh(none, np.zeros((0, 3), np.int32), none, none)


def joined(pieces: Sequence[TriangleMesh]) -> TriangleMesh:
    """Meshes as one."""
    if not pieces:
        return empty_mesh()
    starts = np.cumsum([0, *(len(piece.vertices) for piece in pieces)])
    return TriangleMesh(
        vertices=np.concatenate([piece.vertices for piece in pieces]),
        faces=np.concatenate(
            [piece.faces + start for piece, start in zip(pieces, starts, strict=False)]
        ).astype(np.int32),
        colors=np.concatenate([piece.colors for piece in pieces]),
        normals=np.concatenate([piece.normals for piece in pieces]),
    )


def ordered(
    mesh: TriangleMesh, on_progress: Callable[[float], None] = lambda done: None
) -> TriangleMesh:
    """The same mesh whatever the order in which its vertices and faces came.

    Who finds surfaces with several threads numbers them by chance, and what goes on from there, as
    decimation does, follows the numbers: so each face begins with its least vertex, vertices and
    faces are sorted, and vertices at one place become one. Faces that lose a corner by that go.
    on_progress: told the share that is done between the sorts, seconds each for millions; may
    raise.
    """
    if len(mesh.vertices) == 0:
        return mesh
    told = np.concatenate([mesh.vertices, mesh.colors], axis=1)
    order = np.lexsort(told.T[::-1])
    on_progress(_VERTICES_SHARE)
    places = mesh.vertices[order]
    is_new = np.ones(len(order), np.bool_)
    is_new[1:] = (places[1:] != places[:-1]).any(axis=1)
    number = np.empty(len(order), np.int64)
    number[order] = np.cumsum(is_new) - 1
    faces = number[mesh.faces]
    whole = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    faces = faces[whole]
    first = faces.argmin(axis=1)[:, None]
    faces = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)
    faces = faces[np.lexsort((faces[:, 2], faces[:, 0] * len(order) + faces[:, 1]))]
    kept = order[is_new]
    return TriangleMesh(
        mesh.vertices[kept], faces.astype(np.int32), mesh.colors[kept], mesh.normals[kept]
    )


def unit_normals(normals: Floats) -> Floats:
    """[V, 3] at length 1; one that has no direction is +Z."""
    length = np.linalg.norm(normals, axis=1, keepdims=True)
    unit: Floats = np.where(length > 1e-12, normals / np.maximum(length, 1e-12), [0.0, 0.0, 1.0])
    return unit
