"""Cameras beside a path: a ring of twelve that look at the origin, and paths without a focus."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.judging.floaters import near_distance
from pipelines.nerf.judging.off_path import focus_point, off_path_cameras, view_distances
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
    assert torch.allclose(view_distances(ring), expected, atol=1e-5)


@pytest.mark.parametrize("looking", ["outward", "parallel"])
def test_without_a_focus_the_size_of_the_path_takes_its_place(looking: str) -> None:
    shift, ahead = np.array([0.0, 0.0, 50.0]), np.array([0.0, 1.0, 0.0])
    targets = {"outward": lambda p: 3.0 * p, "parallel": lambda p: p + ahead}
    places = [place - [0.0, 0.0, RISE] for place in ring_places()]
    poses = [look_at(place + shift, targets[looking](place) + shift) for place in places]
    cameras = cameras_of(poses)
    assert focus_point(cameras) is None
    assert torch.allclose(view_distances(cameras), torch.tensor(RING, dtype=torch.float64))
    moved = off_path_cameras(cameras, NUM)
    before, after = (c.scene_from_camera.double() for c in (cameras, moved))
    # It goes on looking at what was ahead of it at that distance.
    target = before[:, :, 3] - RING * before[:, :, 2]
    ways = torch.nn.functional.normalize(target - after[:, :, 3], dim=-1)
    assert torch.allclose(ways, -after[:, :, 2], atol=1e-5)


def test_one_standpoint_is_refused() -> None:
    poses = [look_at(np.ones(3), np.ones(3) + way) for way in ([1.0, 0.0, 0.0], [0.0, 1.0, 0.0])]
    with pytest.raises(NerfError, match="one place") as caught:
        near_distance(cameras_of(poses))
    assert caught.value.code == "bad_cameras"


def test_off_path_cameras_keep_their_lens_and_leave_the_path(ring: Cameras) -> None:
    views = off_path_cameras(ring, NUM, seed=3)
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
    again = [off_path_cameras(ring, 5, seed=s).scene_from_camera for s in (1, 1, 2)]
    assert torch.equal(again[0], again[1])
    assert not torch.equal(again[0], again[2])
    assert len(off_path_cameras(ring, 2 * NUM)) == 2 * NUM
    with pytest.raises(NerfError, match="at least one"):
        off_path_cameras(ring, 0)
