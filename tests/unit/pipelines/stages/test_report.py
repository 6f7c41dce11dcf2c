"""The report: every fixed key, from the manifests of a whole tiny job."""

from __future__ import annotations

import hashlib
import json
from typing import Any

import pytest

from pipelines.captures.record import CaptureRecord
from pipelines.errors import ExportError
from pipelines.stages.report import build_report
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


@pytest.fixture
def report(job: Workspace) -> dict[str, Any]:
    for stage in ("evaluate", "pointcloud", "mesh", "video", "report"):
        tiny_job.run(job, stage)
    loaded: dict[str, Any] = json.loads((job.stage("report") / "report.json").read_text())
    return loaded


def test_a_whole_job_has_every_fixed_key(report: dict[str, Any], job: Workspace) -> None:
    assert report["capture"]["kind"] == "nerfstudio"
    assert report["capture"]["warnings"]
    poses = report["poses"]
    # 25 pictures are listed, 3 of them are not there, 20 have a usable pose.
    assert (poses["num_images"], poses["num_registered"]) == (22, 20)
    assert poses["registered_ratio"] == pytest.approx(20 / 22, abs=1e-4)
    metrics = report["metrics"]
    assert metrics["psnr"] > 9.0
    assert 0.0 < metrics["ssim"] < 1.0
    assert metrics["num_images"] == len(metrics["per_image"]) == 5
    assert (metrics["width"], metrics["height"]) == (36, 64)
    assert metrics["protocol"]["name"] == "custom"
    assert metrics["protocol"]["split"] == "fraction 0.9"
    assert metrics["protocol"]["train_camera_optimizer"] == "so3xr3"
    assert metrics["protocol"]["train_appearance"] is True
    assert (metrics["lpips"], metrics["half_unseen"]) == (None, None)
    assert metrics["lpips_reason"]
    assert 0.0 <= metrics["floaters"]["near_mass"] <= 1.0
    assert metrics["floaters_reason"] is None
    ran = {"ingest", "train", "evaluate", "pointcloud", "mesh", "video"}
    assert set(report["timings"]) == {f"{name}_s" for name in ran}
    assert all(seconds > 0 for seconds in report["timings"].values())
    assert set(report["options"]) == ran
    assert report["options"]["train"]["max_steps"] == 400
    assert report["versions"]["torch"]
    assert {item["name"] for item in report["artifacts"]} == {
        "cameras.json",
        "model.zip",
        "pointcloud.ply",
        "mesh.glb",
        "mesh.ply",
        "video.mp4",
        "preview.jpg",
    }
    mesh = next(item for item in report["artifacts"] if item["name"] == "mesh.glb")
    content = (job.stage("mesh") / "mesh.glb").read_bytes()
    assert mesh["bytes"] == len(content)
    assert mesh["sha256"] == hashlib.sha256(content).hexdigest()


def test_poses_found_by_structure_from_motion_are_passed_on() -> None:
    manifest: dict[str, Any] = {"summary": {}, "timings": {"wall_s": 1.0}, "options": {}}
    found = {"num_images": 70, "num_registered": 63, "registered_ratio": 0.9, "num_points": 5}
    manifests = dict.fromkeys(("ingest", "frames", "train", "evaluate"), manifest)
    manifests["poses"] = {**manifest, "summary": found}
    report = build_report(manifests, CaptureRecord("video", "a.mp4", "00"))
    assert report["poses"]["num_registered"] == 63
    assert report["poses"]["registered_ratio"] == 0.9
    assert report["poses"]["num_points"] == 5
    assert "frames_s" in report["timings"]


def test_a_missing_stage_is_named(job: Workspace) -> None:
    with pytest.raises(ExportError, match="needs the result of evaluate"):
        tiny_job.run(job, "report")
