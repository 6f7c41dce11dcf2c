"""The point cloud of a tiny trained model."""

from __future__ import annotations

import zipfile
from pathlib import Path

import laspy
import numpy as np
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.errors import ExportError
from pipelines.exports.formats.ply import read_ply
from pipelines.registry import get_stage
from pipelines.scene.cameras_file import CamerasFile
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


def test_all_formats_hold_the_same_points(job: Workspace, tmp_path: Path) -> None:
    formats = ("ply", "las", "laz", "xyz", "colmap")
    summary = tiny_job.run(job, "pointcloud", formats=formats)["summary"]
    folder = job.stage("pointcloud")
    wanted = read_ply(folder / "pointcloud.ply")
    assert wanted.colors is not None
    for name in ("pointcloud.las", "pointcloud.laz"):
        np.testing.assert_allclose(laspy.read(folder / name).xyz, wanted.points, atol=1e-5)
    rows = np.loadtxt(folder / "pointcloud.xyz")
    np.testing.assert_allclose(rows[:, :3], wanted.points, atol=1e-5)
    with zipfile.ZipFile(folder / "pointcloud.colmap.zip") as archive:
        archive.extractall(tmp_path)
    model = pycolmap.Reconstruction(tmp_path / "sparse" / "0")
    assert model.num_points3D() == summary["num_points"] == len(wanted.points)
    points = [model.points3D[index + 1] for index in range(len(wanted.points))]
    np.testing.assert_allclose([point.xyz for point in points], wanted.points, atol=1e-5)
    np.testing.assert_array_equal([point.color for point in points], wanted.colors)
    assert model.num_images() == tiny_job.NUM_IMAGES


def test_what_is_delivered_is_what_was_asked_for_and_later_stages_have_theirs(
    job: Workspace,
) -> None:
    manifest = tiny_job.run(job, "pointcloud", formats=("laz",))
    files = {file["path"] for file in manifest["files"]}
    artifacts = {artifact.path for artifact in get_stage("pointcloud").artifacts}
    assert (files & artifacts, files - artifacts) == ({"pointcloud.laz"}, {"judged.ply"})
    judged = read_ply(job.stage("pointcloud") / "judged.ply").points
    np.testing.assert_allclose(
        laspy.read(job.stage("pointcloud") / "pointcloud.laz").xyz, judged, atol=1e-5
    )


def _apart(points: NDArray[np.float32], least: float) -> float:
    """The share of points that have no other one so near."""
    found, _ = cKDTree(points).query(points, k=2)
    return float(np.mean(found[:, 1] > least))


def test_points_keep_the_spacing_asked_for_and_face_the_cameras(job: Workspace) -> None:
    tiny_job.run(job, "pointcloud")
    dense = read_ply(job.stage("pointcloud") / "pointcloud.ply").points
    spacing = 0.02 * float(np.ptp(dense, axis=0).max())
    tiny_job.run(job, "pointcloud", spacing=spacing)
    cloud = read_ply(job.stage("pointcloud") / "pointcloud.ply")
    assert 50 < len(cloud.points) < 0.7 * len(dense)
    assert _apart(cloud.points, 0.25 * spacing) > 0.9
    assert _apart(dense, 0.25 * spacing) < 0.7
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    eyes = np.asarray([image.world_from_camera for image in cameras.images])[:, :, 3]
    assert cloud.normals is not None
    towards = np.einsum("pc,pec->pe", cloud.normals, eyes[None] - cloud.points[:, None])
    assert (towards > 0).any(axis=1).mean() > 0.99, "some camera is in front of each point"
