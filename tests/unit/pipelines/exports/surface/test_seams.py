"""Two fusions of one table, a fraction of a voxel apart, and who looks along it."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.surface.seams import seamless
from pipelines.exports.surface.shells import Shell
from pipelines.judging.asset_views import MeshCaster
from pipelines.scene.bounds import SceneBounds

VOXEL = 0.05
"""The outer shell's; the inner one's is half as large."""


def shells(center: np.ndarray) -> list[Shell]:
    def around(reach: float) -> SceneBounds:
        return SceneBounds(center, 1.0, 2.0 * reach, center - reach, center + reach)

    return [Shell(around(1.0), VOXEL / 2.0), Shell(around(2.0), VOXEL)]


def plate(step: float, least: float, most: float, height: float) -> TriangleMesh:
    """A level square up to |x|, |y| = most, with a square hole up to `least`."""
    count = round(2.0 * most / step)
    x, y = np.meshgrid(*[np.linspace(-most, most, count + 1)] * 2)
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, height)], axis=1)
    index = np.arange(x.size).reshape(x.shape)
    a, b, c, d = (
        part.ravel() for part in (index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1])
    )
    faces = np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])
    inside = (np.abs(vertices[:, :2]) < least + 1e-9).all(axis=1)
    plain = np.full((len(vertices), 3), 0.5), np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    whole = TriangleMesh(vertices, faces.astype(np.int32), *plain)
    return whole.with_faces(whole.faces[~inside[whole.faces].all(axis=1)]) if least else whole


def two(apart: float, center: np.ndarray) -> TriangleMesh:
    """The inner one ends at 1, the outer one begins a voxel before."""
    mesh = joined([plate(VOXEL / 2.0, 0.0, 1.0, 0.0), plate(VOXEL, 1.0 - VOXEL, 2.0, apart)])
    return TriangleMesh(mesh.vertices + center, mesh.faces, mesh.colors, mesh.normals)


def missed_along(mesh: TriangleMesh, center: np.ndarray) -> float:
    """The share of rays that a table does not stop, seen at 6 degrees from its middle."""
    across = np.linspace(-0.9, 0.9, 31)
    down = np.linspace(0.06, 0.16, 400)  # reach the table from 0.625 to 1.67 away
    rays = np.stack(
        [
            np.ones((31, 400)),
            np.broadcast_to(across[:, None], (31, 400)) * 0.3,
            -np.broadcast_to(down[None, :], (31, 400)),
        ],
        axis=-1,
    ).reshape(-1, 3)
    rays /= np.linalg.norm(rays, axis=1, keepdims=True)
    caster = MeshCaster(mesh.vertices - center, mesh.faces, mesh.colors)
    eyes = np.broadcast_to([0.0, 0.0, 0.1], rays.shape)
    return 1.0 - float(caster.along(eyes, rays, (31, 400)).hit.mean())


@pytest.mark.parametrize("center", [np.zeros(3), np.array([1e6, -2e6, 50.0])])
@pytest.mark.parametrize("apart", [0.8 * VOXEL, 0.3 * VOXEL])
def test_who_looks_along_a_table_sees_no_crack(apart: float, center: np.ndarray) -> None:
    before = two(apart, center)
    after = seamless(before, shells(center))
    assert missed_along(before, center) > 0.02
    assert missed_along(after, center) < 0.001
    np.testing.assert_array_equal(after.faces, before.faces)
    moved = after.vertices - before.vertices
    np.testing.assert_allclose(moved[:, :2], 0.0, atol=1e-6)
    reach = np.abs(before.vertices[:, :2] - center[:2]).max(axis=1)
    outer = before.vertices[:, 2] - center[2] > 0.0
    np.testing.assert_allclose(moved[~outer], 0.0, atol=1e-12)
    np.testing.assert_allclose(moved[outer & (reach > 1.0 + 4.01 * VOXEL)], 0.0, atol=1e-12)
    np.testing.assert_allclose(moved[outer & (reach < 1.001), 2], -apart, rtol=1e-3)


def test_what_is_another_surface_stays() -> None:
    """A lid two voxels above, a wall that stands on the border, and a mesh of one shell."""
    lid = two(2.1 * VOXEL, np.zeros(3))
    after = seamless(lid, shells(np.zeros(3)))
    np.testing.assert_allclose(after.vertices, lid.vertices, atol=1e-12)
    far_side = two(0.5 * VOXEL, np.zeros(3))
    back = far_side.vertices[:, 2] > 0.0
    far_side.normals[back] *= -1.0
    after = seamless(far_side, shells(np.zeros(3)))
    np.testing.assert_allclose(after.vertices, far_side.vertices, atol=1e-12)
    standing = plate(VOXEL, 0.0, 0.5, 0.0)
    turned = standing.vertices[:, [2, 1, 0]] + [1.0 + 0.5 * VOXEL, 0.0, 0.6]
    wall = TriangleMesh(
        turned, standing.faces, standing.colors, np.tile([1.0, 0.0, 0.0], (len(turned), 1))
    )
    both = joined([plate(VOXEL / 2.0, 0.0, 1.0, 0.0), wall])
    after = seamless(both, shells(np.zeros(3)))
    np.testing.assert_allclose(after.vertices, both.vertices, atol=1e-12)
    alone = plate(VOXEL, 0.0, 1.0, 0.0)
    assert seamless(alone, shells(np.zeros(3))[:1]) is alone
    none = alone.with_faces(alone.faces[:0])
    assert seamless(none, shells(np.zeros(3))) is none
