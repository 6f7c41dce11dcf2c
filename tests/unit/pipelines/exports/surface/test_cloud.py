"""Points and normals from exact depth views."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.surface.cloud import (
    Cloud,
    gather,
    with_normals,
    without_outliers,
)
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.consistency import consistent
from pipelines.scene.depth_views import DepthView, Pinhole
from tests.unit.pipelines.scene.synthetic_views import ring, sphere_color, sphere_view

CENTER = np.array([20.0, 5.0, -3.0])
LENS = Pinhole(80, 60, 75.0, 75.0, 40.0, 30.0)
BOUNDS = SceneBounds(CENTER, 3.0, 6.0, CENTER - 1.3, CENTER + 1.3)


@pytest.fixture(scope="module")
def views() -> list[DepthView]:
    return [sphere_view(LENS, pose, CENTER) for pose in ring(12, CENTER)]


def test_points_and_normals_of_a_sphere_are_exact(views: list[DepthView]) -> None:
    cloud = gather(views, BOUNDS)
    outward = cloud.points - CENTER
    np.testing.assert_allclose(np.linalg.norm(outward, axis=1), 1.0, atol=1e-5)
    np.testing.assert_allclose(cloud.colors / 255.0, sphere_color(cloud.points, CENTER), atol=0.01)
    assert consistent(cloud.points, views).mean() > 0.99
    normals = with_normals(cloud).normals
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.median((normals * outward).sum(axis=1)) > 0.98
    assert (normals * outward).sum(axis=1).min() > 0.0


def test_more_neighbours_make_normals_of_noisy_points_smoother() -> None:
    rng = np.random.default_rng(0)
    plane = np.column_stack([rng.random((4000, 2)), 0.01 * rng.standard_normal(4000)])
    eyes = np.tile([0.5, 0.5, 3.0], (4000, 1))
    cloud = Cloud.seen(plane, np.zeros((4000, 3), np.uint8), eyes)
    few, many = (with_normals(cloud, count).normals[:, 2] for count in (20, 40))
    assert min(few.min(), many.min()) >= 0.0
    off_by, then = (float(np.median(np.arccos(np.clip(up, -1, 1)))) for up in (few, many))
    # A plane's slope is told by as many, over as much more area: both count by their root.
    assert then == pytest.approx(off_by / 2.0, rel=0.15)


def test_a_point_far_from_all_others_goes(views: list[DepthView]) -> None:
    cloud = gather(views, BOUNDS)
    lonely = Cloud.seen(
        np.concatenate((cloud.points, CENTER[None] + 5.0)),
        np.concatenate((cloud.colors, cloud.colors[:1])),
        np.concatenate((cloud.eyes, cloud.eyes[:1])),
    )
    kept = without_outliers(lonely, CENTER)
    assert np.linalg.norm(kept.points - CENTER, axis=1).max() < 1.01
    assert len(kept) > 0.9 * len(cloud)
