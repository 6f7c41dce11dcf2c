"""Meshes as such: their order."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh, empty_mesh, ordered
from tests.unit.pipelines.exports.formats import solids


def grid(side: int = 12) -> TriangleMesh:
    """A wavy square, with two vertices at the place of one and a face between them."""
    x, y = np.meshgrid(np.arange(side), np.arange(side))
    vertices = np.stack([x, y, np.sin(x + 2.0 * y)], axis=-1).reshape(-1, 3).astype(float)
    at = np.arange(side * side).reshape(side, side)
    first = np.stack([at[:-1, :-1], at[:-1, 1:], at[1:, :-1]], axis=-1).reshape(-1, 3)
    second = np.stack([at[:-1, 1:], at[1:, 1:], at[1:, :-1]], axis=-1).reshape(-1, 3)
    faces = np.concatenate([first, second])
    vertices = np.concatenate([vertices, vertices[:1]])
    faces[0, 0] = len(vertices) - 1
    faces = np.concatenate([faces, [[0, 1, len(vertices) - 1]]]).astype(np.int32)
    colors = np.random.default_rng(0).random(vertices.shape)
    colors[-1] = colors[0]
    return TriangleMesh(vertices, faces, colors, np.zeros_like(vertices))


def shuffled(mesh: TriangleMesh, seed: int) -> TriangleMesh:
    """Numbered by chance, each face from another of its corners on."""
    rng = np.random.default_rng(seed)
    order = rng.permutation(len(mesh.vertices))
    number = np.argsort(order)
    faces = number[mesh.faces][rng.permutation(len(mesh.faces))]
    turn = rng.integers(0, 3, len(faces))[:, None]
    faces = np.take_along_axis(faces, (turn + np.arange(3)) % 3, axis=1)
    return TriangleMesh(
        mesh.vertices[order], faces.astype(np.int32), mesh.colors[order], mesh.normals[order]
    )


@pytest.mark.parametrize("mesh", [grid(), solids.coloured()], ids=["grid", "solid"])
def test_a_mesh_is_the_same_however_it_was_numbered(mesh: TriangleMesh) -> None:
    wanted = ordered(mesh)
    for seed in range(5):
        found = ordered(shuffled(mesh, seed))
        for name in ("vertices", "faces", "colors"):
            np.testing.assert_array_equal(getattr(found, name), getattr(wanted, name))


def test_it_is_still_that_mesh() -> None:
    mesh = grid()
    made = ordered(mesh)
    assert len(made.vertices) == len(mesh.vertices) - 1
    assert len(made.faces) == len(mesh.faces) - 1, "the face between two at one place is gone"

    def triangles(one: TriangleMesh) -> set[tuple[tuple[float, ...], ...]]:
        corners = [[tuple(one.vertices[corner].tolist()) for corner in face] for face in one.faces]
        turns = [min(face[k:] + face[:k] for k in range(3)) for face in corners]
        return {tuple(face) for face in turns if len(set(face)) == 3}

    assert triangles(made) == triangles(mesh), "the same faces, the same way out"
    lookup = {tuple(place): color for place, color in zip(made.vertices, made.colors, strict=True)}
    for place, color in zip(mesh.vertices, mesh.colors, strict=True):
        np.testing.assert_array_equal(lookup[tuple(place)], color)
    assert len(ordered(empty_mesh()).vertices) == 0
