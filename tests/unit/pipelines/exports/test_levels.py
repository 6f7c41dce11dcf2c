"""Levels of detail, and how near a reduced mesh of the sample still is to the truth."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.levels import levels_of, texture_px_of
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.mesh_options import LEAST_TRIANGLES
from pipelines.exports.reduction import reduced
from pipelines.exports.surface.tsdf import fuse
from pipelines.sample.film import phone_camera, walk
from pipelines.sample.judge import SurfaceScores, judge_surface
from pipelines.sample.scene import SUBJECT, depth_image, pose_matrix
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.depth_views import DepthView, Pinhole
from pipelines.scene.orientation import Similarity

LONG_SIDE = 200
NOISE = 0.004
TRUTH = walk(24, phone_camera(LONG_SIDE))
HERE = Similarity(np.eye(3), np.zeros(3), 1.0)


@pytest.fixture(scope="module")
def fused() -> TriangleMesh:
    """The subject of the sample, from noisy depth of all round, with open borders."""
    noise = np.random.default_rng(0)
    lens = Pinhole.of(TRUTH.cameras[0], LONG_SIDE)
    views = []
    for image in TRUTH.images:
        exact = depth_image(lens.intrinsics(), pose_matrix(image))
        z = np.asarray(exact * (1.0 + NOISE * noise.normal(size=exact.shape)), np.float32)
        grey = np.full((*z.shape, 3), 128, np.uint8)
        views.append(DepthView(lens, pose_matrix(image), grey, z))
    low, high = np.asarray(SUBJECT.low), np.asarray(SUBJECT.high)
    bounds = SceneBounds((low + high) / 2.0, 3.0, 6.0, low, high)
    return fuse(views, bounds, SUBJECT.size / 128)


def scores(mesh: TriangleMesh, truth: CamerasFile = TRUTH) -> SurfaceScores:
    return judge_surface(mesh.vertices, mesh.faces, HERE, truth, num_points=8_000)


def test_a_tenth_of_the_triangles_is_as_near_to_the_truth(fused: TriangleMesh) -> None:
    """The issue's bound, 0.01 of the F-score, at 1 and 2 % of the scene's size."""
    few = reduced(fused, len(fused.faces) // 10)
    assert len(fused.faces) > 40_000
    assert len(few.faces) == pytest.approx(len(fused.faces) / 10, rel=0.02)
    full, now = scores(fused), scores(few)
    for tolerance, score in full.f_score.items():
        assert score > 0.9
        assert now.f_score[tolerance] >= score - 0.01, tolerance
    assert now.accuracy < 1.5 * full.accuracy, "half of the surface is hardly farther off"


def test_each_level_has_a_quarter_of_the_one_before(fused: TriangleMesh) -> None:
    before, full = len(fused.faces), scores(fused).f_score[0.02]
    for level in levels_of(fused, 3):
        assert len(level.faces) == pytest.approx(before / 4, rel=0.03)
        before = len(level.faces)
    assert scores(level).f_score[0.02] >= full - 0.05
    assert [texture_px_of(level, 4096) for level in range(4)] == [4096, 2048, 1024, 512]
    assert texture_px_of(3, 512) == 512


def test_levels_of_next_to_nothing_stay_something(fused: TriangleMesh) -> None:
    tiny = reduced(fused, 2 * LEAST_TRIANGLES)
    assert all(len(level.faces) >= LEAST_TRIANGLES - 2 for level in levels_of(tiny, 3))
