"""Cleaning and simplifying a mesh: what stays, what goes, and in which order."""

from __future__ import annotations

import numpy as np
import open3d
import pytest

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.clean import clean, in_large_pieces
from pipelines.exports.surface.open3d_mesh import to_open3d
from pipelines.exports.surface.tsdf import fuse
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_view

CENTER = np.array([1000.0, -500.0, 7.0])


def bounds_around(center: np.ndarray, half: float = 1.3) -> SceneBounds:
    return SceneBounds(center, 3.0, 6.0, center - half, center + half)


@pytest.fixture(scope="module")
def sphere() -> TriangleMesh:
    made = open3d.geometry.TriangleMesh.create_sphere(1.0, 40)
    points = np.asarray(made.vertices)
    return TriangleMesh(
        points + CENTER, np.asarray(made.triangles, np.int32), 0.5 + 0.3 * points, points
    )


def test_cleaning_simplifies_and_keeps_the_shape(sphere: TriangleMesh) -> None:
    mesh = clean(sphere, bounds_around(CENTER), 800)
    assert 400 < len(mesh.faces) <= 816, "a few more stay where none can go"
    assert np.abs(np.linalg.norm(mesh.vertices - CENTER, axis=1) - 1.0).max() < 0.05
    assert mesh.colors.shape == mesh.normals.shape == mesh.vertices.shape


def test_small_loose_pieces_and_what_is_out_of_bounds_are_dropped(sphere: TriangleMesh) -> None:
    speck = np.array([[1.2, 0, 0], [1.25, 0, 0], [1.2, 0.05, 0]]) + CENTER
    both = TriangleMesh(
        np.concatenate((sphere.vertices, speck)),
        np.concatenate((sphere.faces, np.arange(3, dtype=np.int32)[None] + len(sphere.vertices))),
        np.concatenate((sphere.colors, np.zeros((3, 3)))),
        np.concatenate((sphere.normals, np.tile([0.0, 0, 1], (3, 1)))),
    )
    mesh = clean(both, bounds_around(CENTER), 10**6)
    assert np.linalg.norm(mesh.vertices - CENTER, axis=1).max() < 1.1
    half = SceneBounds(CENTER, 3.0, 6.0, CENTER - 1.3, CENTER + np.array([0.0, 1.3, 1.3]))
    assert clean(both, half, 10**6).vertices[:, 0].max() <= CENTER[0]


def test_a_piece_hangs_together_by_edges() -> None:
    vertices = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [-0.1, 0, 0], [0, -0.1, 0.0]])
    faces = np.array([[0, 1, 2], [3, 2, 0], [0, 4, 5]], np.int32)  # a square, a chip at its corner

    assert in_large_pieces(vertices, faces).tolist() == [True, True, False]
    assert in_large_pieces(vertices, faces[2:]).tolist() == [True]
    assert in_large_pieces(vertices, faces[:0]).tolist() == []


def test_a_small_piece_stays_where_many_views_show_it_and_few_see_through() -> None:
    """A wall of two triangles; loose before it, a chip of a hundredth and one of a millionth."""
    wall = np.array([[0, 0, 0], [10, 0, 0], [10, 10, 0], [0, 10, 0.0]])
    chips = [np.array([[x, 0, 1], [x + s, 0, 1], [x, s, 1.0]]) for x, s in ((1, 1.4), (5, 0.01))]
    vertices = np.concatenate([wall, *chips])
    faces = np.array([[0, 1, 2], [0, 2, 3], [4, 5, 6], [7, 8, 9]], np.int32)

    def kept(there: float, through: float) -> list[bool]:
        def looks_at(points: np.ndarray) -> np.ndarray:
            assert (points[:, 2] == 1.0).all(), "large ones need no asking"
            return np.tile([there, through], (len(points), 1))

        return in_large_pieces(vertices, faces, looks_at).tolist()

    assert in_large_pieces(vertices, faces).tolist() == [True, True, False, False]
    assert kept(9, 2) == [True, True, True, False]
    assert kept(4, 0) == [True, True, False, False], "few show it"
    assert kept(9, 5) == [True, True, False, False], "many see through it"


def noisy_view(lens: Pinhole, pose: np.ndarray, rng: np.random.Generator) -> DepthView:
    view = sphere_view(lens, pose, CENTER)
    noise = 1.0 + 0.01 * rng.normal(size=view.z_depth.shape)
    z_depth = np.where(view.z_depth > 0, view.z_depth * noise, 0.0).astype(np.float32)
    return DepthView(lens, pose, view.rgb, z_depth)


def test_simplifying_leaves_no_crumbs() -> None:
    """A rough surface hangs together by single edges, which decimation tears."""
    rng = np.random.default_rng(0)
    lens = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0)
    views = [noisy_view(lens, pose, rng) for pose in ring(12, CENTER)]
    fused = fuse(views, bounds_around(CENTER), 2.6 / 64)
    mesh = clean(fused, bounds_around(CENTER), 2000)
    assert len(mesh.faces) > 1000
    areas = np.asarray(to_open3d(mesh, CENTER).cluster_connected_triangles()[2])
    assert areas.min() >= 0.02 * areas.max()


def test_nothing_inside_the_bounds_leaves_nothing(sphere: TriangleMesh) -> None:
    assert len(clean(sphere, bounds_around(CENTER + 100.0), 1000).vertices) == 0
