"""What is taken to be the scene, for the three shapes of captures."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene.bounds import scene_bounds
from tests.unit.pipelines.scene.synthetic_views import look_at, ring


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
