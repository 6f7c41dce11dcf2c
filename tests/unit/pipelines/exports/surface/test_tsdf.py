"""Fusing depth views: the surface where it is, the right way out, in the world frame."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface import tsdf
from pipelines.exports.surface.clean import clean
from pipelines.exports.surface.tsdf import affordable_blocks, fuse
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.depth_views import DepthView, Pinhole, ViewStore, z_depth_of
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_color, sphere_view

CENTER = np.array([1000.0, -500.0, 7.0])
RESOLUTION = 64
VOXEL = 2.6 / RESOLUTION
LENS = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0)


def bounds_around(center: np.ndarray, half: float = 1.3) -> SceneBounds:
    return SceneBounds(center, 3.0, 6.0, center - half, center + half)


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    return [sphere_view(LENS, pose, CENTER) for pose in ring(12, CENTER)]


@pytest.fixture(scope="module")
def sphere(views: list[DepthView]) -> TriangleMesh:
    return fuse(views, bounds_around(CENTER), VOXEL)


def test_vertices_lie_within_a_voxel_of_the_sphere(sphere: TriangleMesh) -> None:
    voxel = 2.6 / RESOLUTION
    off = np.abs(np.linalg.norm(sphere.vertices - CENTER, axis=1) - 1.0)
    assert len(sphere.vertices) > 2000
    assert off.max() < voxel
    assert off.mean() < 0.2 * voxel


def test_the_same_views_give_the_same_mesh_to_the_last_bit(views: list[DepthView]) -> None:
    first, *others = (fuse(views, bounds_around(CENTER), VOXEL) for _ in range(3))
    for other in others:
        for name in ("vertices", "faces", "colors", "normals"):
            np.testing.assert_array_equal(getattr(other, name), getattr(first, name), name)


def test_faces_and_normals_point_outwards(sphere: TriangleMesh) -> None:
    a, b, c = (sphere.vertices[sphere.faces[:, i]] for i in range(3))
    facing = (np.cross(b - a, c - a) * (a - CENTER)).sum(axis=1)
    assert (facing > 0).mean() > 0.99
    outward = sphere.vertices - CENTER
    assert (outward * sphere.normals).sum(axis=1).min() > 0.7


def test_colors_are_those_seen(sphere: TriangleMesh) -> None:
    wanted = sphere_color(sphere.vertices, CENTER)
    assert np.abs(sphere.colors - wanted).mean() < 0.02


def test_a_ghost_seen_by_one_view_is_carved_away_by_the_others(views: list[DepthView]) -> None:
    haunted = views[0].z_depth.copy()
    haunted[55:65, 75:85] = 1.0
    ghost = DepthView(LENS, views[0].world_from_camera, views[0].rgb, haunted)
    mesh = clean(fuse([ghost, *views[1:]], bounds_around(CENTER, 2.5), 5.0 / 128), _wide(), 10**6)
    off = np.abs(np.linalg.norm(mesh.vertices - CENTER, axis=1) - 1.0)
    assert off.max() < 0.1


@pytest.mark.parametrize(("num_views", "is_believed"), [(1, False), (2, True), (3, True)])
def test_a_surface_takes_two_views(
    views: list[DepthView], num_views: int, is_believed: bool
) -> None:
    mesh = fuse([views[0]] * num_views, bounds_around(CENTER), VOXEL)
    assert (len(mesh.faces) > 1000) == is_believed


def _wide() -> SceneBounds:
    return bounds_around(CENTER, 2.5)


def test_nothing_inside_the_bounds_gives_an_empty_mesh(views: list[DepthView]) -> None:
    far = bounds_around(CENTER + 100.0)
    assert len(fuse(views, far, 2.6 / 32).vertices) == 0


def test_a_view_with_a_speck_of_surface_takes_nothing_from_the_others(
    views: list[DepthView], sphere: TriangleMesh
) -> None:
    """Open3D looks at every fourth pixel, and fails where none of those is wanted."""
    first = views[0]
    middle = first.z_depth[60, 80]
    speck = np.zeros_like(first.z_depth)
    speck[57:60, 77:80] = middle
    small = DepthView(LENS, first.world_from_camera, first.rgb, speck)
    assert small.smooth_mask().any()
    fused = fuse([small, *views], bounds_around(CENTER), VOXEL)
    assert len(fused.vertices) == pytest.approx(len(sphere.vertices), rel=0.05)


def test_the_store_gives_back_what_it_was_given(views: list[DepthView], tmp_path: Path) -> None:
    store = ViewStore(tmp_path / "views")
    for view in views:
        store.append(view)
    assert len(store) == len(views)
    for kept, view in zip(store, views, strict=True):
        np.testing.assert_array_equal(kept.z_depth, view.z_depth)
        np.testing.assert_array_equal(kept.rgb, view.rgb)
        np.testing.assert_array_equal(kept.world_from_camera, view.world_from_camera)


def test_points_of_a_view_lie_on_the_surface(views: list[DepthView]) -> None:
    view = views[1]
    seen = view.points()[view.z_depth > 0]
    np.testing.assert_allclose(np.linalg.norm(seen - CENTER, axis=1), 1.0, atol=1e-5)


def test_jumps_in_depth_are_masked_and_slopes_are_not(views: list[DepthView]) -> None:
    view = views[0]
    mask = view.smooth_mask()
    seen = view.z_depth > 0
    assert mask[60, 80]
    assert 0.85 < mask.sum() / seen.sum() < 1.0


def test_at_a_jump_what_lies_before_keeps_its_edge_and_what_lies_between_goes() -> None:
    z = np.full((1, 8), 2.0, np.float32)
    z[0, 3:5] = 1.0
    z[0, 5] = 1.6
    row = DepthView(
        Pinhole(8, 1, 800.0, 800.0, 4.0, 0.5),
        np.eye(4)[:3],
        np.zeros((1, 8, 3), np.uint8),
        np.where(np.arange(8) == 7, 0, z).astype(np.float32),
    )
    #  far far edge NEAR NEAR between behind unknown
    wanted = [True, True, False, True, True, False, False, False]
    assert row.smooth_mask()[0].tolist() == wanted
    column = DepthView(
        Pinhole(1, 8, 800.0, 800.0, 0.5, 4.0),
        row.world_from_camera,
        np.zeros((8, 1, 3), np.uint8),
        row.z_depth.T,
    )
    assert column.smooth_mask()[:, 0].tolist() == wanted


@pytest.mark.parametrize("width", [1, 2, 3, 4])
@pytest.mark.parametrize("behind", [0.0, 9.0])
def test_a_thin_thing_stays_whatever_is_behind_it(width: int, behind: float) -> None:
    """A pole before a wall, or before the sky, where nothing is known."""
    z = np.full((40, 20), behind, np.float32)
    z[4:, 8 : 8 + width] = 2.0
    view = DepthView(
        Pinhole(20, 40, 80.0, 80.0, 10.0, 20.0),
        np.eye(4)[:3],
        np.zeros((40, 20, 3), np.uint8),
        z,
    )
    kept = view.smooth_mask()[6:, 8 : 8 + width]
    assert kept.any(axis=1).all(), "it has no gaps"
    assert kept.mean() > (0.99 if width < 3 or behind else 0.3)


def test_z_depth_takes_the_median_where_the_expected_depth_was_pulled_away() -> None:
    lens = Pinhole(3, 1, 1.0, 1.0, 1.5, 0.5)
    median = np.array([[2.0, 2.0, 2.0]])
    expected = np.array([[2.02, 4.0, 2.0]])
    z = z_depth_of(lens, median, expected, np.array([[1.0, 1.0, 0.2]]))
    np.testing.assert_allclose(z, [[2.02 / np.sqrt(2.0), 2.0, 0.0]], rtol=1e-6)


def test_an_undistorted_lens_keeps_the_field_of_view_and_cuts_a_fisheye() -> None:
    lens = Pinhole.of(Intrinsics(1080, 1920, 1400.0, 1410.0, 545.0, 950.0, k1=0.1), 480, 2)
    assert (lens.width, lens.height) == (270, 480)
    assert lens.width / lens.fl_x == pytest.approx(1080 / 1400.0)
    assert lens.cx / lens.width == pytest.approx(545.0 / 1080.0)
    fisheye = Pinhole.of(Intrinsics(1000, 1000, 300.0, 300.0, 500, 500, "OPENCV_FISHEYE"), 500)
    assert 2 * np.degrees(np.arctan(250 / fisheye.fl_x)) == pytest.approx(110.0)


def test_voxels_are_as_large_as_memory_wants_and_no_larger(
    views: list[DepthView], monkeypatch: pytest.MonkeyPatch
) -> None:
    bounds, fine = bounds_around(CENTER), 2.6 / 256

    def num_blocks(voxel: float) -> int:
        grid, origin = tsdf.voxel_grid(voxel, 1), (bounds.box_min + bounds.box_max) / 2.0
        return len(tsdf._blocks_near_surface(grid, views, bounds, origin))

    everything = num_blocks(fine)
    assert everything > 2000
    monkeypatch.setattr(tsdf, "MOST_BLOCKS", everything)
    same, blocks = affordable_blocks(views, bounds, fine)
    assert blocks is not None
    assert (same, len(blocks)) == (fine, everything)
    monkeypatch.setattr(tsdf, "MOST_BLOCKS", 600)
    told: list[float] = []
    found, blocks = affordable_blocks(views, bounds, fine, told.append)
    assert blocks is not None
    assert 200 < len(blocks) == num_blocks(found) <= 600
    known, looked = (fuse(views, bounds, found, blocks=given) for given in (blocks, None))
    np.testing.assert_array_equal(known.vertices, looked.vertices)
    assert told == sorted(told)
    assert 0.0 <= told[0] < told[-1] < 1.0


def test_a_box_that_fits_as_a_whole_needs_no_look() -> None:
    assert affordable_blocks([], bounds_around(CENTER), 2.6 / 256) == (2.6 / 256, None)
