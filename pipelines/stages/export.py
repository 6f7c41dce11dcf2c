"""The stage of every export: the trained scene, handed to what the catalogue names.

Reads `train/model.zip`. What is written, and from which options, is in `pipelines.exports.kinds`.
"""

from __future__ import annotations

import importlib
import pkgutil
from typing import Any

import pipelines.exports
from pipelines.exports.catalogue import get_export
from pipelines.exports.options import RenderingOptions, render_config
from pipelines.option_models import StageOptions
from pipelines.scene.trained_scene import TrainedScene
from pipelines.stage import StageContext


def run(options: StageOptions, ctx: StageContext) -> dict[str, Any]:
    """Make the export that has the stage's name. Raises ExportError and what the export raises."""
    config = render_config(options) if isinstance(options, RenderingOptions) else None
    scene = TrainedScene.load(ctx.workspace.stage("train") / "model.zip", config, ctx.memory_share)
    return get_export(ctx.stage).run(scene, options, ctx)


def preload() -> None:
    """Load what exports import only when they run, for idle moments."""
    for found in pkgutil.walk_packages(pipelines.exports.__path__, "pipelines.exports."):
        importlib.import_module(found.name)
