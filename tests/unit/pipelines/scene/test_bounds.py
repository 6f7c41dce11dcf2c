"""What is taken to be the scene, for the three shapes of captures."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.scene.bounds import bounds_of_views, scene_bounds
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import look_at, ring, sphere_view


def test_background_beyond_max_distance_is_cut_off() -> None:
    rng = np.random.default_rng(0)
    thing = rng.uniform(-0.5, 0.5, (2000, 3))
    background = rng.normal(size=(3000, 3))
    background *= 40.0 / np.linalg.norm(background, axis=1, keepdims=True)
    bounds = scene_bounds(
        ring(20, np.zeros(3)), np.concatenate((thing, background)), thing, np.full(2000, 3.0), 2.0
    )
    assert bounds is not None
    assert bounds.radius == pytest.approx(6.0)
    assert bounds.longest_side < 1.2
    assert bounds.contains(thing).mean() > 0.99
    assert not bounds.contains(background).any()


@pytest.mark.parametrize("away", [10.0, 60.0])
def test_one_picture_from_afar_leaves_the_scene_as_it_is(away: float) -> None:
    thing = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3))
    poses = ring(20, np.zeros(3))
    usual = scene_bounds(poses, thing, thing, np.full(2000, 3.0), 2.0)
    poses[7, :, 3] *= away
    bounds = scene_bounds(poses, thing, thing, np.full(2000, 3.0), 2.0)
    assert usual is not None
    assert bounds is not None
    assert bounds.distance < 1.15 * usual.distance
    assert np.linalg.norm(bounds.focus - usual.focus) < 1e-6


def test_a_forward_facing_capture_is_bounded_by_the_depth_it_shows() -> None:
    rng = np.random.default_rng(1)
    poses = np.stack(
        [look_at(np.array([x, 0.0, 0.0]), np.array([x, 9.0, 0])) for x in np.linspace(0, 0.3, 9)]
    )
    door = np.column_stack(
        (rng.uniform(-0.5, 0.8, 500), np.full(500, 0.7), rng.uniform(-0.6, 0.6, 500))
    )
    bounds = scene_bounds(poses, door, door, np.full(500, 0.7), 2.0)
    assert bounds is not None
    assert 1.2 < bounds.radius < 1.8
    assert bounds.focus[1] == pytest.approx(0.7)
    assert bounds.contains(door).mean() > 0.95


def test_a_room_filmed_from_inside_keeps_its_walls() -> None:
    rng = np.random.default_rng(2)
    outward = ring(30, np.zeros(3), distance=0.5)
    outward[:, :, [0, 2]] *= -1.0
    walls = rng.normal(size=(2000, 3))
    walls *= 4.0 / np.linalg.norm(walls, axis=1, keepdims=True)
    bounds = scene_bounds(outward, walls, walls, np.full(2000, 3.5), 2.0)
    assert bounds is not None
    assert bounds.contains(walls).mean() > 0.95


def test_no_surface_means_no_bounds() -> None:
    poses = ring(12, np.zeros(3))
    nothing = np.zeros((0, 3))
    far = np.full((10, 3), 100.0)
    assert scene_bounds(poses, nothing, nothing, np.zeros(0), 2.0) is None
    assert scene_bounds(poses, far, far, np.full(10, 170.0), 2.0) is None


@pytest.mark.parametrize(("num_showing", "is_whole"), [(16, True), (2, False)])
def test_a_stem_that_many_views_show_is_not_cut_off(num_showing: int, is_whole: bool) -> None:
    """A ball, and above it a stem of less than half a percent of all pixels, or an error of few."""
    lens, poses = Pinhole(64, 48, 60.0, 60.0, 32.0, 24.0), ring(16, np.zeros(3), distance=5.0)
    views = []
    for index, pose in enumerate(poses):
        view = sphere_view(lens, pose, np.zeros(3))
        if index < num_showing:
            view = _with_stem(view, np.linspace(1.0, 2.5, 200))
        views.append(view)
    bounds = bounds_of_views(views, poses, 2.0)
    assert bounds is not None
    assert bool(bounds.box_max[2] > 2.4) is is_whole
    assert bounds.box_max[2] < 2.9
    assert bool(bounds.usual_side < bounds.longest_side - 0.3) is is_whole, "no voxel is coarser"
    assert bounds.box_max[0] < 1.5


def _with_stem(view: DepthView, heights: np.ndarray) -> DepthView:
    """A line upwards from the origin, one pixel wide."""
    points = np.column_stack([np.zeros((len(heights), 2)), heights])
    local = (points - view.world_from_camera[:, 3]) @ view.world_from_camera[:, :3]
    lens, depth = view.lens, -local[:, 2]
    u = (lens.cx + lens.fl_x * local[:, 0] / depth).astype(int)
    v = (lens.cy - lens.fl_y * local[:, 1] / depth).astype(int)
    shown = (v >= 0) & (v < lens.height) & (u >= 0) & (u < lens.width)
    z = view.z_depth.copy()
    z[v[shown], u[shown]] = depth[shown]
    return replace(view, z_depth=z)
