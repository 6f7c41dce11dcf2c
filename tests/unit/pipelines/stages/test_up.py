"""Which way is up where depth is looked for."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.stages.void_masks import up_of_world

Poses = NDArray[np.float64]
LENS = Intrinsics(400, 300, 300.0, 300.0, 200.0, 150.0)
ON_ITS_SIDE = np.array([[0.0, -1.0, 0.0], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])


def arc(num: int = 12, degrees: float = 90.0) -> Poses:
    """Upright cameras around the origin, 30 degrees above it: [N, 3, 4]."""
    poses = []
    for angle in np.radians(np.linspace(0.0, degrees, num)):
        back = np.array([np.cos(angle) * 0.87, np.sin(angle) * 0.87, 0.5])
        right = np.array([-np.sin(angle), np.cos(angle), 0.0])
        poses.append(np.column_stack([right, np.cross(back, right), back, 2.0 * back]))
    return np.array(poses)


def up(poses: Poses, **notes: str) -> NDArray[np.float64]:
    images = tuple(
        PosedImage(f"{i}.jpg", 0, tuple(map(tuple, pose.tolist()))) for i, pose in enumerate(poses)
    )
    return up_of_world(CamerasFile((LENS,), images, notes=notes))


@pytest.mark.parametrize("every", [1, 2, 3, 12])
def test_pictures_on_their_side_leave_the_world_as_it_is(every: int) -> None:
    poses = arc()
    poses[::every, :, :3] = poses[::every, :, :3] @ ON_ITS_SIDE
    assert up(poses)[2] > 0.98


def test_level_pictures_tell_it_better_than_a_world_turned_by_quarters() -> None:
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, 0.99, -0.14], [0.0, 0.14, 0.99]]) @ arc()
    assert up(tilted) @ [0.0, -0.14, 0.99] > 0.998
    assert up(tilted, up_from="measured")[2] == 1.0


def test_a_world_of_no_orientation_is_told_by_its_pictures_alone() -> None:
    tilted = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]]) @ arc()
    assert up(tilted, up_from="none") @ [0.0, -0.6, 0.8] > 0.98
