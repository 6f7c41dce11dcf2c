"""The video's camera path: near the captured poses, smooth, with unit rotations."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import trimesh

from pipelines.exports.paths.options import PathOptions
from pipelines.exports.paths.smooth import Floats, smooth_flight, smooth_path
from pipelines.exports.paths.walls import Walls
from pipelines.exports.surface.surface_file import KeptSurface
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.capture_order import capture_order, nearest_pose_distance
from pipelines.scene.focus import find_focus
from tests.unit.pipelines.scene.synthetic_views import arc, look_at


def test_path_stays_near_the_captured_poses() -> None:
    poses = arc(40)
    path = smooth_path(poses, 96)
    gaps = np.linalg.norm(path[:, None, :, 3] - poses[None, :, :, 3], axis=-1)
    spacing = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1).mean()
    assert gaps.min(axis=1).max() < spacing
    assert gaps.min(axis=0).max() < spacing
    axes = -path[:, :, 2]
    to_origin = -path[:, :, 3] / np.linalg.norm(path[:, :, 3], axis=1, keepdims=True)
    assert (axes * to_origin).sum(axis=1).min() > np.cos(np.radians(5.0))


def test_path_is_smoother_than_a_shaking_hand() -> None:
    poses = arc(100, shake=0.02)
    path = smooth_path(poses, 100)
    shaking = np.linalg.norm(np.diff(poses[:, :, 3], n=2, axis=0), axis=1).mean()
    smoothed = np.linalg.norm(np.diff(path[:, :, 3], n=2, axis=0), axis=1).mean()
    assert smoothed < shaking / 20.0


def test_speed_is_nearly_constant_where_the_walk_was_not() -> None:
    poses = arc(120)
    uneven = poses[np.unique((np.linspace(0, 1, 60) ** 2 * 119).astype(int))]
    steps = np.linalg.norm(np.diff(smooth_path(uneven, 80)[:, :, 3], axis=0), axis=1)
    assert steps.max() < 1.3 * steps.min()


def test_rotations_are_rotations() -> None:
    rotation = smooth_path(arc(30, shake=0.05), 64)[:, :, :3]
    identity = np.broadcast_to(np.eye(3), rotation.shape)
    np.testing.assert_allclose(rotation @ rotation.transpose(0, 2, 1), identity, atol=1e-12)
    assert np.all(np.linalg.det(rotation) > 0.999)


def test_a_gap_in_the_poses_is_bridged_without_a_jump() -> None:
    poses = arc(40)
    path = smooth_path(np.concatenate((poses[:10], poses[25:])), 96)
    steps = np.linalg.norm(np.diff(path[:, :, 3], axis=0), axis=1)
    assert np.all(np.isfinite(path))
    assert steps.max() < 2.0 * np.median(steps)


def test_a_gap_is_passed_around_the_subject_and_not_through_it() -> None:
    poses = arc(60)
    path = smooth_path(np.concatenate((poses[:8], poses[-8:])), 96, focus=np.zeros(3))
    distance = np.linalg.norm(path[:, :, 3], axis=1)
    wanted = np.linalg.norm(poses[0, :, 3])
    np.testing.assert_allclose(distance, wanted, rtol=0.02)
    middle = nearest_pose_distance(path, np.concatenate((poses[:8], poses[-8:])))[48]
    assert middle > 10.0 * nearest_pose_distance(path, path).max()


@pytest.mark.parametrize("num", [1, 2, 3])
def test_few_poses_still_make_a_path(num: int) -> None:
    path = smooth_path(arc(40)[:: 40 // num][:num], 24)
    assert path.shape == (24, 3, 4)
    assert np.all(np.isfinite(path))


def test_no_poses_are_refused() -> None:
    with pytest.raises(ValueError, match="needs poses"):
        smooth_path(np.empty((0, 3, 4)), 10)


def photos_around(num: int = 25, aside_deg: float = 6.3, seed: int = 0) -> Floats:
    """Photos from all over a hemisphere that look past the origin by so much at most."""
    rng = np.random.default_rng(seed)
    poses = []
    for _ in range(num):
        turn, height = rng.uniform(0.0, 2.0 * np.pi), rng.uniform(0.05, 0.95)
        flat = np.sqrt(1.0 - height**2)
        away = np.array([flat * np.cos(turn), flat * np.sin(turn), height])
        place = rng.uniform(2.0, 3.0) * away
        beside = np.cross(away, rng.normal(size=3))
        beside /= np.linalg.norm(beside)
        shift = np.linalg.norm(place) * np.tan(np.radians(aside_deg * rng.uniform()))
        poses.append(look_at(place, shift * beside))
    return np.stack(poses)


def aside_deg(poses: Floats, point: Floats) -> Floats:
    """[N] angles between the optical axes and the direction to a point."""
    to_point = point - poses[:, :, 3]
    cosine = -(poses[:, :, 2] * to_point).sum(axis=1) / np.linalg.norm(to_point, axis=1)
    return np.asarray(np.degrees(np.arccos(np.clip(cosine, -1.0, 1.0))))


def in_picture(poses: Floats, point: Floats) -> np.ndarray:
    """[N] whether a point is in the picture of a phone held upright, 43 by 70 degrees."""
    x, y, z = np.einsum("nji,nj->in", poses[:, :, :3], point - poses[:, :, 3])
    return np.asarray((z < 0) & (np.abs(x) < -0.39 * z) & (np.abs(y) < -0.7 * z))


@pytest.mark.parametrize("seed", range(4))
def test_the_subject_stays_in_the_picture_where_photos_are_few(seed: int) -> None:
    photos = photos_around(seed=seed)
    focus = find_focus(photos)
    assert focus is not None
    assert in_picture(photos, focus).all()
    order = capture_order(photos, [f"{i}.jpg" for i in range(25)], [None] * 25)
    path = smooth_path(photos[order], 240, focus)
    assert in_picture(path, focus).all()
    assert aside_deg(path, focus).max() <= aside_deg(photos, focus).max()


def test_the_subject_may_leave_the_picture_where_the_photos_left_it() -> None:
    """A look to the side in the middle of a walk stays one, and where the walk was true so is
    the flight."""
    poses = arc(90)
    for index in range(30, 60):
        place = poses[index, :, 3]
        poses[index] = look_at(place, place + np.cross(place, [0.0, 0.0, 1.0]))
    path = smooth_path(poses, 90, np.zeros(3))
    aside = aside_deg(path, np.zeros(3))
    assert aside[40:50].min() > 60.0
    assert aside[:15].max() < 5.0
    assert aside[-15:].max() < 5.0


def walls_of(mesh: trimesh.Trimesh, voxel: float = 0.02) -> Walls:
    """As a job's mesh has them, in single precision about an origin of its own."""
    origin = mesh.vertices.mean(axis=0)
    vertices = (mesh.vertices - origin).astype(np.float32)
    sizes = np.full(len(vertices), voxel, np.float32)
    return Walls(KeptSurface(origin, vertices, mesh.faces.astype(np.int32), sizes))


