"""The point cloud of a tiny trained model."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.errors import ExportError
from pipelines.exports.formats.ply import read_ply
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


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
