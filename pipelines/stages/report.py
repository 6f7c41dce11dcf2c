"""The report stage: `report.json`, the whole job in one file.

Fixed keys, for programs: state (succeeded, failed), error (null, or stage, code, message, hint,
details), capture.kind, poses.num_images, poses.num_registered, poses.registered_ratio, poses.metric
(whether one unit is a metre; null where that is unknown), check {verdict, reasons, advice} (how the
capture was filmed; null where nobody looked), metrics.psnr, metrics.ssim,
metrics.num_images, metrics.width, metrics.height, metrics.per_image[], metrics.protocol
{name, split, fit_poses, fit_appearance, train_camera_optimizer, train_appearance, description},
metrics.lpips and metrics.floaters (null with a metrics.lpips_reason or
metrics.floaters_reason where they were not measured),
assets.mesh and assets.cloud {coverage, psnr, ssim, psnr_with_holes}, assets.depth_agreement and
assets.depth (null with a reason), assets.views {held_out, num_views, width, height, note},
assets.subject {kind, why, measures, file, region, world_from_subject} (null where mesh.extent or a
crop leaves nothing to decide),
warnings[] {code, message, hint, details},
timings.<stage>_s, options, versions, artifacts[] {name, bytes, sha256}. Everything else may grow.

metrics and assets are null, with a metrics_reason and an assets_reason, where nothing was trained.
All of it comes from the manifests of the stages before; nothing is measured here.

A job that failed has a report.json, too (`write_failed_report`): what its stages found before one
failed, that one's error, and under failed_report what it said itself; metrics are null then.
"""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from pipelines.captures.record import CAPTURE_JSON, CaptureRecord
from pipelines.errors import ExportError
from pipelines.manifest import versions
from pipelines.options import ReportOptions
from pipelines.registry import STAGE_NAMES, STAGES
from pipelines.stage import CAPTURE_PAGE, CAPTURE_REPORT, POSES_REPLACED, REPORT, StageContext
from pipelines.workspace import MANIFEST, Workspace

REPORT_VERSION = 1

_METRICS = (
    "psnr",
    "ssim",
    "lpips",
    "lpips_reason",
    "lpips_backbone",
    "num_images",
    "width",
    "height",
    "protocol",
    "half_unseen",
    "floaters",
    "floaters_reason",
    "per_image",
)
_WARNING = ("poses", "train", "assess")
"""Stages whose warnings have a code: those of a capture stand with it."""
_LONG = ("images", "placed")
"""What a failed stage says of each picture: that is in the capture report, drawn."""
_NOTHING_TRAINED: dict[str, Any] = {
    "metrics": None,
    "metrics_reason": "Nothing was trained: there are no held-out numbers.",
    "assets": None,
    "assets_reason": "The mesh, if there is one, is the draft, from depth maps alone; it was not "
    "compared with photos.",
}

Manifests = dict[str, dict[str, Any]]


def run(options: ReportOptions, ctx: StageContext) -> dict[str, Any]:
    """Write `report.json`. The summary is its headline numbers. Raises ExportError for a missing
    manifest of a stage that every job has, or every one that trains, drafts, or only checks.
    """
    del options
    manifests = manifests_of(ctx.workspace)
    last = "evaluate" if "train" in manifests else "draft" if "depth" in manifests else "check"
    for name in ("ingest", last):
        if name not in manifests:
            raise ExportError(
                f"The report needs the result of {name}, which is not there.",
                code="inputs_missing",
                hint=f"Run {name} first.",
            )
    capture = CaptureRecord.load(ctx.workspace.stage("ingest"))
    report = build_report(manifests, capture, trains="train" in manifests)
    (ctx.out / REPORT).write_text(json.dumps(report, indent=1), "utf-8")
    ctx.progress(1.0, "report written", 0.0)
    return {
        "capture_kind": report["capture"]["kind"],
        "registered_ratio": report["poses"]["registered_ratio"],
        **({key: report["metrics"][key] for key in ("psnr", "ssim")} if report["metrics"] else {}),
        "num_warnings": len(report["warnings"]),
        "num_artifacts": len(report["artifacts"]),
    }


