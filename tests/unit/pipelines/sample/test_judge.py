"""The judge: the truth passes, and a wrong scale, pose or surface shows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.sample.film import phone_camera, walk
from pipelines.sample.judge import judge_mesh, judge_normals, judge_poses
from pipelines.sample.scene import (
    SUBJECT,
    THINGS,
    Floats,
    depth_image,
    pixel_rays,
    pose_matrix,
    seen_surface,
    surface_normals,
)
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.orientation import Similarity

TRUTH = walk(12, phone_camera(240))
IDENTITY = Similarity(np.eye(3), np.zeros(3), 1.0)


def _moved(cameras: CamerasFile, move: Similarity, noise: float = 0.0) -> CamerasFile:
    random = np.random.default_rng(0)
    images = []
    for image in cameras.images:
        pose = pose_matrix(image)
        center = move.apply_to_points(pose[None, :, 3])[0] + noise * random.normal(size=3)
        turned = np.column_stack([move.rotation @ pose[:, :3], center])
        rows = tuple(tuple(map(float, row)) for row in turned)
        images.append(replace(image, world_from_camera=rows))
    return replace(cameras, images=tuple(images))


def _true_mesh(backwards: float = 0.0) -> tuple[Floats, NDArray[np.int64]]:
    """The true surface as every camera's depth image, its points moved along their rays."""
    camera = phone_camera(160)
    vertices, faces = [], []
    offset = 0
    for image in TRUTH.images:
        pose = pose_matrix(image)
        z = depth_image(camera, pose)
        y, x = np.mgrid[0 : camera.height, 0 : camera.width]
        origins, directions = pixel_rays(
            camera, pose, np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        )
        t = z.ravel() / (directions @ -pose[:, 2]) + backwards
        vertices.append(origins + t[:, None] * directions)
        index = np.arange(z.size).reshape(z.shape)
        corners = np.stack([index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]], -1)
        # No faces across the edges of things.
        depths = z.ravel()[corners]
        quads = corners[np.ptp(depths, axis=-1) < 0.05]
        faces += [offset + quads[:, [0, 1, 2]], offset + quads[:, [2, 1, 3]]]
        offset += z.size
    return np.concatenate(vertices), np.concatenate(faces)


def test_poses_in_another_frame_are_judged_perfect() -> None:
    angle = np.radians(70.0)
    rotation = np.array(
        [[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1.0]]
    )
    judged = judge_poses(_moved(TRUTH, Similarity(rotation, np.array([5.0, 1, 2]), 0.3)), TRUTH)
    assert judged.num_images == 12
    assert judged.mean_center_error < 1e-9
    assert judged.mean_rotation_error_deg < 1e-3
    assert judged.alignment.scale == pytest.approx(1 / 0.3)


def test_noisy_poses_are_judged_by_their_noise() -> None:
    judged = judge_poses(_moved(TRUTH, IDENTITY, noise=0.05), TRUTH)
    # The path spans about 3.5 m; the mean length of such a noise is 8 cm, a part of it aligned.
    assert 0.01 < judged.mean_center_error < 0.03
    assert judged.max_center_error > judged.mean_center_error


def test_images_are_paired_by_time_not_by_order() -> None:
    subset = replace(TRUTH, images=tuple(reversed(TRUTH.images[3:10])))
    assert judge_poses(subset, TRUTH).mean_center_error < 1e-9
    late = replace(TRUTH.images[0], timestamp_s=99.0)
    with pytest.raises(ValueError, match="within half a frame"):
        judge_poses(replace(TRUTH, images=(late, *TRUTH.images[1:])), TRUTH)
    unknown = replace(TRUTH.images[0], timestamp_s=None)
    with pytest.raises(ValueError, match="no timestamp"):
        judge_poses(replace(TRUTH, images=(unknown, *TRUTH.images[1:])), TRUTH)


def test_the_true_surface_is_judged_accurate_and_complete() -> None:
    vertices, faces = _true_mesh()
    judged = judge_mesh(vertices, faces, IDENTITY, TRUTH, num_points=4000)
    assert judged.accuracy < 0.001
    assert judged.completeness < 0.002
    assert judged.num_mesh_points > 500
    assert judged.num_true_points > 3000


