"""The analytic scene: hits lie on the surface, pictures and poses agree."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.sample import tracing
from pipelines.sample.film import hand_held_pose, phone_camera, walk
from pipelines.sample.scene import (
    PRIMITIVES,
    ROOM,
    SUBJECT,
    Floats,
    depth_image,
    in_sight,
    pixel_rays,
    raycast,
    render,
    seen_surface,
    surface_distance,
    surface_normals,
)
from pipelines.scene.cameras_file import Intrinsics


def _rays(num: int, seed: int = 0) -> tuple[Floats, Floats]:
    """Rays from the camera's walk towards everywhere around the subject."""
    random = np.random.default_rng(seed)
    origins = np.stack([hand_held_pose(p)[:, 3] for p in random.random(num)])
    directions = random.normal(size=(num, 3)) * [1.3, 1.3, 0.6] - origins
    return origins, directions / np.linalg.norm(directions, axis=1, keepdims=True)


def _brute_force_distance(points: Floats, surface: Floats) -> Floats:
    gaps = np.linalg.norm(points[:, None] - surface[None], axis=2)
    return np.asarray(gaps.min(axis=1))


def test_every_hit_lies_on_the_surface_and_all_things_are_hit() -> None:
    origins, directions = _rays(20_000)
    hits = raycast(origins, directions)
    points = origins + hits.t[:, None] * directions
    assert surface_distance(points).max() < 1e-9
    assert set(hits.primitive.tolist()) == set(range(len(PRIMITIVES)))


def test_no_surface_lies_before_a_hit() -> None:
    origins, directions = _rays(500, seed=1)
    hits = raycast(origins, directions)
    # March by the distance to the surface, as sphere tracing does: slow and independent.
    t = np.zeros(len(origins))
    for _ in range(1000):
        gap = surface_distance(origins + t[:, None] * directions)
        t += np.where(gap > 1e-7, gap, 0.0)
    # A marching ray that grazes a surface may not get past it in that many steps.
    assert (t <= hits.t + 1e-9).all()
    assert np.mean(hits.t - t < 1e-4) > 0.99


def test_normals_are_the_gradient_of_the_distance() -> None:
    origins, directions = _rays(4000, seed=2)
    hits = raycast(origins, directions)
    assert (np.einsum("nk,nk->n", hits.normal, directions) < 0).all()
    points = origins + hits.t[:, None] * directions + 1e-4 * hits.normal
    step = 1e-6
    gradient = np.stack(
        [
            surface_distance(points + offset) - surface_distance(points - offset)
            for offset in step * np.eye(3)
        ],
        axis=1,
    ) / (2 * step)
    agreement = np.einsum("nk,nk->n", gradient, hits.normal)
    # Within 0.1 mm of a crease another surface may be the nearer one.
    assert np.mean(agreement > 1 - 1e-6) > 0.995


def test_true_normals_are_those_of_hits_on_both_sides_of_a_surface() -> None:
    origins, directions = _rays(4000, seed=2)
    hits = raycast(origins, directions)
    for off in (-1e-3, 0.0, 1e-3):
        points = origins + hits.t[:, None] * directions + off * hits.normal
        found = surface_normals(points)
        np.testing.assert_allclose(np.linalg.norm(found, axis=1), 1.0)
        # Within 1 mm of a crease another surface may be the nearer one.
        agreement = np.einsum("nk,nk->n", found, hits.normal)
        assert np.mean(agreement > 1 - 1e-6) > 0.98


def test_surface_distance_equals_a_search_over_surface_points() -> None:
    origins, directions = _rays(20_000, seed=3)
    surface = origins + raycast(origins, directions).t[:, None] * directions
    near_bowl = surface[np.linalg.norm(surface, axis=1) < 0.9]
    random = np.random.default_rng(4)
    points = near_bowl[random.choice(len(near_bowl), 60)] + random.normal(size=(60, 3)) * 0.03
    points = points[points[:, 2] > 0.02]
    exact = surface_distance(points)
    searched = _brute_force_distance(points, near_bowl)
    assert (exact <= searched + 1e-9).all()
    # Backs that no camera sees are missing from the search, so not all agree.
    assert np.mean(np.abs(searched - exact) < 0.015) > 0.7


def test_the_bowl_is_concave() -> None:
    down = raycast(np.array([[0.0, 0.0, 1.5]]), np.array([[0.0, 0.0, -1.0]]))
    assert PRIMITIVES[int(down.primitive[0])].kind == tracing.BOWL
    assert down.t[0] == pytest.approx(1.5 - 0.05)
    assert down.normal[0] == pytest.approx([0.0, 0.0, 1.0])