def manifests_of(workspace: Workspace) -> Manifests:
    """Manifests of the stages before this one, skipped ones left out."""
    return {
        stage.name: workspace.manifest(stage.name)
        for stage in STAGES
        if stage.name != "report" and workspace.is_complete(stage.name)
    }


def build_report(
    manifests: Manifests, capture: CaptureRecord, *, trains: bool = True
) -> dict[str, Any]:
    """The content of `report.json`, of a job whose stages all succeeded so far.

    trains: whether training is among the job's stages; without it there is nothing to measure.
    """
    return {
        "version": REPORT_VERSION,
        "state": "succeeded",
        "error": None,
        "capture": {
            "kind": capture.kind,
            "filename": capture.filename,
            "sha256": capture.sha256,
            "video": capture.video,
            "details": capture.details,
            "warnings": capture.warnings,
        },
        "poses": _poses(manifests, capture),
        "check": check_of(manifests.get("check", {}).get("summary")),
        **(_quality(manifests) if trains else _NOTHING_TRAINED),
        "warnings": [
            warning
            for name in _WARNING
            for warning in manifests.get(name, {}).get("summary", {}).get("warnings", [])
        ],
        "timings": {f"{name}_s": item["timings"]["wall_s"] for name, item in manifests.items()},
        "stages": {
            name: item["summary"]
            for name, item in manifests.items()
            if name not in ("check", "evaluate", "assess")
        },
        "options": {name: item["options"] for name, item in manifests.items()},
        "versions": versions(),
        "seed": next((item.get("seed") for item in manifests.values()), None),
        "artifacts": _artifacts(manifests),
    }


def check_of(found: Mapping[str, Any] | None) -> dict[str, Any] | None:
    """What a summary of `check` says of how the capture was filmed."""
    return None if not found else {key: found[key] for key in ("verdict", "reasons", "advice")}


def _quality(manifests: Manifests) -> dict[str, Any]:
    """What `evaluate` and `assess` measured, as far as they did."""
    evaluated = manifests.get("evaluate", {}).get("summary", {})
    assessed = manifests.get("assess", {}).get("summary", {})
    assets = {key: value for key, value in assessed.items() if key != "warnings"}
    meshed = manifests.get("mesh", {}).get("summary", {})
    if assets and "subject" in meshed:
        assets["subject"] = meshed["subject"]
    return {
        "metrics": {key: evaluated.get(key) for key in _METRICS},
        "assets": assets or None,
    }


def _poses(manifests: Manifests, capture: CaptureRecord) -> dict[str, Any]:
    """How many images there were and how many have a pose.

    With structure from motion, what it reports, also where that replaced given poses. Where the
    capture brought its poses (`given` tells how well they fit): `num_images` counts the pictures
    that are in the capture, with a usable pose or not; entries of its listing without a picture are
    no images and appear in the capture's details and warnings.
    """
    judged = manifests.get("poses", {}).get("summary", {})
    if judged and judged.get("given", {}).get("verdict", POSES_REPLACED) == POSES_REPLACED:
        found = judged
        source = "structure from motion"
        num_images, num_registered = int(found["num_images"]), int(found["num_registered"])
    else:
        found, source = {"metric": capture.details.get("metric")}, "capture"
        if judged:
            found["given"] = judged["given"]
        if "train" in manifests:
            trained = manifests["train"]["summary"]
            num_registered = int(trained.get("num_train", 0)) + int(trained.get("num_test", 0))
        else:
            num_registered = int(capture.details.get("num_posed", 0))
        num_images = max(num_registered, _pictures_in(capture))
    return {
        **found,
        "source": source,
        "num_images": num_images,
        "num_registered": num_registered,
        "registered_ratio": round(num_registered / num_images, 4) if num_images else 0.0,
    }


