"""Stage `check`: how the capture was filmed, and what to do better next time.

Writes `capture-report.json` and `capture-report.html` (`pipelines.filming`). It needs no training
and changes nothing: jobs run it beside what follows the poses, and preset `check` runs little else.
Of a job that fails before it, `write_failed_check` makes the same from what there is.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from pipelines.filming.findings import Thresholds
from pipelines.filming.page import build_page
from pipelines.filming.report import build_report
from pipelines.filming.shots import read_take
from pipelines.options import CheckOptions
from pipelines.stage import CAPTURE_PAGE, CAPTURE_REPORT, StageContext
from pipelines.workspace import Workspace

_SUMMARY = ("verdict", "reasons", "advice")
"""What ends in the job's view and in its report, however the job ends."""


def run(options: CheckOptions, ctx: StageContext) -> dict[str, Any]:
    """Write the capture report. The summary is its verdict, reasons and advice."""

    def on_picture(done: int, total: int) -> None:
        ctx.progress(0.9 * done / max(total, 1), f"looked at picture {done} of {total}")

    report = write_check(ctx.workspace, ctx.out, options, on_picture=on_picture)
    ctx.progress(1.0, f"the capture is {report['verdict']}", 0.0)
    return {
        **{key: report[key] for key in _SUMMARY},
        "findings": [one["code"] for one in report["findings"]],
        "lost_s": report["lost"]["seconds"],
        "covered_deg": report["around"] and report["around"]["covered_deg"],
    }


def write_check(
    workspace: Workspace,
    folder: Path,
    options: CheckOptions,
    error: Mapping[str, Any] | None = None,
    on_picture: Callable[[int, int], None] = lambda done, total: None,
) -> dict[str, Any]:
    """Write both files into a folder, from whatever a job's folder holds. Returns the report.

    error: what ended the job, `{stage, code, message, hint, details}`.
    """
    take, paths = read_take(workspace, error, on_picture)
    report = build_report(take, Thresholds(options.good_ratio, options.usable_ratio))
    folder.mkdir(parents=True, exist_ok=True)
    (folder / CAPTURE_REPORT).write_text(json.dumps(report, indent=1), "utf-8")
    page = build_page(take, report, paths, options.num_pictures)
    (folder / CAPTURE_PAGE).write_text(page, "utf-8")
    return report


def write_failed_check(
    workspace: Workspace, stage: str, error: Mapping[str, Any]
) -> dict[str, Any]:
    """The same of a job that ends with the error of a stage, beside what that stage left.

    error: as `PipelineError.as_dict` gives it. Returns verdict, reasons and advice. Where `check`
    has succeeded its report stands.
    """
    if workspace.is_complete("check"):
        kept: dict[str, Any] = workspace.manifest("check")["summary"]
        return {key: kept[key] for key in _SUMMARY}
    failed = {**error, "stage": stage}
    report = write_check(workspace, workspace.failed(stage), CheckOptions(), failed)
    return {key: report[key] for key in _SUMMARY}
