"""Poses of the analytic scene through other lenses: panoramas, fisheyes, several clips.

The bounds are those of the product: median rotation error under 0.2 degrees, centres within 0.5 %
of the path's extent.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.options import CheckOptions, FramesOptions, IngestOptions, PosesOptions
from pipelines.sample.align import path_extent, similarity
from pipelines.sample.film import hand_held_pose
from pipelines.sample.scene import Floats
from pipelines.sample.scenes import room
from pipelines.sample.takes import looking_at
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from pipelines.scene.panoramas import view_side, world_from_views
from pipelines.stage import StageContext
from pipelines.stages import check, frames, ingest, poses
from pipelines.workspace import Workspace
from tests.lens_films import film, fisheye_camera, level_pose, panorama_camera, walked
from tests.unit.pipelines.tools.clips import ffmpeg, rotated, spherical

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
        "check": check.run,
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


def filmed_clips(folder: Path) -> tuple[Path, CamerasFile, CamerasFile]:
    """A .zip of three clips, and the true cameras of the first two.

    The first is wide and lies flat. The second begins halfway, is held upright (stored sideways,
    with a flag), has a longer lens and another size, and goes on above the first. The third shows
    another place, a room.
    """
    wide = walked(Intrinsics(384, 256, 290.0, 290.0, 192.0, 128.0), 14, first_half)
    long = walked(Intrinsics(272, 360, 330.0, 330.0, 136.0, 180.0), 12, second_half_from_above)
    elsewhere = walked(Intrinsics(384, 256, 290.0, 290.0, 192.0, 128.0), 9, room.pose)
    upright = film(folder / "upright.mp4", long, side=1)
    sideways = folder / "sideways.mp4"
    ffmpeg("-i", upright, "-vf", "transpose=cclock", "-crf", "14", sideways)
    clips = {
        "2 wide.mp4": film(folder / "wide.mp4", wide, side=1),
        "10 upright.mov": rotated(sideways, folder / "flagged.mov", 90),
        "11 room.mp4": film(folder / "room.mp4", elsewhere, side=1, scene=room.SCENE),
    }
    packed = folder / "clips.zip"
    with zipfile.ZipFile(packed, "w") as archive:
        for name, clip in clips.items():
            archive.write(clip, f"holiday/{name}")
    return packed, wide, long


def first_half(progress: float) -> Floats:
    return hand_held_pose(0.6 * progress)


def second_half_from_above(progress: float) -> Floats:
    pose = hand_held_pose(0.4 + 0.6 * progress)
    eye = pose[:, 3] + [0.0, 0.0, 0.15]
    return looking_at(eye, np.array([0.0, 0.1, 0.32]), 0.0)


def test_clips_become_one_model_and_one_of_another_place_is_left_out_by_name(
    tmp_path: Path,
) -> None:
    packed, wide, upright = filmed_clips(tmp_path)
    uploaded(tmp_path / "job", packed)
    assert run(tmp_path / "job", "ingest", IngestOptions())["num_clips"] == 3
    run(tmp_path / "job", "frames", FramesOptions(num_frames=40))
    quick = PosesOptions(max_image_px=384, num_features=1500, retry_below_ratio=0.5)
    found = run(tmp_path / "job", "poses", quick)
    rows = [(clip["name"], clip["num_images"], clip["is_apart"]) for clip in found["clips"]]
    assert rows == [
        ("holiday/2 wide.mp4", 14, False),
        ("holiday/10 upright.mov", 12, False),
        ("holiday/11 room.mp4", 9, True),
    ]
    (told,) = [one for one in found["warnings"] if one["code"] == "clip_apart"]
    assert "Clip 3 (holiday/11 room.mp4) does not join" in told["message"]
    cameras = CamerasFile.load(tmp_path / "job" / "poses" / "cameras.json")
    assert len(cameras.images) == found["num_registered"] == 26
    sizes = {(lens.width, lens.height): lens.fl_x for lens in cameras.cameras}
    assert sizes[384, 256] == pytest.approx(290.0, rel=0.01)
    assert sizes[272, 360] == pytest.approx(330.0, rel=0.01)
    rotation_deg, center = errors(
        np.array([image.world_from_camera for image in cameras.images]),
        np.array([image.world_from_camera for image in (*wide.images, *upright.images)]),
    )
    assert rotation_deg < 0.2
    assert center < 0.005
    run(tmp_path / "job", "check", CheckOptions())
    report = json.loads((tmp_path / "job" / "check" / "capture-report.json").read_text())
    (apart,) = [one for one in report["findings"] if one["code"] == "clip_apart"]
    assert apart["what"].startswith("In clip 3 (holiday/11 room.mp4) ")
    assert [clip["num_placed"] for clip in report["clips"]] == [14, 12, 0]
    assert report["verdict"] in ("usable", "poor")
