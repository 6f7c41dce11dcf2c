"""The cameras, as other programs read them: nerfstudio's layout, a COLMAP model, and a picture.

All in the world frame of cameras.json, with the poses that training corrected. A format that cannot
hold the capture's lenses is left out, and the summary says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipelines.errors import ExportError
from pipelines.exports.export import Export
from pipelines.exports.frame import Frame
from pipelines.option_models import StageOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.trained_scene import TrainedScene


class CamerasOptions(StageOptions):
    """The cameras have no options."""


def run(scene: TrainedScene, options: CamerasOptions, ctx: StageContext) -> dict[str, Any]:
    """Write the three files."""
    # Imported where it runs: the API reads this file too.
    from pipelines.exports.formats import ply
    from pipelines.exports.formats.colmap import write_colmap
    from pipelines.exports.formats.transforms import write_transforms
    from pipelines.exports.surface.frusta import camera_frusta

    del options
    ctx.progress(0.0, "writing cameras")
    left_out: dict[str, str] = {}
    for name, write in (("transforms.json", write_transforms), ("colmap.zip", write_colmap)):
        try:
            write(ctx.out / name, scene.cameras)
        except ExportError as error:
            ctx.logger.warning("no %s: %s", name, error.message)
            left_out[name] = error.message
    frame = Frame(metric=scene.cameras.metric)
    ply.write_mesh(ctx.out / "cameras.ply", camera_frusta(scene.cameras), frame)
    return {
        "num_images": len(scene.cameras.images),
        "num_lenses": len(scene.cameras.cameras),
        "left_out": left_out,
    }


EXPORT = Export(
    kind="cameras",
    version=2,
    run=run,
    options=CamerasOptions,
    needs_gpu=False,
    time_limit_s=600.0,
    artifacts=(
        Artifact("transforms.json", "transforms.json", "application/json", "nerfstudio"),
        Artifact("colmap.zip", "colmap.zip", "application/zip", "COLMAP, gsplat"),
        Artifact(
            "cameras.ply",
            "cameras.ply",
            "application/octet-stream",
            "MeshLab, CloudCompare, Blender",
        ),
    ),
)
