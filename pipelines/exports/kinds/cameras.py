"""The cameras, as other programs read them: nerfstudio's layout, a COLMAP model, and a picture.

All in one frame, that of cameras.json unless another is asked for, with the poses that training
corrected. A format that cannot hold the capture's lenses is left out, and the summary says why.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from pipelines.errors import ExportError
from pipelines.exports.export import Export
from pipelines.exports.options import FrameOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.trained_scene import TrainedScene


class CamerasOptions(FrameOptions):
    """The cameras in the files of other programs."""


def run(scene: TrainedScene, options: CamerasOptions, ctx: StageContext) -> dict[str, Any]:
    """Write the three files."""
    # Imported where it runs: the API reads this file too.
    from pipelines.exports.formats import ply
    from pipelines.exports.formats.colmap import write_colmap
    from pipelines.exports.formats.transforms import write_transforms
    from pipelines.exports.placement import placement_of
    from pipelines.exports.surface.frusta import camera_frusta

    place = placement_of(options.frame, scene.cameras)
    cameras, frame = place.cameras(scene.cameras), place.frame()
    ctx.progress(0.0, "writing cameras")
    left_out: dict[str, str] = {}
    for name, write in (("transforms.json", write_transforms), ("colmap.zip", write_colmap)):
        try:
            write(ctx.out / name, cameras, frame)
        except ExportError as error:
            ctx.logger.warning("no %s: %s", name, error.message)
            left_out[name] = error.message
    ply.write_mesh(ctx.out / "cameras.ply", camera_frusta(cameras), frame)
    return {
        "frame": place.as_dict(),
        "num_images": len(cameras.images),
        "num_lenses": len(cameras.cameras),
        "left_out": left_out,
    }


EXPORT = Export(
    kind="cameras",
    version=3,
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