def test_things_stand_at_three_depths_from_every_camera() -> None:
    camera = phone_camera(96)
    for progress in np.linspace(0, 1, 5):
        depth = depth_image(camera, hand_held_pose(progress))
        assert depth.min() < 1.5
        assert ((depth > 2.5) & (depth < 4.0)).mean() > 0.01
        assert depth.max() > 4.5


def test_a_surface_point_has_the_same_colour_in_two_frames() -> None:
    camera = phone_camera()
    pose, other = hand_held_pose(0.45), hand_held_pose(0.52)
    picture, other_picture = render(camera, pose), render(camera, other)
    random = np.random.default_rng(5)
    pixels = np.floor(random.random((3000, 2)) * [camera.width, camera.height]) + 0.5
    origins, directions = pixel_rays(camera, pose, pixels)
    points = origins + raycast(origins, directions).t[:, None] * directions

    local = (points - other[:, 3]) @ other[:, :3]
    x = camera.cx - camera.fl_x * local[:, 0] / local[:, 2]
    y = camera.cy + camera.fl_y * local[:, 1] / local[:, 2]
    inside = (x > 1) & (y > 1) & (x < camera.width - 1) & (y < camera.height - 1)
    gaze = points - other[:, 3]
    distance = np.linalg.norm(gaze, axis=1)
    hidden = raycast(np.broadcast_to(other[:, 3], gaze.shape), gaze / distance[:, None]).t
    shown = inside & (hidden > distance - 1e-4)
    assert shown.sum() > 1500

    here = picture[pixels[shown, 1].astype(int), pixels[shown, 0].astype(int)].astype(float)
    there = other_picture[y[shown].astype(int), x[shown].astype(int)].astype(float)
    shifted = np.roll(other_picture, 5, axis=1)[y[shown].astype(int), x[shown].astype(int)]
    # The second picture is read at the nearest pixel: up to half a pixel off.
    error = np.abs(here - there).mean()
    assert error < 4.0
    assert np.abs(here - shifted.astype(float)).mean() > 3 * error


def test_pictures_are_the_same_on_every_call_and_match_the_rays() -> None:
    camera = phone_camera(128)
    pose = hand_held_pose(0.3)
    picture = render(camera, pose)
    assert np.array_equal(picture, render(camera, pose))
    y, x = np.mgrid[0 : camera.height, 0 : camera.width]
    parts = []
    for dx, dy in ((0.25, 0.25), (0.75, 0.75), (0.25, 0.75), (0.75, 0.25)):
        pixels = np.stack([x.ravel() + dx, y.ravel() + dy], axis=1).astype(float)
        parts.append(raycast(*pixel_rays(camera, pose, pixels)).color)
    expected = np.mean(parts, axis=0).reshape(camera.height, camera.width, 3) * 255
    # Where two samples agree the renderer takes no more.
    assert np.percentile(np.abs(picture - expected), 99) < 12
    assert np.abs(picture - expected).mean() < 1.5


def test_seen_surface_is_on_the_surface_within_the_region() -> None:
    points = seen_surface(walk(6, phone_camera(240)), num_points=3000)
    assert 2500 <= len(points) <= 3000
    assert SUBJECT.contains(points).all()
    assert surface_distance(points).max() < 1e-9
    assert points[:, 2].max() > 0.8
    assert ROOM.size > SUBJECT.size


def test_what_was_seen_is_in_sight_and_what_is_behind_it_is_not() -> None:
    truth = walk(6, phone_camera(240))
    points = seen_surface(truth, num_points=3000)
    assert in_sight(points, truth).all()
    below = points - [0.0, 0.0, 0.01]
    floor = points[:, 2] < 1e-6
    assert floor.sum() > 100
    assert not in_sight(below[floor], truth).any()
    beyond = np.array([[0.0, 0.0, 3.4]])  # the ceiling, above all pictures
    assert not in_sight(beyond, truth).any()


def test_bad_rays_and_lenses_are_refused() -> None:
    inside, up = np.array([[0.0, -2.0, 1.0]]), np.array([[0.0, 0.0, 1.0]])
    with pytest.raises(ValueError, match="unit"):
        raycast(inside, 2 * up)
    with pytest.raises(ValueError, match="inside the room"):
        raycast(inside + 50.0, up)
    with pytest.raises(ValueError, match=r"\[N, 3\]"):
        raycast(inside[0], up[0])
    fisheye = Intrinsics(64, 64, 32.0, 32.0, 32.0, 32.0, model="OPENCV_FISHEYE")
    with pytest.raises(ValueError, match="PINHOLE"):
        render(fisheye, hand_held_pose(0.5))
