"""The report: every fixed key, from the manifests of a whole tiny job."""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

import pytest

from pipelines.captures.record import CaptureRecord
from pipelines.errors import CaptureError, ExportError, PosesError
from pipelines.exports.catalogue import KINDS
from pipelines.stages.report import build_report, write_failed_report_locally
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


@pytest.fixture
def report(job: Workspace) -> dict[str, Any]:
    for stage in ("evaluate", *KINDS, "assess", "report"):
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
    assert metrics["num_images"] == len(metrics["per_image"]) == 3
    assert (metrics["width"], metrics["height"]) == (36, 64)
    assert metrics["protocol"]["name"] == "custom"
    assert metrics["protocol"]["split"] == "fraction 0.9"
    assert metrics["protocol"]["train_camera_optimizer"] == "so3xr3"
    assert metrics["protocol"]["train_appearance"] is True
    assert (metrics["lpips"], metrics["half_unseen"]) == (None, None)
    assert metrics["lpips_reason"]
    assert 0.0 <= metrics["floaters"]["near_mass"] <= 1.0
    assert metrics["floaters_reason"] is None
    assets = report["assets"]
    for name in ("mesh", "cloud"):
        assert 0.0 <= assets[name]["coverage"] <= 1.0
        assert assets[name]["psnr_with_holes"] > 0.0
        assert {"psnr", "ssim"} <= set(assets[name])
    assert assets["views"]["num_views"] == 3
    assert assets["depth_reason"]
    assert "warnings" not in assets
    assert assets["subject"] == report["stages"]["mesh"]["subject"]
    assert assets["subject"]["kind"] == "subject"
    for warning in report["warnings"]:
        assert warning["code"] in {"geometry_poor", "model_poor"}
    ran = {"ingest", "train", "evaluate", *KINDS, "assess"}
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
        "subject.glb",
        "subject.jpg",
        "video.mp4",
        "preview.jpg",
        "transforms.json",
        "colmap.zip",
        "cameras.ply",
        "dataset.zip",
        "views.zip",
        "mesh-video.mp4",
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
    given = {"verdict": "replaced", "why": "wrong"}
    manifests["poses"] = {**manifest, "summary": {**found, "given": given}}
    report = build_report(manifests, CaptureRecord("nerfstudio", "a.zip", "00"))
    assert report["poses"]["source"] == "structure from motion"
    assert report["poses"]["num_registered"] == 63
    assert report["poses"]["given"] == given


def test_structure_from_motion_is_not_metric_and_says_so() -> None:
    manifest: dict[str, Any] = {"summary": {}, "timings": {"wall_s": 1.0}, "options": {}}
    weak = {"code": "focal_length_weak", "message": "Weak.", "hint": "Walk.", "details": {}}
    found = {"num_images": 9, "num_registered": 9, "metric": False, "warnings": [weak]}
    manifests = {"ingest": manifest, "poses": {**manifest, "summary": found}}
    report = build_report(manifests, CaptureRecord("images", "a.zip", "00"))
    assert report["poses"]["metric"] is False
    assert report["warnings"] == [weak]
    posed = CaptureRecord("polycam", "a.zip", "00", details={"metric": True})
    assert build_report({"ingest": manifest}, posed)["poses"]["metric"] is True