def of_a_room(size: tuple[float, float, float]) -> Walls:
    """Its walls, floor and ceiling, whose outside is the room, and a table in its middle."""
    room = trimesh.creation.box(size)
    room.apply_translation([0.0, 0.0, size[2] / 2.0])
    room.invert()
    table = trimesh.creation.box([0.9, 0.6, 0.7])
    table.apply_translation([0.0, 0.0, 0.35])
    return walls_of(room + table)


def photos_from(corners: list[tuple[float, float]], looks_deg: list[float]) -> Floats:
    """Photos taken at about 1.5 m from corners of a room, of what lies about its middle."""
    rng = np.random.default_rng(0)
    poses = []
    for x, y in corners:
        for aside in np.radians(looks_deg):
            angle = np.arctan2(-y, -x) + aside
            place = np.array([x, y, 1.5]) + rng.uniform(-0.1, 0.1, 3)
            poses.append(look_at(place, place + np.array([np.cos(angle), np.sin(angle), -0.25])))
    photos = np.stack(poses)
    names = [f"{i:03d}.jpg" for i in range(len(photos))]
    return photos[capture_order(photos, names, [None] * len(photos))]


def outside(path: Floats, size: tuple[float, float, float]) -> np.ndarray:
    """[N] how far a place is outside a room that stands on z = 0; below 0 it is within."""
    away = np.abs(path[:, :, 3] - [0.0, 0.0, size[2] / 2.0]) - np.asarray(size) / 2.0
    return np.asarray(away.max(axis=1))


