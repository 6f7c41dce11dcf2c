"""Poisson reconstruction of depth views: the surface where it is, and none where nobody looked."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.errors import Cancelled
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface import poisson
from pipelines.exports.surface.poisson import averaged, reconstruct
from pipelines.exports.surface.tsdf import fuse
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_color, sphere_view

CENTER = np.array([1000.0, -500.0, 7.0])
VOXEL = 2.6 / 48
LENS = Pinhole(160, 120, 150.0, 150.0, 80.0, 60.0)
BOUNDS = SceneBounds(CENTER, 3.0, 6.0, CENTER - 1.3, CENTER + 1.3)
NOISE = 0.01


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    """The unit ball all round, each depth a hundredth off."""
    noise = np.random.default_rng(0)
    exact = [sphere_view(LENS, pose, CENTER) for pose in ring(12, CENTER)]
    return [
        replace(
            view,
            z_depth=(view.z_depth * (1.0 + NOISE * noise.normal(size=view.z_depth.shape))).astype(
                np.float32
            ),
        )
        for view in exact
    ]


@pytest.fixture(scope="module")
def ball(views: list[DepthView]) -> TriangleMesh:
    return reconstruct(views, BOUNDS, VOXEL)


def off(mesh: TriangleMesh) -> np.ndarray:
    """How far the vertices are from the ball."""
    return np.abs(np.linalg.norm(mesh.vertices - CENTER, axis=1) - 1.0)


def bend(mesh: TriangleMesh) -> float:
    """The mean angle between the faces' normals and the ball's, radians."""
    a, b, c = (mesh.vertices[mesh.faces[:, corner]] for corner in range(3))
    normals, outward = np.cross(b - a, c - a), (a + b + c) / 3.0 - CENTER
    cosine = (normals * outward).sum(axis=1)
    cosine /= np.linalg.norm(normals, axis=1) * np.linalg.norm(outward, axis=1)
    return float(np.arccos(np.clip(cosine, -1.0, 1.0)).mean())


def test_the_surface_is_where_it_was_seen_the_right_way_out(ball: TriangleMesh) -> None:
    assert len(ball.faces) > 2000
    assert off(ball).max() < VOXEL
    assert off(ball).mean() < 0.2 * VOXEL
    assert bend(ball) < 0.15, "wrong ones would be pi off"
    away = np.abs(ball.colors - sphere_color(ball.vertices, CENTER))
    assert away.mean() < 0.05


def test_it_is_smoother_than_fused_voxels(ball: TriangleMesh, views: list[DepthView]) -> None:
    assert bend(ball) < 0.7 * bend(fuse(views, BOUNDS, VOXEL))


def test_depths_that_tremble_by_a_voxel_make_no_rough_surface() -> None:
    """Many views with fine pixels fill a layer of cubes around the surface."""
    noise = np.random.default_rng(1)
    fine = Pinhole(400, 300, 375.0, 375.0, 200.0, 150.0)
    seen = [sphere_view(fine, pose, CENTER) for pose in ring(48, CENTER)]
    shake = [2.0 * NOISE * noise.normal(size=view.z_depth.shape) for view in seen]
    trembling = [
        replace(view, z_depth=(view.z_depth * (1.0 + one)).astype(np.float32))
        for view, one in zip(seen, shake, strict=True)
    ]
    made = reconstruct(trembling, BOUNDS, VOXEL)
    assert bend(made) < 0.05
    assert off(made).mean() < 0.3 * VOXEL


def test_what_nobody_saw_stays_open(views: list[DepthView]) -> None:
    """From one side alone: the other half, which would close the ball, is not made up."""
    poses = np.stack([view.world_from_camera[:, 3] - CENTER for view in views])
    side = [view for view, eye in zip(views, poses, strict=True) if eye[0] > 0.3]
    assert len(side) >= 3
    half = reconstruct(side, BOUNDS, VOXEL)
    assert len(half.faces) > 500
    assert off(half).max() < 1.5 * VOXEL
    assert (half.vertices - CENTER)[:, 0].min() > -0.9


def test_a_ghost_seen_by_one_view_is_not_believed(views: list[DepthView]) -> None:
    depth = views[0].z_depth.copy()
    depth[:20, :20] = 0.6 * np.linalg.norm(views[0].world_from_camera[:, 3] - CENTER)
    haunted = reconstruct([replace(views[0], z_depth=depth), *views[1:]], BOUNDS, VOXEL)
    assert off(haunted).max() < VOXEL


def haunted_film(views: list[DepthView], step: float, frames: int = 6) -> list[DepthView]:
    """The views and frames of a film beside the first one, step by step to its right, which all
    see a wall in the air, at one place, that no other sees."""
    pose = views[0].world_from_camera
    z = 0.6 * float(np.linalg.norm(pose[:, 3] - CENTER))
    told = []
    for frame in range(frames):
        moved = pose.copy()
        moved[:, 3] += step * frame * pose[:, 0]
        seen = sphere_view(LENS, moved, CENTER)
        depth = seen.z_depth.copy()
        left = 70 - round(step * frame * LENS.fl_x / z)
        depth[50:70, left : left + 20] = z
        told.append(replace(seen, z_depth=depth))
    return [*views, *told]


def points_off(views: list[DepthView]) -> int:
    """How many of the points that are believed are not on the ball."""
    cloud, _ = averaged(views, BOUNDS, VOXEL)
    return int((np.abs(np.linalg.norm(cloud.points - CENTER, axis=1) - 1.0) > 0.2).sum())


def test_frames_that_follow_each_other_do_not_confirm_each_other(views: list[DepthView]) -> None:
    assert points_off(views) == 0
    assert points_off(haunted_film(views, 0.01)) == 0
    assert points_off(haunted_film(views, 0.01, frames=12)) == 0, "more of them are not more"
    assert points_off(haunted_film(views, 0.1)) > 20, "seen from places apart it is a thing"


def wall_views(distance: float, eyes: list[float]) -> list[DepthView]:
    """Of a wall before cameras that stand side by side and look ahead."""
    pose = np.eye(4)[:3]
    depth = np.full((LENS.height, LENS.width), distance, np.float32)
    white = np.full((LENS.height, LENS.width, 3), 255, np.uint8)
    return [
        DepthView(LENS, np.column_stack([pose[:, :3], [eye, 0.0, 0.0]]), white, depth)
        for eye in eyes
    ]


@pytest.mark.parametrize("distance", [20.0, 2000.0])
def test_what_is_far_is_believed_where_all_that_could_see_it_do(distance: float) -> None:
    wall = np.array([0.0, 0.0, -distance])
    bounds = SceneBounds(wall, distance, 10.0 * distance, wall - distance, wall + distance)
    voxel = distance / 20.0
    eyes = [-2.0, -1.0, 0.0, 1.0, 2.0]
    assert len(averaged(wall_views(distance, eyes), bounds, voxel)[0]) > 200
    near = wall_views(distance, [0.0, 0.01])
    aside = wall_views(1.5 * distance, [-2.0]) + wall_views(0.6 * distance, [2.0])
    assert len(averaged([*near, *aside], bounds, voxel)[0]) == 0


def test_the_same_views_give_the_same_mesh_to_the_last_bit(
    ball: TriangleMesh, views: list[DepthView]
) -> None:
    again = reconstruct(views, BOUNDS, VOXEL)
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(again, name), getattr(ball, name))


def test_points_are_no_more_than_there_is_room_for(
    views: list[DepthView], monkeypatch: pytest.MonkeyPatch
) -> None:
    fine, side = averaged(views, BOUNDS, VOXEL)
    assert side == VOXEL
    monkeypatch.setattr(poisson, "MOST_POINTS", len(fine) // 3)
    told: list[float] = []
    few, side = averaged(views, BOUNDS, VOXEL, told.append)
    assert len(fine) // 6 < len(few) <= len(fine) // 3
    assert side > 1.5 * VOXEL
    assert told == sorted(told)
    assert told[-1] < 1.0


def test_too_little_is_no_surface(views: list[DepthView]) -> None:
    blind = [replace(view, z_depth=np.zeros_like(view.z_depth)) for view in views[:2]]
    assert len(reconstruct(blind, BOUNDS, VOXEL).faces) == 0


@pytest.mark.parametrize("at", [0.1, 0.3, 0.45, 0.6])
def test_a_cancel_ends_it_in_any_part(
    views: list[DepthView], at: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poisson, "_PORTION", 1000)  # of 11,000 points
    told: list[float] = []

    def tell(done: float) -> None:
        told.append(done)
        if done >= at:
            raise Cancelled("Nobody wants it any more.")

    with pytest.raises(Cancelled):
        reconstruct(views, BOUNDS, VOXEL / 4.0, tell)
    assert told == sorted(told)
    assert told[-1] < at + 0.1
