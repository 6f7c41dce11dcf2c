"""What an export is: it turns a trained scene and its options into files that people download.

An export is one file in `pipelines.exports.kinds`, which holds its options and its record, and one
line in `pipelines.exports.catalogue`. The registry makes a stage of each. Light: the API reads
records and options, so whatever needs torch, numpy or open3d is imported where an export runs.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

from pipelines.option_models import StageOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.trained_scene import TrainedScene

ExportFunction = Callable[["TrainedScene", Any, StageContext], dict[str, Any]]
"""`(scene, options, ctx) -> summary`: writes the artifacts below `ctx.out`."""


@dataclass(frozen=True)
class Export:
    """One kind of export.

    kind: its name, which is also that of its stage, its folder and its options' prefix.
    version: raised when the same scene and options give another result.
    run: see `ExportFunction`. options: their class; `RenderingOptions` where it renders.
    artifacts: what it writes; one that a scene has no use for may be missing.
    on_request: whether jobs skip it unless they have options for it.
    reads: stages whose folders it reads besides that of `train`: of what lies before training, or
        other exports, for which it waits.
    needs_gpu, time_limit_s: as in `pipelines.stage.Stage`.
    """

    kind: str
    version: int
    run: ExportFunction
    options: type[StageOptions]
    artifacts: tuple[Artifact, ...]
    reads: tuple[str, ...] = ()
    on_request: bool = False
    needs_gpu: bool = True
    time_limit_s: float = 6 * 3600.0
