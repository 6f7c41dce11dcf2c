"""The point cloud stage: exact views first, then a tiny trained model."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.depth_views import DepthView, Pinhole
from pipelines.errors import ExportError
from pipelines.ply import read_ply
from pipelines.scene_bounds import SceneBounds
from pipelines.stages.pointcloud import Cloud, consistent, gather, oriented_normals
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job
from tests.unit.pipelines.synthetic_views import ring, sphere_color, sphere_view

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
    assert consistent(cloud, views).mean() > 0.99
    normals = oriented_normals(cloud, CENTER)
    np.testing.assert_allclose(np.linalg.norm(normals, axis=1), 1.0)
    assert np.median((normals * outward).sum(axis=1)) > 0.98
    assert (normals * outward).sum(axis=1).min() > 0.0


def test_points_that_views_look_through_are_dropped() -> None:
    views = [sphere_view(LENS, pose, CENTER) for pose in ring(24, CENTER)]
    cloud = gather(views, BOUNDS)
    floating = CENTER + np.array([[0.0, 0.0, 1.25], [1.25, 0.0, 0.0]])
    hidden = CENTER[None]
    both = Cloud(
        np.concatenate((cloud.points, floating, hidden)),
        np.concatenate((cloud.colors, np.zeros((3, 3), np.uint8))),
        np.concatenate((cloud.eyes, np.zeros((3, 3)))),
    )
    # The sphere's surroundings must be known for a view to look through them.
    known = [
        DepthView(v.lens, v.world_from_camera, v.rgb, np.where(v.z_depth > 0, v.z_depth, 9.0))
        for v in views
    ]
    fine = consistent(both, known)
    assert not fine[len(cloud) : len(cloud) + 2].any()
    assert fine[-1], "what no view can see is not contradicted"
    assert fine[: len(cloud)].mean() > 0.9


def test_the_stage_writes_the_points_wanted(job: Workspace) -> None:
    manifest = tiny_job.run(job, "pointcloud")
    cloud = read_ply(job.stage("pointcloud") / "pointcloud.ply")
    assert len(cloud.points) == manifest["summary"]["num_points"] == 4000
    assert cloud.colors is not None
    assert cloud.colors.std() > 5.0
    assert cloud.normals is not None
    np.testing.assert_allclose(np.linalg.norm(cloud.normals, axis=1), 1.0, atol=1e-5)
    bounds = manifest["summary"]["bounds"]
    away = np.linalg.norm(cloud.points - np.asarray(bounds["focus"]), axis=1)
    assert away.max() <= bounds["radius"] * 1.0001


def test_an_empty_crop_is_an_error_and_not_an_endless_search(job: Workspace) -> None:
    with pytest.raises(ExportError) as caught:
        tiny_job.run(job, "pointcloud", max_distance=1e-6)
    assert caught.value.code == "empty_pointcloud"