def _pictures_in(capture: CaptureRecord) -> int:
    """Pictures that a posed capture holds, from what its reader counted."""
    details = capture.details
    if "num_listed" in details:
        return int(details["num_listed"]) - int(details.get("num_missing", 0))
    counted = int(details.get("num_frames", 0)) + int(details.get("num_without_pose", 0))
    return max(counted, len(capture.images))


def _artifacts(manifests: Manifests) -> list[dict[str, Any]]:
    """Name, size and hash of the registry's artifacts that are there, except the report."""
    found = []
    for stage in STAGES:
        files = {item["path"]: item for item in manifests.get(stage.name, {}).get("files", [])}
        for artifact in stage.artifacts:
            if artifact.path in files:
                item = files[artifact.path]
                found.append(
                    {"name": artifact.name, "bytes": item["bytes"], "sha256": item["sha256"]}
                )
    return found


def write_failed_report(
    path: Path,
    workspace: Workspace,
    manifests: Manifests,
    stage: str,
    error: Mapping[str, Any],
) -> None:
    """Write `report.json` of a job that ends with the error of a stage.

    manifests: of the stages that succeeded. error: as `PipelineError.as_dict` gives it.
    """
    own = workspace.failed(stage) / REPORT
    said = json.loads(own.read_text("utf-8")) if own.is_file() else None
    report = build_report(manifests, _capture_of(workspace))
    if stage == "poses" and said is not None:
        report["poses"] = {
            key: said[key] for key in ("num_images", "num_registered", "registered_ratio", "metric")
        } | {"source": "structure from motion", "advice": said["advice"]}
    shown = {key: error[key] for key in ("code", "message", "hint", "details") if key in error}
    if report["check"] is None:
        left = workspace.failed(stage) / CAPTURE_REPORT
        found = json.loads(left.read_text("utf-8")) if left.is_file() else None
        report["check"] = check_of(error.get("details", {}).get("check") or found)
    if said is not None:
        said = {key: value for key, value in said.items() if key not in _LONG}
    report |= {"state": "failed", "error": {"stage": stage, **shown}, "failed_report": said}
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_name(f".{path.name}-{secrets.token_hex(4)}")
    draft.write_text(json.dumps(report, indent=1), "utf-8")
    draft.replace(path)


def keep_capture_report(workspace: Workspace, stage: str, folder: Path) -> None:
    """Copy the capture report that a failed stage left, if it did, into a folder."""
    for name in (CAPTURE_REPORT, CAPTURE_PAGE):
        (folder / name).unlink(missing_ok=True)
        if (workspace.failed(stage) / name).is_file():
            shutil.copyfile(workspace.failed(stage) / name, folder / name)


def write_failed_report_locally(workspace: Workspace, stage: str, error: Mapping[str, Any]) -> Path:
    """The same for a job on a local folder, as `report/report.json` without a manifest.

    What stands behind the failed stage is left out: it belongs to an earlier run.
    """
    folder = workspace.stage("report")
    (folder / MANIFEST).unlink(missing_ok=True)
    before = STAGE_NAMES[: STAGE_NAMES.index(stage)]
    manifests = {name: item for name, item in manifests_of(workspace).items() if name in before}
    write_failed_report(folder / REPORT, workspace, manifests, stage, error)
    keep_capture_report(workspace, stage, folder)
    return folder / REPORT


def _capture_of(workspace: Workspace) -> CaptureRecord:
    """What ingest found; where that is not here, what the job was told of the upload."""
    if (workspace.stage("ingest") / CAPTURE_JSON).is_file():
        return CaptureRecord.load(workspace.stage("ingest"))
    job = {"kind": "", "filename": ""}
    if workspace.job_file.is_file():
        job |= json.loads(workspace.job_file.read_text("utf-8"))
    return CaptureRecord(str(job["kind"]), str(job["filename"]), "")
