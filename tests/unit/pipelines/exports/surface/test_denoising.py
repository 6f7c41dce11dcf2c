"""The noise of voxels taken from a mesh, and its edges left."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh, empty_mesh
from pipelines.exports.surface import denoising
from pipelines.exports.surface.denoising import denoised
from pipelines.exports.surface.rings import MeshRings

Floats = NDArray[np.float64]

SIDE, VOXEL, NOISE = 40, 0.05, 0.015


def step(noise: float = NOISE) -> TriangleMesh:
    """Floor and wall, a fold of 90 degrees along x, SIDE x 2 SIDE triangles' pairs, far from the
    origin. noise: of the vertices, each way."""
    x, t = np.meshgrid(np.arange(SIDE + 1.0), np.arange(-SIDE, SIDE + 1.0), indexing="ij")
    vertices = VOXEL * np.stack([x, np.minimum(t, 0.0), np.maximum(t, 0.0)], axis=-1).reshape(-1, 3)
    number = np.arange(len(vertices)).reshape(x.shape)
    a, b, c, d = number[:-1, :-1], number[1:, :-1], number[1:, 1:], number[:-1, 1:]
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([a, c, d], -1)], axis=1)
    faces = faces.reshape(-1, 3).astype(np.int32)
    trembling = vertices + np.random.default_rng(0).normal(0.0, noise, vertices.shape) + 1000.0
    normals = MeshRings(faces, len(vertices)).normals(trembling)
    return TriangleMesh(trembling, faces, np.full((len(vertices), 3), 0.5), normals)


def face_normals(mesh: TriangleMesh) -> Floats:
    corners = mesh.vertices[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    unit: Floats = across / np.linalg.norm(across, axis=1, keepdims=True)
    return unit


def off_deg(mesh: TriangleMesh) -> Floats:
    """[F]: how far the faces' normals are from those without noise."""
    cosine = (face_normals(mesh) * face_normals(step(0.0))).sum(axis=1)
    off: Floats = np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0)))
    return off


def off_surface(mesh: TriangleMesh) -> Floats:
    """[V]: how far inner vertices are from the planes, fold and all."""
    inner = ~MeshRings(mesh.faces, len(mesh.vertices)).on_border
    _, y, z = (mesh.vertices[inner] - 1000.0).T
    away: Floats = np.minimum(np.hypot(np.maximum(y, 0.0), z), np.hypot(y, np.minimum(z, 0.0)))
    return away


def test_planes_become_smooth_and_their_fold_stays() -> None:
    before = step()
    after = denoised(before)
    assert np.median(off_deg(before)) > 15.0
    assert np.median(off_deg(after)) < 4.0
    # Two triangles beside the fold on either side.
    middle = before.vertices[before.faces].mean(axis=1) - 1000.0
    beside = (np.abs(middle[:, 1]) < 2 * VOXEL) & (middle[:, 2] < 2 * VOXEL)
    assert np.median(off_deg(after)[beside]) < 8.0
    assert np.quantile(off_surface(before), 0.95) > 1.8 * NOISE
    assert np.quantile(off_surface(after), 0.95) < 1.2 * NOISE
    assert np.array_equal(after.faces, before.faces)
    assert np.array_equal(after.colors, before.colors)
    assert np.allclose(np.linalg.norm(after.normals, axis=1), 1.0)


def test_what_has_no_noise_stays() -> None:
    before = step(0.0)
    assert np.abs(denoised(before).vertices - before.vertices).max() < 0.03 * VOXEL


def test_open_borders_stay() -> None:
    before = step()
    border = MeshRings(before.faces, len(before.vertices)).on_border
    moved = np.linalg.norm(denoised(before).vertices - before.vertices, axis=1)
    assert border.sum() > 100
    assert moved[border].max() < 1e-9
    assert (moved[~border] > 1e-4).mean() > 0.9


def tube(radius: float, noise: float) -> tuple[TriangleMesh, Floats]:
    """Around z, of edges about 1 long, and how far each inner vertex is from its axis."""
    around, length = round(2.0 * np.pi * radius), 40
    turn, z = np.meshgrid(np.arange(around), np.arange(length), indexing="ij")
    angle = 2.0 * np.pi * turn / around
    at = np.stack([radius * np.cos(angle), radius * np.sin(angle), z], axis=-1).reshape(-1, 3)
    at += np.random.default_rng(0).normal(0.0, noise, at.shape)
    a, b = ((some[:, :-1] % around * length + z[:, :-1]).ravel() for some in (turn, turn + 1))
    faces = np.concatenate([np.stack([a, b, b + 1], 1), np.stack([a, b + 1, a + 1], 1)])
    mesh = TriangleMesh(at, faces.astype(np.int32), np.zeros_like(at), np.zeros_like(at))
    return mesh, roughness(mesh, radius)


def roughness(mesh: TriangleMesh, radius: float) -> Floats:
    _, _, z = mesh.vertices.T
    away: Floats = np.hypot(*mesh.vertices.T[:2]) - radius
    return away[(z > 5.0) & (z < 34.0)]


@pytest.mark.parametrize(("radius", "of_before"), [(1.0, 1.05), (1.5, 1.05), (3.0, 0.5)])
def test_legs_of_chairs_are_not_made_facets(radius: float, of_before: float) -> None:
    """What is thin stays as it is, what is thick becomes smooth."""
    before, rough = tube(radius, 0.1)
    after = roughness(denoised(before), radius)
    assert np.sqrt((rough**2).mean()) > 0.08
    assert np.sqrt((after**2).mean()) < of_before * np.sqrt((rough**2).mean())


def test_no_vertex_goes_farther_than_half_an_edge() -> None:
    before = step(0.6 * VOXEL)
    moved = np.linalg.norm(denoised(before).vertices - before.vertices, axis=1)
    edges = MeshRings(before.faces, len(before.vertices)).edge_lengths(before.vertices)
    assert (moved > 0.45 * edges).any()
    assert (moved < 0.501 * edges).all()


def test_portions_of_the_triangles_make_no_difference(monkeypatch: pytest.MonkeyPatch) -> None:
    whole = denoised(step())
    monkeypatch.setattr(denoising, "_PORTION", 997)
    assert np.abs(denoised(step()).vertices - whole.vertices).max() < 1e-9


def test_progress_is_told_and_what_it_raises_ends_it() -> None:
    told: list[float] = []
    denoised(step(), told.append)
    assert told == sorted(told)
    assert told[0] == 0.0
    assert told[-1] == 1.0

    def cancel(done: float) -> None:
        raise InterruptedError

    with pytest.raises(InterruptedError):
        denoised(step(), cancel)
    assert len(denoised(empty_mesh()).faces) == 0