def test_a_displaced_or_wrongly_scaled_mesh_is_not_accurate() -> None:
    vertices, faces = _true_mesh(backwards=0.15)
    displaced = judge_mesh(vertices, faces, IDENTITY, TRUTH, num_points=4000)
    assert displaced.accuracy > 0.02
    vertices, faces = _true_mesh()
    larger = Similarity(np.eye(3), np.zeros(3), 1.3)
    # The floor lies on itself at any scale; the things on it do not.
    scaled = judge_mesh(vertices, faces, larger, TRUTH, THINGS, num_points=4000)
    assert scaled.completeness > 0.01
    assert scaled.accuracy > 0.01


def test_half_a_mesh_is_accurate_but_not_complete() -> None:
    vertices, faces = _true_mesh()
    half = faces[(vertices[faces][:, :, 0] < -0.3).all(axis=1)]
    judged = judge_mesh(vertices, half, IDENTITY, TRUTH, num_points=4000)
    assert judged.accuracy < 0.001
    assert judged.completeness > 0.05
    assert SUBJECT.size == pytest.approx(2.2)


def test_an_empty_mesh_is_refused() -> None:
    with pytest.raises(ValueError, match="without faces"):
        judge_mesh(np.zeros((0, 3)), np.zeros((0, 3), int), IDENTITY, TRUTH)


@pytest.fixture(scope="module")
def seen() -> tuple[Floats, Floats]:
    """Points of the true surface that cameras saw, and its normals there."""
    points = seen_surface(TRUTH, num_points=3000)
    return points, surface_normals(points)


def _tilted(normals: Floats, angle_deg: float) -> Floats:
    """Unit normals turned by an angle, each about a line across it, at random."""
    across = np.cross(normals, np.random.default_rng(0).normal(size=normals.shape))
    across /= np.linalg.norm(across, axis=1, keepdims=True)
    angle = np.radians(angle_deg)
    tilted: Floats = np.cos(angle) * normals + np.sin(angle) * across
    return tilted


@pytest.mark.parametrize("angle", [10.0, 29.0, 31.0, 89.0, 91.0, 180.0])
def test_normals_are_off_by_as_much_as_they_were_turned(
    seen: tuple[Floats, Floats], angle: float
) -> None:
    points, normals = seen
    scores = judge_normals(points, 3.0 * _tilted(normals, angle), IDENTITY, TRUTH)
    assert scores.num_points > 0.99 * len(points)
    assert scores.median_deg == pytest.approx(angle, abs=0.01)
    assert scores.over_30_deg == float(angle > 30.0)
    assert scores.turned == float(angle > 90.0)


def test_a_share_of_wrong_normals_counts_as_such(seen: tuple[Floats, Floats]) -> None:
    points, normals = seen
    wrong, number = _tilted(normals, 4.0), np.arange(len(points))
    wrong[number % 5 == 0] *= -1.0
    wrong[number % 5 == 1] = _tilted(normals, 60.0)[number % 5 == 1]
    scores = judge_normals(points, wrong, IDENTITY, TRUTH)
    assert scores.median_deg == pytest.approx(4.0, abs=0.01)
    assert scores.over_30_deg == pytest.approx(0.4, abs=0.01)
    assert scores.turned == pytest.approx(0.2, abs=0.01)


def test_normals_are_judged_in_the_true_world_and_near_its_surface_alone(
    seen: tuple[Floats, Floats],
) -> None:
    points, normals = seen
    quarter = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])
    move = Similarity(quarter, np.array([1.0, 2, 3]), 0.5)
    there = (points - move.translation) @ quarter / 0.5
    scores = judge_normals(there, normals @ quarter, move, TRUTH, num_points=1000)
    assert scores.num_points == pytest.approx(1000, abs=20)
    assert scores.median_deg < 0.1
    # 1.5 % of the size before the surface nothing is compared, nor is there anything to tell.
    far = judge_normals(points + 0.015 * SUBJECT.size * normals, normals, IDENTITY, TRUTH)
    assert far.num_points < 0.1 * len(points)
    nothing = judge_normals(points + 50.0, normals, IDENTITY, TRUTH)
    assert nothing.num_points == 0
    assert np.isnan(nothing.median_deg)
