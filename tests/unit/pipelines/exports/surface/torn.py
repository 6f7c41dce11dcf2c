"""Sheets and balls with holes in them, and cameras before them, for tests."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.rings import MeshRings
from pipelines.scene.depth_views import DepthView, Pinhole

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

SIDE = 0.1
"""Of a square of the sheets."""


def coloured(vertices: Floats, faces: NDArray[np.integer]) -> TriangleMesh:
    """A mesh whose colours are its places."""
    colors = np.clip(0.5 + 0.2 * vertices, 0.0, 1.0)
    made = TriangleMesh(vertices, faces.astype(np.int32), colors, np.zeros_like(vertices))
    normals = MeshRings(made.faces, len(vertices)).normals(vertices)
    return TriangleMesh(vertices, made.faces, colors, normals).with_faces(made.faces)


def sheet(hole: Callable[[Floats], Bools], num: int = 30, height: float = 0.0) -> TriangleMesh:
    """A level square of num x num squares around the origin, seen from +Z, without the squares
    whose middles [N, 2] are in the hole."""
    steps = SIDE * (np.arange(num + 1) - num / 2.0)
    x, y = np.meshgrid(steps, steps, indexing="ij")
    vertices = np.stack([x, y, np.full_like(x, height)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(num), np.arange(num), indexing="ij")
    low = (i * (num + 1) + j).reshape(-1)
    quads = np.stack([low, low + num + 1, low + num + 2, low + 1], axis=1)
    quads = quads[~hole(vertices[quads].mean(axis=1)[:, :2])]
    return coloured(vertices, np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]))


def ball(gone: Callable[[Floats], Bools], subdivisions: int = 4) -> TriangleMesh:
    """A ball of radius 1, an icosahedron refined, without faces whose middles [N, 3] are gone."""
    golden = (1.0 + 5.0**0.5) / 2.0
    corners = [
        corner
        for one in (-1.0, 1.0)
        for two in (-golden, golden)
        for corner in ((0.0, one, two), (one, two, 0.0), (two, 0.0, one))
    ]
    vertices = np.array(corners) / np.hypot(1.0, golden)
    far = np.linalg.norm(vertices[:, None] - vertices[None], axis=2)
    near = far < 1.1
    faces = [
        (a, b, c)
        for a in range(12)
        for b in range(a + 1, 12)
        for c in range(b + 1, 12)
        if near[a, b] and near[b, c] and near[a, c]
    ]
    made = [f if np.linalg.det(vertices[list(f)]) > 0.0 else (f[0], f[2], f[1]) for f in faces]
    grid = np.array(made)
    for _ in range(subdivisions):
        middles = [(vertices[grid[:, k]] + vertices[grid[:, (k + 1) % 3]]) for k in range(3)]
        count, number = len(vertices), len(grid)
        vertices = np.concatenate([vertices, *middles])
        vertices /= np.linalg.norm(vertices, axis=1, keepdims=True)
        ab, bc, ca = (count + k * number + np.arange(number) for k in range(3))
        a, b, c = grid.T
        parts = [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)]
        grid = np.concatenate([np.stack(part, axis=1) for part in parts])
        _, first, same = np.unique(
            np.round(vertices, 9), axis=0, return_index=True, return_inverse=True
        )
        grid, vertices = same.reshape(-1)[grid], vertices[first]
    return coloured(vertices, grid[~gone(vertices[grid].mean(axis=1))])


def looking_down(depth_at: Callable[[Floats], Floats], count: int = 4) -> list[DepthView]:
    """Cameras at height 5, above the origin and beside it, that see depths at rays' places on the
    ground [H, W, 2]."""
    lens = Pinhole(200, 200, 250.0, 250.0, 100.0, 100.0)
    found = []
    for place in np.linspace(-0.5, 0.5, count):
        pose = np.concatenate([np.eye(3), [[place], [0.0], [5.0]]], axis=1)
        ground = 5.0 * lens.directions()[..., :2] + pose[:2, 3]
        z_depth = depth_at(ground).astype(np.float32)
        found.append(DepthView(lens, pose, np.zeros((200, 200, 3), np.uint8), z_depth))
    return found


def within(radius: float) -> Callable[[Floats], Bools]:
    """Whether points [N, 2] or [N, 3] are so near the origin."""
    return lambda points: np.linalg.norm(points, axis=1) < radius


def num_open_edges(faces: NDArray[np.integer]) -> int:
    """Edges that have not two faces."""
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    _, count = np.unique(sides, axis=0, return_counts=True)
    return int((count != 2).sum())
