"""The cameras of a tiny trained job, in the formats of other programs."""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import pycolmap

from pipelines.exports.formats.ply import read_ply
from pipelines.exports.kinds.cameras import EXPORT, CamerasOptions
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.trained_scene import TrainedScene
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.archives import context
from tests.unit.pipelines.stages import tiny_job


def test_all_three_files_hold_the_corrected_poses(job: Workspace) -> None:
    summary = tiny_job.run(job, "cameras")["summary"]
    out = job.stage("cameras")
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    assert (summary["num_images"], summary["num_lenses"]) == (20, len(cameras.cameras))
    assert summary["left_out"] == {}
    poses = np.asarray([image.world_from_camera for image in cameras.images])
    frames = json.loads((out / "transforms.json").read_text("utf-8"))["frames"]
    written = np.asarray([frame["transform_matrix"] for frame in frames])
    np.testing.assert_array_equal(written[:, :3], poses)
    with zipfile.ZipFile(out / "colmap.zip") as archive:
        archive.extractall(job.root / "colmap")
    model = pycolmap.Reconstruction(str(job.root / "colmap" / "sparse" / "0"))
    centers = {f"images/{i.name}": i.projection_center() for i in model.images.values()}
    for image, pose in zip(cameras.images, poses, strict=True):
        np.testing.assert_allclose(centers[image.file], pose[:, 3], atol=1e-9)
    frusta = read_ply(out / "cameras.ply")
    np.testing.assert_allclose(frusta.points[::6], poses[:, :, 3], atol=1e-5)
    assert {path.name for path in out.iterdir()} == {
        "transforms.json",
        "colmap.zip",
        "cameras.ply",
        "manifest.json",
    }


def test_a_format_that_cannot_hold_the_lenses_is_left_out_and_said(
    trained_job: Workspace, tmp_path: Path
) -> None:
    """The eighth power of the radius: nerfstudio's files have it, COLMAP's models do not."""
    scene = TrainedScene.load(trained_job.stage("train") / "model.zip")
    lenses = [replace(lens, model="OPENCV", k4=0.01) for lens in scene.cameras.cameras]
    scene.cameras = replace(scene.cameras, cameras=tuple(lenses))
    ctx = context(tmp_path, "cameras")
    summary = EXPORT.run(scene, CamerasOptions(), ctx)
    assert list(summary["left_out"]) == ["colmap.zip"]
    assert "k4" in summary["left_out"]["colmap.zip"]
    assert {path.name for path in ctx.out.iterdir()} == {"transforms.json", "cameras.ply"}
