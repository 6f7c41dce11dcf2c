"""The point cloud of a tiny trained model."""

from __future__ import annotations

import shutil
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import open3d
import pycolmap
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.errors import ExportError
from pipelines.exports import subject
from pipelines.exports.crop import crop_of
from pipelines.exports.formats.glb import read_mesh, write_mesh
from pipelines.exports.formats.ply import read_ply
from pipelines.exports.mesh import TexturedMesh
from pipelines.exports.options import CropShapeOptions
from pipelines.exports.surface.surface_file import load_surface
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


def _off(job: Workspace) -> NDArray[np.float64]:
    """How far the cloud's points are from the job's mesh, in voxels."""
    surface = load_surface(job.stage("mesh"))
    assert surface is not None
    cloud = read_ply(job.stage("pointcloud") / "pointcloud.ply")
    tensor: Any = open3d.core.Tensor  # its stubs refuse its own documented calls
    scene = open3d.t.geometry.RaycastingScene()
    scene.add_triangles(tensor(surface.vertices), tensor(surface.faces.astype(np.uint32)))
    points = (cloud.points - surface.origin).astype(np.float32)
    found = scene.compute_distance(tensor(points)).numpy() / surface.voxel.min()
    return np.asarray(found, np.float64)


def test_points_lie_on_the_jobs_mesh(job: Workspace) -> None:
    tiny_job.run(job, "mesh", texture="none", triangles=500, frame="normalised")
    summary = tiny_job.run(job, "pointcloud")["summary"]
    off = _off(job)
    on_it = off < 0.01
    assert on_it.mean() > 0.6
    assert abs(int(on_it.sum()) - summary["num_on_mesh"]) <= 0.01 * len(off)
    summary = tiny_job.run(job, "pointcloud", snap_to_mesh=False)["summary"]
    assert summary["num_on_mesh"] == 0
    assert (_off(job) < 0.01).mean() < 0.1


def test_without_a_mesh_points_stay_where_views_have_them(job: Workspace) -> None:
    shutil.rmtree(job.stage("mesh"), ignore_errors=True)
    assert tiny_job.run(job, "pointcloud")["summary"]["num_on_mesh"] == 0
    alone = (job.stage("pointcloud") / "pointcloud.ply").read_bytes()
    tiny_job.run(job, "mesh", texture="none")
    tiny_job.run(job, "pointcloud", snap_to_mesh=False)
    assert (job.stage("pointcloud") / "pointcloud.ply").read_bytes() == alone


def test_points_on_the_mesh_wear_its_picture_and_its_gaps_are_filled(job: Workspace) -> None:
    tiny_job.run(job, "mesh", formats=("glb",))
    path = job.stage("mesh") / "mesh.glb"
    mesh = read_mesh(path)
    assert isinstance(mesh, TexturedMesh)
    blue = np.zeros_like(mesh.texture)
    blue[..., 2] = 255
    write_mesh(path, replace(mesh, texture=blue))
    # So many points that there are places of the mesh which no view's pixel is near.
    summary = tiny_job.run(job, "pointcloud", num_points=20_000)["summary"]
    colors = read_ply(job.stage("pointcloud") / "pointcloud.ply").colors
    assert colors is not None
    is_blue = np.abs(colors.astype(int) - [0, 0, 255]).max(axis=1) <= 3
    assert is_blue.sum() <= summary["num_on_mesh"]
    assert is_blue.sum() > 0.8 * summary["num_on_mesh"]
    assert summary["filled_share"] > 0.0
    own = tiny_job.run(job, "pointcloud", num_points=20_000, snap_to_mesh=False)["summary"]
    assert own["filled_share"] == 0.0
    colors = read_ply(job.stage("pointcloud") / "pointcloud.ply").colors
    assert colors is not None
    assert (np.abs(colors.astype(int) - [0, 0, 255]).max(axis=1) > 3).all()


def _apart(points: NDArray[np.float32], least: float) -> float:
    """The share of points that have no other one so near."""
    found, _ = cKDTree(points).query(points, k=2)
    return float(np.mean(found[:, 1] > least))


def test_points_keep_the_spacing_asked_for_and_face_the_cameras(job: Workspace) -> None:
    tiny_job.run(job, "pointcloud")
    dense = read_ply(job.stage("pointcloud") / "pointcloud.ply").points
    spacing = 0.03 * float(np.ptp(dense, axis=0).max())
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


def test_a_subject_asked_for_is_what_a_mesh_is_cropped_to(job: Workspace) -> None:
    whole = tiny_job.run(job, "pointcloud")["summary"]
    assert whole["subject"] is None
    before = read_ply(job.stage("pointcloud") / "pointcloud.ply").points
    told = tiny_job.run(job, "pointcloud", extent="subject")["summary"]
    assert told["subject"]["kind"] == "subject", told["subject"]
    points = read_ply(job.stage("pointcloud") / "pointcloud.ply").points.astype(np.float64)
    region = told["subject"]["region"]
    box = crop_of(CropShapeOptions(shape="box", **region))
    assert box is not None
    assert box.distance(points).max() < 1e-4
    inside = box.contains(before.astype(np.float64)).sum()
    assert inside < 0.9 * len(before)
    assert len(points) > 1.2 * inside, "the points that are wanted are looked for in the thing"
    # A mesh that is cropped to what was found has looked for it in the same way.
    crop = tiny_job.run(job, "mesh", crop={"shape": "auto"}, texture="none")["summary"]["crop"]
    other = crop_of(CropShapeOptions(**crop["used"]))
    assert other is not None
    np.testing.assert_allclose(other.center, box.center, atol=1e-4)
    np.testing.assert_allclose(other.half, box.half, atol=1e-4)
    np.testing.assert_allclose(other.axes, box.axes, atol=1e-4)
    off, _ = cKDTree(read_mesh(job.stage("mesh") / "mesh.glb").vertices).query(points)
    assert np.median(off) < 0.08 * max(region["size"])
    # A crop says what is kept: nothing else is decided.
    crop = {"shape": "box", **region}
    cropped = tiny_job.run(job, "pointcloud", crop=crop)["summary"]
    assert cropped["subject"] is None


def test_without_a_subject_it_is_what_lies_near(
    job: Workspace, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(subject, "LEAST_STANDING", 1e9)
    near = {"max_distance": 0.9}
    told = tiny_job.run(job, "pointcloud", extent="subject", **near)["summary"]
    assert (told["subject"]["kind"], told["subject"]["region"]) == ("scene", None)
    assert "No subject was found" in caplog.text
    alone = (job.stage("pointcloud") / "pointcloud.ply").read_bytes()
    tiny_job.run(job, "pointcloud", far_distance=0.9, **near)
    assert (job.stage("pointcloud") / "pointcloud.ply").read_bytes() == alone
