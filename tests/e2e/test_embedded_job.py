"""A whole job over HTTP on the embedded defaults, judged against the sample's exact truth."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from api.client.client import Client
from deploy.embedded import Embedded
from deploy.supervisor import Supervisor
from pipelines.exports.formats.ply import read_ply
from pipelines.option_models import merge
from pipelines.options import ON_REQUEST
from pipelines.registry import STAGE_NAMES, STAGES
from pipelines.sample.film import phone_camera, render_all, walk
from pipelines.sample.judge import judge_mesh, judge_poses
from pipelines.scene.cameras_file import CamerasFile
from tests.capture_writers import write_hdr_hevc
from tests.e2e.waiting import succeeded
from tests.samples import PLAIN, SMALL

pytestmark = [pytest.mark.services, pytest.mark.slow, pytest.mark.timeout(700)]

BRIEF = {
    **PLAIN,
    "train": {"max_steps": 300},
    "pointcloud": {"num_points": 5000, "far_distance": 2.0},
}

REPORT_KEYS = (
    ("capture", "kind"),
    ("poses", "num_images"),
    ("poses", "num_registered"),
    ("poses", "registered_ratio"),
    ("metrics", "psnr"),
    ("metrics", "ssim"),
    ("metrics", "num_images"),
    ("metrics", "width"),
    ("metrics", "height"),
    ("metrics", "per_image"),
    ("options",),
    ("versions",),
)


def test_video_over_http_comes_back_as_assets_true_to_the_scene(
    service: tuple[Client, Embedded, Supervisor], clip: tuple[Path, Path], tmp_path: Path
) -> None:
    client, embedded, _ = service
    capture = client.upload(clip[0])
    assert capture.kind == "video"
    job = client.create_job(capture.id, preset="preview", options=SMALL)
    job = succeeded(client, embedded, job.id, 540)

    out = tmp_path / "out"
    client.download(job.id, out)
    artifacts = [artifact for stage in STAGES for artifact in stage.artifacts]
    found = {path.name for path in out.iterdir()}
    assert found >= {artifact.name for artifact in artifacts if not artifact.on_request}
    assert not found & {artifact.name for artifact in artifacts if artifact.on_request}

    report = json.loads((out / "report.json").read_text("utf-8"))
    for path in REPORT_KEYS:
        value = report
        for key in path:
            value = value[key]
    ran = set(STAGE_NAMES) - ON_REQUEST - {"report"}
    assert {f"{stage}_s" for stage in ran} <= set(report["timings"])
    assert report["poses"]["registered_ratio"] >= 0.9
    assert report["metrics"]["psnr"] >= 20.0
    assert report["metrics"]["num_images"] >= 3

    truth = CamerasFile.load(clip[1])
    cameras = CamerasFile.load(out / "cameras.json")
    poses = judge_poses(cameras, truth)
    assert poses.mean_center_error < 0.01, poses
    mesh = read_ply(out / "mesh.ply")
    judged = judge_mesh(mesh.points.astype(np.float64), mesh.faces, poses.alignment, truth)
    assert judged.accuracy < 0.01, judged
    assert judged.completeness < 0.01, judged


def test_hdr_rotated_hevc_clip_goes_through(
    service: tuple[Client, Embedded, Supervisor], tmp_path: Path
) -> None:
    client, embedded, _ = service
    clip = tmp_path / "IMG_0001.MOV"
    truth = write_hdr_hevc(clip, num=48, long_side_px=480)
    capture = client.upload(clip)
    assert capture.kind == "video"
    job = client.create_job(capture.id, preset="preview", options=merge(SMALL, BRIEF))
    job = succeeded(client, embedded, job.id, 540)

    out = tmp_path / "out"
    client.download(job.id, out)
    report = json.loads((out / "report.json").read_text("utf-8"))
    assert report["poses"]["registered_ratio"] >= 0.9
    assert report["metrics"]["width"] < report["metrics"]["height"], "not upright"
    cameras = CamerasFile.load(out / "cameras.json")
    assert judge_poses(cameras, truth).mean_center_error < 0.01
    # The clip's frames have 0.73 of the scene's colourfulness (docs/video.md: what HLG costs), and
    # so has the cloud; shown as if they were SDR they have 0.53.
    points = read_ply(out / "pointcloud.ply")
    assert points.colors is not None
    shown = np.concatenate([p.reshape(-1, 3) for p in render_all(walk(8, phone_camera(160)))])
    assert _colorfulness(points.colors) > 0.63 * _colorfulness(shown)


def _colorfulness(colors: NDArray[np.uint8]) -> float:
    """The mean difference between a colour's greatest and least channel; colors: [P, 3]."""
    return float((colors.max(axis=1).astype(int) - colors.min(axis=1)).mean())