@pytest.mark.parametrize("size", [(4.0, 3.0, 2.5), (5.0, 4.0, 2.5), (6.0, 3.5, 2.6)])
@pytest.mark.parametrize("looks", [[-20.0, 0.0, 20.0], [-28.0, -14.0, 0.0, 14.0, 28.0]])
def test_a_film_of_photos_from_a_rooms_corners_stays_within_its_walls(
    size: tuple[float, float, float], looks: list[float]
) -> None:
    x, y = size[0] / 2.0 - 0.3, size[1] / 2.0 - 0.3
    photos = photos_from([(x, y), (-x, y), (-x, -y), (x, -y)], looks)
    focus = find_focus(photos)
    assert focus is not None
    assert (outside(smooth_path(photos, 240, focus), size) > 0.0).mean() > 0.2
    path = smooth_path(photos, 240, focus, of_a_room(size))
    assert outside(path, size).max() < -0.05
    steps = np.linalg.norm(np.diff(path[:, :, 3], axis=0), axis=1)
    assert steps.max() < 3.0 * np.median(steps)
    assert aside_deg(path, focus).max() <= aside_deg(photos, focus).max() + 1e-6


@pytest.mark.parametrize("is_open", [False, True])
def test_walls_leave_a_film_around_a_thing_as_it_was(is_open: bool) -> None:
    """A gap of a third of the ring, the thing a ball that reaches halfway to the cameras, closed or
    without its back, in the middle of a room."""
    angles = np.radians(np.linspace(0.0, 240.0, 40))
    places = 3.0 * np.stack([np.cos(angles), np.sin(angles), np.full(40, 0.3)], axis=-1)
    photos = np.stack([look_at(place, np.zeros(3)) for place in places])
    ball = trimesh.creation.icosphere(3, 0.5 * float(np.linalg.norm(photos[0, :, 3])))
    if is_open:
        ball.update_faces(ball.triangles_center @ photos[:, :, 3].mean(axis=0) > 0.0)
    room = trimesh.creation.box([20.0, 20.0, 20.0])
    room.invert()
    walls = walls_of(ball + room)
    path = smooth_path(photos, 96, np.zeros(3))
    np.testing.assert_array_equal(smooth_path(photos, 96, np.zeros(3), walls), path)


def ring(num: int, distance: float = 1.2, height: float = 0.6, start: float = 0.0) -> Floats:
    """Cameras on a level ring that look at what lies a little above the world's origin."""
    angles = start + np.arange(num) * 2.0 * np.pi / num
    places = np.stack([np.cos(angles), np.sin(angles), np.full(num, height / distance)], axis=-1)
    return np.stack([look_at(distance * place, np.array([0.0, 0.0, 0.1])) for place in places])


@pytest.mark.parametrize("aside_rad", [np.pi, np.pi - 1.0, 0.3])
def test_one_photo_from_another_side_does_not_tilt_the_horizon(aside_rad: float) -> None:
    around = ring(40)
    whole = ring(1, 3.5, 1.5, start=np.pi + aside_rad)
    poses = np.concatenate((around[:20], whole, around[20:]))
    path = smooth_path(poses, 240, find_focus(poses))
    tilt = np.degrees(np.arctan2(path[:, 2, 0], path[:, 2, 1]))
    has_horizon = np.hypot(path[:, 2, 0], path[:, 2, 1]) > 0.6
    assert has_horizon.mean() > 0.4, "a camera that passes overhead looks straight down there"
    assert np.abs(tilt[has_horizon]).max() < 5.0