def test_a_job_that_failed_in_poses_has_its_report(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    for name in ("ingest", "poses", "train"):
        workspace.stage(name).mkdir()
        manifest = {"summary": {"psnr": 30}, "timings": {"wall_s": 1.0}, "options": {}, "seed": 3}
        (workspace.stage(name) / "manifest.json").write_text(json.dumps(manifest))
    CaptureRecord("images", "a.zip", "00", num_images=9).save(workspace.stage("ingest"))
    said = {"num_images": 9, "num_registered": 2, "registered_ratio": 2 / 9, "metric": False}
    workspace.failed("poses").mkdir(parents=True)
    (workspace.failed("poses") / "report.json").write_text(
        json.dumps({**said, "advice": ["Move more slowly."], "attempts": [1, 2]})
    )
    error = PosesError("2 of 9 images registered.", code="too_few_registered").as_dict()
    path = write_failed_report_locally(workspace, "poses", error)
    report = json.loads(path.read_text())
    assert path == tmp_path / "report" / "report.json"
    assert not workspace.is_complete("report")
    assert report["state"] == "failed"
    assert (report["error"]["stage"], report["error"]["code"]) == ("poses", "too_few_registered")
    assert (report["poses"]["num_images"], report["poses"]["num_registered"]) == (9, 2)
    assert report["poses"]["advice"] == ["Move more slowly."]
    assert report["failed_report"]["attempts"] == [1, 2]
    assert set(report["timings"]) == {"ingest_s"}, "an earlier run's later stages do not count"
    assert report["metrics"]["psnr"] is None
    assert report["seed"] == 3


def test_a_job_that_failed_before_anything_has_its_report(tmp_path: Path) -> None:
    workspace = Workspace(tmp_path)
    workspace.job_file.write_text(json.dumps({"filename": "a.mp4", "kind": "video", "seed": 0}))
    error = CaptureError("It is cut off.", code="video_truncated").as_dict()
    path = write_failed_report_locally(workspace, "ingest", error)
    report = json.loads(path.read_text())
    assert report["capture"]["filename"] == "a.mp4"
    assert report["error"]["code"] == "video_truncated"
    assert report["failed_report"] is None
    assert report["poses"]["num_registered"] == 0


def test_warnings_stand_beside_the_assets_they_are_about() -> None:
    manifest: dict[str, Any] = {"summary": {}, "timings": {"wall_s": 1.0}, "options": {}}
    manifests = dict.fromkeys(("ingest", "train", "evaluate"), manifest)
    manifests["train"] = {**manifest, "summary": {"num_train": 9, "num_test": 1}}
    record = CaptureRecord("images", "a.zip", "00", num_images=10)
    assert build_report(manifests, record)["assets"] is None
    assert build_report(manifests, record)["warnings"] == []
    warning = {"code": "geometry_poor", "message": "m", "hint": "h", "details": {}}
    summary = {"mesh": {"coverage": 0.2}, "warnings": [warning]}
    report = build_report({**manifests, "assess": {**manifest, "summary": summary}}, record)
    assert report["assets"] == {"mesh": {"coverage": 0.2}}
    assert report["warnings"] == [warning]
    slow = {"code": "slow_engine", "message": "m", "hint": "h", "details": {}}
    manifests["train"] = {
        **manifest,
        "summary": {"num_train": 9, "num_test": 1, "warnings": [slow]},
    }
    report = build_report({**manifests, "assess": {**manifest, "summary": summary}}, record)
    assert report["warnings"] == [slow, warning]


def test_a_missing_stage_is_named(job: Workspace) -> None:
    with pytest.raises(ExportError, match="needs the result of evaluate"):
        tiny_job.run(job, "report")


@pytest.fixture
def untrained(tmp_path: Path) -> Workspace:
    """A posed capture of 20 pictures with a draft; nothing was trained."""
    workspace = Workspace(tmp_path)
    summaries: dict[str, dict[str, Any]] = {
        "ingest": {"kind": "polycam"},
        "depth": {"num_maps": 20},
        "draft": {"num_faces": 777},
    }
    for name, summary in summaries.items():
        workspace.stage(name).mkdir()
        manifest = {"content": name, "summary": summary, "timings": {"wall_s": 1.0}, "options": {}}
        files = [{"path": "draft.glb", "bytes": 5, "sha256": "00"}] if name == "draft" else []
        text = json.dumps({**manifest, "files": files})
        (workspace.stage(name) / "manifest.json").write_text(text)
    details = {"num_posed": 20, "num_frames": 20, "num_without_pose": 2, "metric": True}
    CaptureRecord("polycam", "a.zip", "00", details=details).save(workspace.stage("ingest"))
    return workspace


def test_a_job_that_trains_nothing_says_so_in_its_report(untrained: Workspace) -> None:
    manifest = tiny_job.run(untrained, "report")
    report = json.loads((untrained.stage("report") / "report.json").read_text())
    assert (report["state"], report["error"]) == ("succeeded", None)
    assert (report["metrics"], report["assets"]) == (None, None)
    assert "Nothing was trained" in report["metrics_reason"]
    assert "not compared with photos" in report["assets_reason"]
    assert (report["poses"]["num_images"], report["poses"]["num_registered"]) == (22, 20)
    assert report["stages"]["draft"] == {"num_faces": 777}
    assert set(report["timings"]) == {"ingest_s", "depth_s", "draft_s"}
    assert report["artifacts"] == [{"name": "draft.glb", "bytes": 5, "sha256": "00"}]
    assert manifest["summary"]["num_artifacts"] == 1
    assert "psnr" not in manifest["summary"]


def test_a_report_needs_a_draft_where_nothing_was_trained(untrained: Workspace) -> None:
    (untrained.stage("draft") / "manifest.json").unlink()
    with pytest.raises(ExportError, match="needs the result of draft"):
        tiny_job.run(untrained, "report")
