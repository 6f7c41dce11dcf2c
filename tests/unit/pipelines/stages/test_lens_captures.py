"""Poses of the analytic scene through other lenses: panoramas, fisheyes, several clips.

The bounds are those of the product: median rotation error under 0.2 degrees, centres within 0.5 %
of the path's extent.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.options import FramesOptions, IngestOptions, PosesOptions
from pipelines.sample.align import path_extent, similarity
from pipelines.sample.film import hand_held_pose
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.panoramas import view_side, world_from_views
from pipelines.stage import StageContext
from pipelines.stages import frames, ingest, poses
from pipelines.workspace import Workspace
from tests.lens_films import film, fisheye_camera, level_pose, panorama_camera, walked
from tests.unit.pipelines.tools.clips import spherical

AXES = np.diag([1.0, -1.0, -1.0])


def run(root: Path, stage: str, options: Any) -> dict[str, Any]:
    """A stage's summary; its folder is complete afterwards, as after a run of the job."""
    workspace = Workspace(root)
    out = workspace.stage(stage)
    out.mkdir(parents=True)
    ctx = StageContext(stage, workspace, out, workspace.checkpoint(stage))
    functions: dict[str, Callable[..., dict[str, Any]]] = {
        "ingest": ingest.run,
        "frames": frames.run,
        "poses": poses.run,
    }
    summary = functions[stage](options, ctx)
    (out / "manifest.json").write_text("{}", "utf-8")
    return summary


def uploaded(root: Path, file: Path) -> Path:
    capture = Workspace(root).capture_file
    capture.parent.mkdir(parents=True)
    file.rename(capture)
    return capture


def errors(found: np.ndarray, true: np.ndarray) -> tuple[float, float]:
    """Median rotation error in degrees, and of centres in parts of the path's extent."""
    moved = similarity(found[:, :, 3], true[:, :, 3]).apply_to_cameras(found)
    gaps = np.linalg.norm(moved[:, :, 3] - true[:, :, 3], axis=1) / path_extent(true[:, :, 3])
    cosines = ((moved[:, :, :3] * true[:, :, :3]).sum(axis=(1, 2)) - 1.0) / 2.0
    return float(np.degrees(np.median(np.arccos(np.clip(cosines, -1, 1))))), float(np.median(gaps))


def test_a_film_of_the_whole_sphere_becomes_views_with_true_poses(tmp_path: Path) -> None:
    truth = walked(panorama_camera(640), 12, level_pose)
    uploaded(tmp_path / "job", spherical(film(tmp_path / "a.mp4", truth, side=1)))
    summary = run(tmp_path / "job", "ingest", IngestOptions())
    assert summary["projection"] == "equirectangular"
    run(tmp_path / "job", "frames", FramesOptions(num_frames=24, long_side_px=320))
    listed = json.loads((tmp_path / "job" / "frames" / "frames.json").read_text())["frames"]
    assert [len(row["views"]) for row in listed] == [4] * 12
    found = run(tmp_path / "job", "poses", PosesOptions(max_image_px=320, num_features=1500))
    assert found["num_registered"] == found["num_images"] == 12
    assert found["intrinsics"]["model"] == "EQUIRECTANGULAR"
    cameras = CamerasFile.load(tmp_path / "job" / "poses" / "cameras.json")
    (lens,) = cameras.cameras
    assert (lens.model, lens.width, lens.fl_x) == ("PINHOLE", view_side(640), view_side(640) / 2)
    assert [image.file for image in cameras.images] == [f for row in listed for f in row["views"]]
    for image in cameras.images:
        with PIL.Image.open(tmp_path / "job" / "frames" / image.file) as picture:
            assert picture.size == (lens.width, lens.height)
    true = []
    for image in truth.images:
        pose = np.array(image.world_from_camera)
        opencv = np.column_stack([pose[:, :3] @ AXES, pose[:, 3]])
        true += [np.column_stack([v[:, :3] @ AXES, v[:, 3]]) for v in world_from_views(opencv, 4)]
    rotation_deg, center = errors(
        np.array([image.world_from_camera for image in cameras.images]), np.array(true)
    )
    assert rotation_deg < 0.2
    assert center < 0.005


def test_a_fisheyes_film_is_recognised_and_its_lens_found(tmp_path: Path) -> None:
    """150 degrees across, bent off the equidistant rule; nobody says that it is a fisheye."""
    camera = fisheye_camera(480, 360, 150.0)
    truth = walked(camera, 14, hand_held_pose)
    uploaded(tmp_path / "job", film(tmp_path / "a.mp4", truth, side=1))
    run(tmp_path / "job", "ingest", IngestOptions())
    run(tmp_path / "job", "frames", FramesOptions(num_frames=14))
    found = run(tmp_path / "job", "poses", PosesOptions(max_image_px=480, num_features=1500))
    assert found["num_registered"] == found["num_images"] == 14
    assert found["intrinsics"]["model"] == "OPENCV_FISHEYE"
    assert found["mean_reprojection_error_px"] < 1.0
    assert "fisheye" in found["intrinsics"]["why"]
    cameras = CamerasFile.load(tmp_path / "job" / "poses" / "cameras.json")
    (lens,) = cameras.cameras
    assert lens.model == "OPENCV_FISHEYE"
    assert lens.fl_x == pytest.approx(camera.fl_x, rel=0.01)
    rotation_deg, center = errors(
        *(np.array([i.world_from_camera for i in c.images]) for c in (cameras, truth))
    )
    assert rotation_deg < 0.2
    assert center < 0.005
