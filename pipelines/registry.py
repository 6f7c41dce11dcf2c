"""The stages in order: the product's table of contents.

Stages are named by dotted path, so that the API can read this file without importing torch.
"""

from __future__ import annotations

import importlib

from pipelines.stage import Artifact, Stage, StageFunction

STAGES: tuple[Stage, ...] = (
    Stage(
        name="ingest",
        version=1,
        after=(),
        reads=(),
        run="pipelines.stages.ingest:run",
        options="IngestOptions",
        time_limit_s=1800.0,
    ),
    Stage(
        name="frames",
        version=1,
        after=("ingest",),
        reads=("ingest",),
        run="pipelines.stages.frames:run",
        options="FramesOptions",
        time_limit_s=3600.0,
    ),
    Stage(
        name="poses",
        version=2,
        after=("frames",),
        reads=("ingest", "frames"),
        run="pipelines.stages.poses:run",
        options="PosesOptions",
        time_limit_s=6 * 3600.0,
    ),
    Stage(
        name="train",
        version=2,
        after=("poses",),
        reads=("ingest", "frames", "poses"),
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
        version=2,
        after=("train",),
        reads=("ingest", "frames", "train"),
        run="pipelines.stages.evaluate:run",
        options="EvaluateOptions",
        needs_gpu=True,
        time_limit_s=6 * 3600.0,
    ),
    Stage(
        name="pointcloud",
        version=1,
        after=("train",),
        reads=("train",),
        run="pipelines.stages.pointcloud:run",
        options="PointcloudOptions",
        needs_gpu=True,
        time_limit_s=6 * 3600.0,
        artifacts=(
            Artifact(
                "pointcloud.ply",
                "pointcloud.ply",
                "application/octet-stream",
                "MeshLab, CloudCompare, Blender",
            ),
        ),
    ),
    Stage(
        name="mesh",
        version=1,
        after=("train",),
        reads=("train",),
        run="pipelines.stages.mesh:run",
        options="MeshOptions",
        needs_gpu=True,
        time_limit_s=6 * 3600.0,
        artifacts=(
            Artifact("mesh.glb", "mesh.glb", "model/gltf-binary", "any glTF viewer, Blender"),
            Artifact(
                "mesh.ply", "mesh.ply", "application/octet-stream", "MeshLab, CloudCompare, Blender"
            ),
        ),
    ),
    Stage(
        name="video",
        version=1,
        after=("train",),
        reads=("train",),
        run="pipelines.stages.video:run",
        options="VideoOptions",
        needs_gpu=True,
        time_limit_s=6 * 3600.0,
        artifacts=(
            Artifact("video.mp4", "video.mp4", "video/mp4", "any browser or player"),
            Artifact("preview.jpg", "preview.jpg", "image/jpeg", "any picture viewer"),
        ),
    ),
    Stage(
        name="report",
        version=1,
        after=("evaluate", "pointcloud", "mesh", "video"),
        reads=(
            "ingest",
            "frames",
            "poses",
            "train",
            "evaluate",
            "pointcloud",
            "mesh",
            "video",
        ),
        run="pipelines.stages.report:run",
        options="ReportOptions",
        time_limit_s=600.0,
        artifacts=(Artifact("report.json", "report.json", "application/json", "any text editor"),),
    ),
)

STAGE_NAMES: tuple[str, ...] = tuple(stage.name for stage in STAGES)
_BY_NAME = {stage.name: stage for stage in STAGES}

POSED_KINDS: frozenset[str] = frozenset({"nerfstudio", "polycam", "record3d"})
"""Captures that carry camera poses: they skip `poses`."""


def get_stage(name: str) -> Stage:
    """The stage of that name. Raises KeyError for an unknown one."""
    return _BY_NAME[name]


def skipped_stages(kind: str) -> frozenset[str]:
    """The stages that a capture of this kind has no use for."""
    skipped: set[str] = set()
    if kind != "video":
        skipped.add("frames")
    if kind in POSED_KINDS:
        skipped.add("poses")
    return frozenset(skipped)


def load_function(stage: Stage) -> StageFunction:
    """Import the stage's code: call it only in the process that runs the stage."""
    module_name, _, function_name = stage.run.partition(":")
    function: StageFunction = getattr(importlib.import_module(module_name), function_name)
    return function
