"""The video's camera path: near the captured poses, smooth, with unit rotations."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.camera_path import (
    Floats,
    capture_order,
    natural_key,
    nearest_pose_distance,
    quaternions,
    rotation_matrices,
    smooth_path,
)
from tests.unit.pipelines.synthetic_views import look_at


def arc(num: int, shake: float = 0.0, seed: int = 0) -> Floats:
    """Cameras on 120 degrees of a circle of radius 3 around the origin."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2.0 * np.pi / 3.0, num)
    poses = []
    for angle in angles:
        place = 3.0 * np.array([np.cos(angle), np.sin(angle), 0.3])
        poses.append(look_at(place + shake * rng.normal(size=3), shake * rng.normal(size=3)))
    return np.stack(poses)


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


def test_quaternions_invert_rotation_matrices() -> None:
    q = np.random.default_rng(1).normal(size=(50, 4))
    q /= np.linalg.norm(q, axis=1, keepdims=True)
    np.testing.assert_allclose(np.abs((quaternions(rotation_matrices(q)) * q).sum(1)), 1.0)


def test_order_is_by_time_then_by_natural_name() -> None:
    poses = arc(12)
    names = [f"{i}.jpg" for i in range(12)]
    backwards = [float(12 - i) for i in range(12)]
    assert capture_order(poses, names, backwards).tolist() == list(range(11, -1, -1))
    assert capture_order(poses, names, [None] * 12).tolist() == list(range(12))
    assert natural_key("2.jpg") < natural_key("10.jpg")


def test_photos_named_at_random_are_ordered_by_neighbourhood() -> None:
    poses = arc(60)
    shuffled = np.random.default_rng(3).permutation(60)
    order = shuffled[capture_order(poses[shuffled], [f"{i}.jpg" for i in range(60)], [None] * 60)]
    assert order.tolist() in (list(range(60)), list(range(59, -1, -1)))


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
