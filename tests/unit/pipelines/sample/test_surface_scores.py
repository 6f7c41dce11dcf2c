"""F-scores: the truth scores 1, and what is shifted, holed or bulging scores as predicted."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.sample.film import phone_camera, walk
from pipelines.sample.judge import SurfaceScores, judge_cloud, judge_surface
from pipelines.sample.scene import (
    Floats,
    Scene,
    depth_image,
    pixel_rays,
    pose_matrix,
    seen_surface,
    surface_normals,
)
from pipelines.sample.scenes.catalogue import TAKES
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.orientation import Similarity

IDENTITY = Similarity(np.eye(3), np.zeros(3), 1.0)
NUM_POINTS = 5000
ROOM = TAKES["room"]
TRUTH = walk(20, phone_camera(160), take=ROOM)


def _seen_mesh(truth: CamerasFile, scene: Scene) -> tuple[Floats, NDArray[np.int64]]:
    """The true surface as every camera's depth image, without faces across edges of things."""
    camera = truth.cameras[0]
    vertices, faces, offset = [], [], 0
    for image in truth.images:
        pose = pose_matrix(image)
        z = depth_image(camera, pose, scene)
        y, x = np.mgrid[0 : camera.height, 0 : camera.width]
        origins, directions = pixel_rays(
            camera, pose, np.stack([x.ravel() + 0.5, y.ravel() + 0.5], axis=1)
        )
        t = z.ravel() / (directions @ -pose[:, 2])
        vertices.append(origins + t[:, None] * directions)
        index = np.arange(z.size).reshape(z.shape)
        corners = np.stack([index[:-1, :-1], index[1:, :-1], index[:-1, 1:], index[1:, 1:]], -1)
        # From farther away a pixel is a longer step on what is seen at a glance.
        most = np.maximum(0.05, 0.03 * z.ravel()[corners].mean(axis=-1))
        quads = corners[np.ptp(z.ravel()[corners], axis=-1) < most]
        faces += [offset + quads[:, [0, 1, 2]], offset + quads[:, [2, 1, 3]]]
        offset += z.size
    return np.concatenate(vertices), np.concatenate(faces)


@pytest.fixture(scope="module")
def room_mesh() -> tuple[Floats, NDArray[np.int64]]:
    return _seen_mesh(TRUTH, ROOM.scene)


def _judged(vertices: Floats, faces: NDArray[np.int64]) -> SurfaceScores:
    return judge_surface(vertices, faces, IDENTITY, TRUTH, ROOM.scene, NUM_POINTS)


@pytest.mark.parametrize("name", sorted(TAKES))
def test_the_true_surface_scores_one(name: str) -> None:
    take = TAKES[name]
    truth = walk(12, phone_camera(160), take=take)
    scores = judge_surface(
        *_seen_mesh(truth, take.scene), IDENTITY, truth, take.scene, num_points=NUM_POINTS
    )
    for tolerance in (0.01, 0.02):
        assert scores.precision[tolerance] > 0.99
        assert scores.recall[tolerance] > 0.98
        assert scores.f_score[tolerance] > 0.985
        assert scores.things_precision[tolerance] > 0.98
    assert scores.accuracy < 0.001
    assert scores.completeness < 0.002


def test_walls_moved_outwards_score_as_far_as_they_were_moved(
    room_mesh: tuple[Floats, NDArray[np.int64]],
) -> None:
    vertices, faces = room_mesh
    size = ROOM.scene.subject.size
    # Everything 1.5 % farther from the middle of each wall: beyond 1 % of the size, within 2 %.
    outwards = vertices.copy()
    for axis, half in ((0, 2.5), (1, 2.0)):
        on_wall = np.abs(np.abs(vertices[:, axis]) - half) < 1e-6
        outwards[on_wall, axis] += 0.015 * size * np.sign(vertices[on_wall, axis])
    corners = vertices[faces]
    area = np.linalg.norm(
        np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1
    )
    wall_faces = (np.abs(np.abs(corners[..., 0]) - 2.5) < 1e-6).all(axis=1) | (
        np.abs(np.abs(corners[..., 1]) - 2.0) < 1e-6
    ).all(axis=1)
    share = float(area[wall_faces].sum() / area.sum())
    assert 0.3 < share < 0.8
    scores = _judged(outwards, faces)
    assert scores.precision[0.01] == pytest.approx(1.0 - share, abs=0.03)
    assert scores.precision[0.02] > 0.98
    assert scores.recall[0.02] > 0.98
    assert scores.recall[0.01] < 0.75


def test_a_wall_half_a_metre_behind_the_true_one_is_wrong_and_counted(
    room_mesh: tuple[Floats, NDArray[np.int64]],
) -> None:
    vertices, faces = room_mesh
    away = vertices.copy()
    on_wall = vertices[:, 0] > 2.5 - 1e-6
    away[on_wall, 0] += 0.5
    scores, right = _judged(away, faces), _judged(vertices, faces)
    assert scores.precision[0.02] < right.precision[0.02] - 0.03
    assert scores.recall[0.02] < right.recall[0.02] - 0.03


def test_a_hole_costs_recall_by_its_area_and_no_precision(
    room_mesh: tuple[Floats, NDArray[np.int64]],
) -> None:
    vertices, faces = room_mesh
    kept = faces[(vertices[faces][..., 2] > 1.0).all(axis=1)]
    scores, whole = _judged(vertices, kept), _judged(vertices, faces)
    assert scores.precision[0.01] > 0.99
    assert scores.recall[0.01] < whole.recall[0.01] - 0.2
    expected = 2 * scores.precision[0.01] * scores.recall[0.01]
    expected /= scores.precision[0.01] + scores.recall[0.01]
    assert scores.f_score[0.01] == pytest.approx(expected)


def test_no_mesh_scores_nothing() -> None:
    scores = _judged(np.zeros((0, 3)), np.zeros((0, 3), np.int64))
    assert scores.f_score == {0.01: 0.0, 0.02: 0.0}
    assert scores.completeness == np.inf


def test_a_clouds_points_score_by_how_far_they_are() -> None:
    points = seen_surface(TRUTH, ROOM.scene.subject, 60_000, ROOM.scene)
    size = ROOM.scene.subject.size
    exact = judge_cloud(points, IDENTITY, TRUTH, ROOM.scene, NUM_POINTS)
    assert exact.accuracy < 1e-6
    assert min(*exact.precision.values(), *exact.recall.values()) > 0.99
    outward = surface_normals(points, ROOM.scene)
    third = np.arange(len(points)) % 3 == 0
    moved = points + 0.015 * size * np.where(third[:, None], outward, 0.0)
    scores = judge_cloud(moved, IDENTITY, TRUTH, ROOM.scene, NUM_POINTS)
    assert scores.precision[0.01] == pytest.approx(2 / 3, abs=0.03)
    assert scores.precision[0.02] > 0.99
    half = judge_cloud(
        points[points[:, 0] < np.median(points[:, 0])], IDENTITY, TRUTH, ROOM.scene, NUM_POINTS
    )
    assert half.precision[0.01] > 0.99
    assert 0.2 < half.recall[0.01] < 0.8
    nothing = judge_cloud(np.zeros((0, 3)), IDENTITY, TRUTH, ROOM.scene, NUM_POINTS)
    assert (nothing.f_score[0.02], nothing.accuracy) == (0.0, np.inf)