def test_where_a_films_poses_break_off_the_path_jumps() -> None:
    """A pan through 340 degrees, of which 100 have no poses."""
    angles = np.radians(np.concatenate((np.arange(0, 120, 4), np.arange(220, 340, 4))))
    eyes = np.stack([0.3 * np.cos(angles), 0.3 * np.sin(angles), np.full(60, 1.5)], axis=-1)
    poses = np.stack([look_at(eye, eye * [10, 10, 1]) for eye in eyes])
    unseen = {}
    for is_film in (True, False):
        path = smooth_path(poses, 200, is_walk=True, is_film=is_film)
        gaze = np.degrees(np.arctan2(-path[:, 1, 2], -path[:, 0, 2])) % 360.0
        unseen[is_film] = int(((gaze > 125.0) & (gaze < 215.0)).sum())
        turned = np.abs(np.diff(np.unwrap(np.radians(gaze))))
        assert np.median(turned) < np.radians(2.0)
    assert unseen[True] <= 2 < 30 < unseen[False]


def test_the_horizon_of_pictures_on_their_side_stays_where_it_was() -> None:
    poses = ring(40)
    poses[:, :, :2] = poses[:, :, :2] @ np.array([[0.0, 1.0], [-1.0, 0.0]])
    path = smooth_path(poses, 96, find_focus(poses))
    tilt = np.degrees(np.arctan2(path[:, 2, 0], path[:, 2, 1]))
    np.testing.assert_allclose(tilt, np.degrees(np.arctan2(poses[0, 2, 0], poses[0, 2, 1])), atol=5)


@pytest.mark.parametrize("timed", [True, False])
def test_a_film_through_rooms_goes_through_their_doors(timed: bool) -> None:
    """Whether it was sent as a film or as its pictures.

    Five rooms of 3.2 by 3.4 m along a corridor, doors of 0.8 m, a walk in, about and out.
    """
    corners = [(-0.5, 0.0)]
    doors = [1.6 + 3.3 * room for room in range(5)]
    for door in doors:
        about = [(-1.0, 1.4), (-1.0, 3.4), (1.0, 3.4), (1.0, 1.4), (0.0, 1.2), (0.0, 0.0)]
        corners += [(door, 0.0), (door, 1.2), *((door + x, y) for x, y in about)]
    way = np.asarray([*corners, (17.0, 0.0)])
    turns = np.unwrap(np.arctan2(*np.diff(way, axis=0).T[::-1]))
    poses = []
    for number, (start, end) in enumerate(itertools.pairwise(way)):
        steps = max(2, round(5.0 * float(np.linalg.norm(end - start))))
        after = turns[min(number + 1, len(turns) - 1)]
        poses += [(*(start + t * (end - start)), turns[number]) for t in np.arange(steps) / steps]
        poses += [(*end, turns[number] + t * (after - turns[number])) for t in (0.25, 0.5, 0.75)]
    eyes = [np.array([x, y, 1.5]) for x, y, _ in poses]
    aims = [np.array([np.cos(turn), np.sin(turn), -0.1]) for _, _, turn in poses]
    walked = np.stack([look_at(e, e + a) for e, a in zip(eyes, aims, strict=True)])
    images = [
        PosedImage(f"{index}.jpg", 0, tuple(map(tuple, pose.tolist())), index if timed else None)
        for index, pose in enumerate(walked)
    ]
    x, y = smooth_flight(images, PathOptions(), 480).poses[:, :2, 3].T
    crossing = np.flatnonzero(np.diff(y > 0.6))
    assert len(crossing) == 10
    assert np.abs(x[crossing, None] - doors).min(axis=1).max() < 0.4
    inside = y > 0.7
    assert np.abs(x[inside, None] - doors).min(axis=1).max() < 1.6
