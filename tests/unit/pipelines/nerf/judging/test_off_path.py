"""Cameras beside a path: a ring of twelve that look at the origin, and paths without a focus."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.off_path import (
    focus_point,
    off_path_cameras,
    view_targets,
)
from pipelines.nerf.space.cameras import Cameras
from tests.unit.pipelines.nerf.judging.floating_scene import (
    NUM,
    RING,
    RISE,
    cameras_of,
    look_at,
    ring_cameras,
    ring_places,
)


@pytest.fixture(scope="module")
def ring() -> Cameras:
    return ring_cameras()


def test_focus_is_where_the_axes_meet(ring: Cameras) -> None:
    focus = focus_point(ring)
    assert focus is not None
    assert float(focus.abs().max()) < 1e-5
    expected = torch.full((NUM,), math.hypot(RING, RISE), dtype=torch.float64)
    targets = view_targets(ring)
    assert torch.allclose(targets.distances, expected, atol=1e-5)
    assert float(targets.points.abs().max()) < 1e-5


def test_a_focus_that_is_hidden_is_not_looked_at(ring: Cameras) -> None:
    """Pictures of things nearer than half of the way to it are not of it; of unknown ones the
    others tell."""
    reach = math.hypot(RING, RISE)
    depths = torch.full((NUM,), 0.51 * reach)
    depths[3], depths[7] = 0.49 * reach, 5.0 * reach
    depths[4] = torch.nan
    targets = view_targets(ring, depths)
    expected = torch.full((NUM,), reach, dtype=torch.float64)
    expected[3] = 0.49 * reach
    assert torch.allclose(targets.distances, expected, atol=1e-5)
    pose = ring.scene_from_camera[3].double()
    assert torch.allclose(targets.points[3], pose[:, 3] - 0.49 * reach * pose[:, 2], atol=1e-5)
    assert float(targets.points[[0, 4, 7]].abs().max()) < 1e-5
    blind = view_targets(ring, torch.full((NUM,), torch.nan))
    assert torch.equal(blind.distances, view_targets(ring).distances)
    # Where hardly any depth is known the others' median stands in.
    depths = torch.full((NUM,), torch.nan)
    depths[0], depths[1], depths[2] = 0.1, 0.2, 0.3
    assert torch.allclose(view_targets(ring, depths).distances[3:], torch.tensor(0.2).double())


@pytest.mark.parametrize("looking", ["outward", "parallel"])
def test_without_a_focus_the_size_of_the_path_takes_its_place(looking: str) -> None:
    shift, ahead = np.array([0.0, 0.0, 50.0]), np.array([0.0, 1.0, 0.0])
    targets = {"outward": lambda p: 3.0 * p, "parallel": lambda p: p + ahead}
    places = [place - [0.0, 0.0, RISE] for place in ring_places()]
    poses = [look_at(place + shift, targets[looking](place) + shift) for place in places]
    cameras = cameras_of(poses)
    assert focus_point(cameras) is None
    targets_found = view_targets(cameras)
    assert torch.allclose(targets_found.distances, torch.tensor(RING, dtype=torch.float64))
    # Depth that is known takes its place where it is less, and only there.
    for depth, distance in ((0.5, 0.5), (9.0, RING)):
        known = view_targets(cameras, torch.full((NUM,), depth)).distances
        assert torch.allclose(known, torch.tensor(distance, dtype=torch.float64))
    moved = off_path_cameras(cameras, targets_found, NUM)
    before, after = (c.scene_from_camera.double() for c in (cameras, moved))
    # It goes on looking at what was ahead of it at that distance.
    target = before[:, :, 3] - RING * before[:, :, 2]
    ways = torch.nn.functional.normalize(target - after[:, :, 3], dim=-1)
    assert torch.allclose(ways, -after[:, :, 2], atol=1e-5)


def test_a_focus_beside_the_picture_is_not_looked_at(ring: Cameras) -> None:
    """One camera of the ring is turned aside by 50 degrees: what it shows is elsewhere."""
    poses = [look_at(place, np.zeros(3)) for place in ring_places()]
    place = poses[0][:, 3]
    sine, cosine = math.sin(math.radians(50.0)), math.cos(math.radians(50.0))
    turn = np.array([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]])
    poses[0] = look_at(place, place + turn @ -place)
    cameras = cameras_of(poses)
    focus = focus_point(cameras)
    assert focus is not None
    targets = view_targets(cameras)
    ahead = -cameras.scene_from_camera[0, :, 2].double()
    spread = float(targets.distances[0])
    assert spread < 0.99 * math.hypot(RING, RISE)
    assert torch.allclose(targets.points[0], torch.from_numpy(place) + spread * ahead, atol=1e-5)
    assert torch.allclose(targets.points[1:], focus.expand(NUM - 1, 3), atol=1e-6)


def test_one_standpoint_is_refused() -> None:
    poses = [look_at(np.ones(3), np.ones(3) + way) for way in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])]
    with pytest.raises(NerfError, match="one place") as caught:
        view_targets(cameras_of(poses), torch.ones(2))
    assert caught.value.code == "bad_cameras"


def test_off_path_cameras_keep_their_lens_and_leave_the_path(ring: Cameras) -> None:
    views = off_path_cameras(ring, view_targets(ring), NUM, seed=3)
    poses = views.scene_from_camera.double()
    turns = poses[:, :, :3]
    assert torch.allclose(turns @ turns.transpose(1, 2), torch.eye(3).double(), atol=1e-6)
    assert torch.allclose(torch.linalg.det(turns), torch.ones(NUM).double(), atol=1e-6)
    moved = poses[:, :, 3] - ring.scene_from_camera[:, :, 3].double()
    reach = math.hypot(RING, RISE)
    assert torch.allclose(moved.norm(dim=-1), torch.full((NUM,), 0.15 * reach).double(), atol=1e-5)
    assert (moved[:, 2] > 0.1 * reach).all(), "sideways would follow the ring"
    along = (moved * ring.scene_from_camera[:, :, 2].double()).sum(dim=-1)
    assert along.abs().max() < 1e-5
    to_focus = torch.nn.functional.normalize(-poses[:, :, 3], dim=-1)
    assert torch.allclose(to_focus, -turns[:, :, 2], atol=1e-5)
    assert torch.equal(views.focal, ring.focal)


def test_off_path_cameras_depend_on_the_seed_alone(ring: Cameras) -> None:
    targets = view_targets(ring)
    again = [off_path_cameras(ring, targets, 5, seed=s).scene_from_camera for s in (1, 1, 2)]
    assert torch.equal(again[0], again[1])
    assert not torch.equal(again[0], again[2])
    assert len(off_path_cameras(ring, targets, 2 * NUM)) == 2 * NUM
    with pytest.raises(NerfError, match="at least one"):
        off_path_cameras(ring, targets, 0)


def corridor_walk(there_and_back: bool) -> tuple[Cameras, torch.Tensor]:
    """A walk along the middle of a corridor, and the median depth of each picture.

    It is 26 long, 1.8 wide and 2.5 high, and the phone is turned a little from side to side, but
    for the last of it more to one: the axes have a nearest point, far behind the walls.
    """
    half = np.array([13.0, 0.9, 1.25])
    poses = []
    for index in range(26):
        place = np.array([index - 12.5, 0.05 * math.sin(index), 0.3])
        turn = 0.25 * math.sin(1.7 * index) + 0.02 * index
        back = there_and_back and index % 2 == 1
        way = np.array([math.cos(turn), math.sin(turn), -0.15]) * (-1.0 if back else 1.0)
        poses.append(look_at(place, place + way))
    cameras = cameras_of(poses)
    depths = []
    for index, pose in enumerate(poses):
        rays = cameras.image_rays(index)
        ways = rays.directions.double().numpy()
        with np.errstate(divide="ignore"):
            exits = (np.where(ways > 0, half, -half) - pose[:, 3]) / ways
        depths.append(np.median(exits.min(axis=1) * (ways @ -pose[:, 2])))
    return cameras, torch.from_numpy(np.array(depths))


def inside(views: Cameras) -> bool:
    places = views.scene_from_camera[:, :, 3].abs()
    return bool((places < torch.tensor([13.0, 0.9, 1.25])).all())


@pytest.mark.parametrize("there_and_back", [False, True])
def test_a_walk_through_a_corridor_is_not_left_through_its_walls(there_and_back: bool) -> None:
    cameras, depths = corridor_walk(there_and_back)
    assert inside(cameras)
    by_poses, told = view_targets(cameras), view_targets(cameras, depths)
    for seed in range(8):
        # Poses alone do not know how wide it is.
        assert not inside(off_path_cameras(cameras, by_poses, len(cameras), seed))
        views = off_path_cameras(cameras, told, len(cameras), seed)
        assert inside(views)
        # Each goes on looking at what the phone showed, not at a place behind a wall: the corner
        # of its picture is 40 degrees away.
        backs = views.scene_from_camera[:, :, 2], cameras.scene_from_camera[:, :, 2]
        assert float((backs[0] * backs[1]).sum(dim=-1).min()) > math.cos(math.radians(40.0))
