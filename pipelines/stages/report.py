"""The report stage: `report.json`, the whole job in one file.

Fixed keys, for programs: capture.kind, poses.num_images, poses.num_registered,
poses.registered_ratio, metrics.psnr, metrics.ssim, metrics.num_images, metrics.width,
metrics.height, metrics.per_image[], metrics.protocol {name, split, fit_poses, fit_appearance,
train_camera_optimizer, train_appearance, description}, metrics.lpips and metrics.floaters (null
with a metrics.lpips_reason or metrics.floaters_reason where they were not measured),
timings.<stage>_s, options, versions, artifacts[] {name, bytes, sha256}. Everything else may grow.

All of it comes from the manifests of the stages before; nothing is measured here.
"""

from __future__ import annotations

import json
from typing import Any

from pipelines.captures.record import CaptureRecord
from pipelines.errors import ExportError
from pipelines.manifest import versions
from pipelines.options import ReportOptions
from pipelines.registry import STAGES
from pipelines.stage import StageContext
from pipelines.workspace import Workspace

REPORT_VERSION = 1

Manifests = dict[str, dict[str, Any]]


def run(options: ReportOptions, ctx: StageContext) -> dict[str, Any]:
    """Write `report.json`. The summary is its headline numbers. Raises ExportError for a missing
    manifest of a stage that every job has."""
    del options
    manifests = _manifests(ctx.workspace)
    for name in ("ingest", "train", "evaluate"):
        if name not in manifests:
            raise ExportError(
                f"The report needs the result of {name}, which is not there.",
                code="inputs_missing",
                hint=f"Run {name} first.",
            )
    report = build_report(manifests, CaptureRecord.load(ctx.workspace.stage("ingest")))
    (ctx.out / "report.json").write_text(json.dumps(report, indent=1), "utf-8")
    ctx.progress(1.0, "report written", 0.0)
    return {
        "capture_kind": report["capture"]["kind"],
        "registered_ratio": report["poses"]["registered_ratio"],
        "psnr": report["metrics"]["psnr"],
        "ssim": report["metrics"]["ssim"],
        "num_artifacts": len(report["artifacts"]),
    }


def _manifests(workspace: Workspace) -> Manifests:
    """Manifests of the stages before this one, skipped ones left out."""
    return {
        stage.name: workspace.manifest(stage.name)
        for stage in STAGES
        if stage.name != "report" and workspace.is_complete(stage.name)
    }


def build_report(manifests: Manifests, capture: CaptureRecord) -> dict[str, Any]:
    """The content of `report.json`."""
    evaluated = manifests["evaluate"]["summary"]
    return {
        "version": REPORT_VERSION,
        "capture": {
            "kind": capture.kind,
            "filename": capture.filename,
            "sha256": capture.sha256,
            "video": capture.video,
            "details": capture.details,
            "warnings": capture.warnings,
        },
        "poses": _poses(manifests, capture),
        "metrics": {
            key: evaluated.get(key)
            for key in (
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
        },
        "timings": {f"{name}_s": item["timings"]["wall_s"] for name, item in manifests.items()},
        "stages": {name: item["summary"] for name, item in manifests.items() if name != "evaluate"},
        "options": {name: item["options"] for name, item in manifests.items()},
        "versions": versions(),
        "seed": manifests["train"].get("seed"),
        "artifacts": _artifacts(manifests),
    }


def _poses(manifests: Manifests, capture: CaptureRecord) -> dict[str, Any]:
    """How many images there were and how many have a pose.

    With structure from motion, what it reports. Where the capture brought its poses: `num_images`
    counts the pictures that are in the capture, with a usable pose or not; entries of its listing
    without a picture are no images and appear in the capture's details and warnings.
    """
    if "poses" in manifests:
        found = manifests["poses"]["summary"]
        source = "structure from motion"
        num_images, num_registered = int(found["num_images"]), int(found["num_registered"])
    else:
        found, source = {}, "capture"
        trained = manifests["train"]["summary"]
        num_registered = int(trained["num_train"]) + int(trained["num_test"])
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
