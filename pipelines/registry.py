"""The stages in order: the product's table of contents.

Stages are named by dotted path, so that the API can read this file without importing torch. Those
that export the trained scene come from `pipelines.exports.catalogue`. Which of them a capture has
no use for follows from what its importer brings; a preset may leave out more (`pipelines.options`).
"""

from __future__ import annotations

import importlib
from typing import Any

from pipelines.captures.catalogue import importer_of
from pipelines.captures.importer import Brings
from pipelines.exports.catalogue import EXPORTS, KINDS
from pipelines.exports.export import Export
from pipelines.stage import (
    CAPTURE_PAGE,
    CAPTURE_REPORT,
    Artifact,
    FailureExplainer,
    Stage,
    StageFunction,
)


def _export_stage(export: Export) -> Stage:
    """The stage that makes one export of the catalogue."""
    return Stage(
        name=export.kind,
        version=export.version,
        after=("train", *(kind for kind in export.reads if kind in KINDS)),
        reads=(*export.reads, "train"),
        run="pipelines.stages.export:run",
        options=export.options.__name__,
        needs_gpu=export.needs_gpu,
        time_limit_s=export.time_limit_s,
        artifacts=export.artifacts,
    )


_EXPLAINS = "pipelines.stages.check:write_failed_check"
"""What makes the capture report of a job that ends before `check` has."""

STAGES: tuple[Stage, ...] = (
    Stage(
        name="ingest",
        version=19,
        after=(),
        reads=(),
        run="pipelines.stages.ingest:run",
        options="IngestOptions",
        explains=_EXPLAINS,
        time_limit_s=1800.0,
    ),
    Stage(
        name="frames",
        version=9,
        after=("ingest",),
        reads=("ingest",),
        run="pipelines.stages.frames:run",
        options="FramesOptions",
        explains=_EXPLAINS,
        time_limit_s=3600.0,
    ),
    Stage(
        name="poses",
        version=23,
        after=("frames",),
        reads=("ingest", "frames"),
        run="pipelines.stages.poses:run",
        options="PosesOptions",
        explains=_EXPLAINS,
        time_limit_s=6 * 3600.0,
        stall_s=2 * 3600.0,  # one bundle adjustment of many pictures may be long and silent
    ),
    Stage(
        name="check",
        version=3,
        after=("poses",),
        reads=("ingest", "frames", "poses"),
        run="pipelines.stages.check:run",
        options="CheckOptions",
        time_limit_s=1800.0,
        artifacts=(
            Artifact(CAPTURE_REPORT, CAPTURE_REPORT, "application/json", "any text editor"),
            Artifact(CAPTURE_PAGE, CAPTURE_PAGE, "text/html", "any browser"),
        ),
    ),
    Stage(
        name="depth",
        version=20,
        after=("poses",),
        reads=("ingest", "frames", "poses"),
        run="pipelines.stages.depth:run",
        options="DepthOptions",
        explains=_EXPLAINS,
        needs_gpu=True,
        time_limit_s=6 * 3600.0,
        artifacts=(Artifact("depth.jpg", "depth.jpg", "image/jpeg", "any picture viewer"),),
    ),
    Stage(
        name="draft",
        version=10,
        after=("depth",),
        reads=("ingest", "frames", "poses", "depth"),
        run="pipelines.stages.draft:run",
        options="DraftOptions",
        time_limit_s=3600.0,
        artifacts=(
            Artifact("draft.glb", "draft.glb", "model/gltf-binary", "any glTF viewer, Blender"),
            Artifact("draft.jpg", "draft.jpg", "image/jpeg", "any picture viewer"),
        ),
    ),
    Stage(
        name="train",
        version=11,
        after=("depth",),
        reads=("ingest", "frames", "poses", "depth"),
        run="pipelines.stages.train:run",
        options="TrainOptions",
        needs_gpu=True,
        time_limit_s=24 * 3600.0,
        artifacts=(
            Artifact("cameras.json", "cameras.json", "application/json", "any text editor"),
            Artifact(
                "model.zip",
                "model.zip",
                "application/zip",
                "Python: load_model",
            ),
        ),
    ),
    Stage(
        name="evaluate",
        version=4,
        after=("train",),
        reads=("ingest", "frames", "depth", "train"),
        run="pipelines.stages.evaluate:run",
        options="EvaluateOptions",
        needs_gpu=True,
        time_limit_s=6 * 3600.0,
    ),
    *(_export_stage(export) for export in EXPORTS),
    Stage(
        name="assess",
        version=10,
        after=("evaluate", "pointcloud", "mesh"),
        reads=("ingest", "frames", "poses", "depth", "train", "evaluate", "pointcloud", "mesh"),
        run="pipelines.stages.assess:run",
        options="AssessOptions",
        time_limit_s=3600.0,
    ),
    Stage(
        name="report",
        version=4,
        after=("check", "draft", "evaluate", *KINDS, "assess"),
        reads=(
            "ingest",
            "frames",
            "poses",
            "check",
            "depth",
            "draft",
            "train",
            "evaluate",
            *KINDS,
            "assess",
        ),
        run="pipelines.stages.report:run",
        options="ReportOptions",
        time_limit_s=600.0,
        artifacts=(Artifact("report.json", "report.json", "application/json", "any text editor"),),
    ),
)

STAGE_NAMES: tuple[str, ...] = tuple(stage.name for stage in STAGES)
_BY_NAME = {stage.name: stage for stage in STAGES}

_SKIPPED: dict[Brings, frozenset[str]] = {
    "film": frozenset(),
    "photos": frozenset({"frames"}),
    "poses": frozenset({"frames"}),
}


def get_stage(name: str) -> Stage:
    """The stage of that name. Raises KeyError for an unknown one."""
    return _BY_NAME[name]


def skipped_stages(kind: str) -> frozenset[str]:
    """The stages that a capture of this kind has no use for. Raises KeyError for an unknown one."""
    return _SKIPPED[importer_of(kind).brings]


def load_function(stage: Stage) -> StageFunction:
    """Import the stage's code: call it only in the process that runs the stage."""
    function: StageFunction = _load(stage.run)
    return function


def load_explainer(stage: Stage) -> FailureExplainer | None:
    """Import what says more of the stage's failures, if anything does; where the stage runs."""
    explainer: FailureExplainer | None = _load(stage.explains) if stage.explains else None
    return explainer


def _load(dotted: str) -> Any:
    """What "module:function" names."""
    module_name, _, function_name = dotted.partition(":")
    return getattr(importlib.import_module(module_name), function_name)
