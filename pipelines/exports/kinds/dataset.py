"""The capture as a data set, for other tools and for ours again: `dataset.zip`.

    transforms.json             nerfstudio's layout, each frame with its lens where they differ
    images/ masks/ depth/       as they were trained on; masks and depth where the capture has any
    sparse_pc.ply               sparse points, where structure from motion or the capture found some
    sparse/0/                   a COLMAP model of the same cameras and points

All in the world of cameras.json, with the poses that training corrected. Depth is 16-bit PNG, a
millimetre a count where the world is metric and it fits, else as fine as 16 bits hold:
depth_unit_scale_factor says which. A format that cannot hold the capture's lenses is left out, and
the summary says why.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipelines.errors import ExportError
from pipelines.exports.export import Export
from pipelines.option_models import StageOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pipelines.scene.cameras_file import CamerasFile
    from pipelines.scene.trained_scene import TrainedScene

_FILE = "dataset.zip"
_POINTS = "sparse_pc.ply"
_MEBIBYTE = 1 << 20


class DatasetOptions(StageOptions):
    """What of the capture is packed for other tools."""

    enabled: bool = Field(True, description="Whether dataset.zip is made.")
    max_mb: int = Field(
        1024,
        ge=0,
        le=1_000_000,
        description="How large pictures, masks and depth may be together. Where they are larger "
        "they stay out, and the report says so: cameras and points alone are packed. Unit: MiB.",
    )
    colmap: Literal["binary", "text", "none"] = Field(
        "binary", description="The form of the COLMAP model in it."
    )


def run(scene: TrainedScene, options: DatasetOptions, ctx: StageContext) -> dict[str, Any]:
    """Write `dataset.zip`, unless it is switched off.

    Raises ExportError (inputs_missing) where a picture is not there any more.
    """
    # Imported where it runs: the API reads this file too.
    import zipfile

    from pipelines.exports.formats.archive import entry
    from pipelines.exports.formats.colmap import model_files
    from pipelines.exports.formats.dataset import Packed, num_bytes, pack, store_file
    from pipelines.exports.formats.ply import read_ply
    from pipelines.exports.formats.transforms import transforms_text

    if not options.enabled:
        return {"left_out": {_FILE: "dataset.enabled is off"}}
    cameras, root = scene.cameras, ctx.workspace.images_root
    count = len(cameras.images)
    left_out: dict[str, str] = {}
    size_mb = num_bytes(cameras, root) / _MEBIBYTE
    if size_mb > options.max_mb:
        why = (
            f"pictures, masks and depth have {size_mb:.0f} MiB; dataset.max_mb is {options.max_mb}"
        )
        left_out["images/"] = why
    path = ctx.workspace.sparse_points
    cloud = read_ply(path) if path.is_file() else None
    with zipfile.ZipFile(ctx.out / _FILE, "w") as archive:
        packed = Packed(_bare(cameras))
        if not left_out:
            packed = pack(
                archive,
                cameras,
                root,
                lambda done: ctx.progress(done / (count + 1), f"picture {done} of {count}"),
            )
        if cloud is not None:
            store_file(archive, _POINTS, path)
        try:
            points = None if cloud is None else _POINTS
            text = transforms_text(packed.cameras, depth_unit=packed.depth_unit, points=points)
            archive.writestr(entry("transforms.json"), text)
        except ExportError as error:
            left_out["transforms.json"] = error.message
        if options.colmap != "none":
            try:
                known = () if cloud is None else (cloud.points, cloud.colors)
                for name, data in model_files(cameras, options.colmap, *known).items():
                    archive.writestr(entry(name), data)
            except ExportError as error:
                left_out["sparse/0/"] = error.message
    for what, why in left_out.items():
        ctx.logger.warning("no %s in %s: %s", what, _FILE, why)
    ctx.progress(1.0, f"{_FILE}: {count} frames", 0.0)
    return {
        "num_images": 0 if "images/" in left_out else count,
        "num_masks": packed.num_masks,
        "num_depths": packed.num_depths,
        "num_points": 0 if cloud is None else len(cloud.points),
        "bytes": (ctx.out / _FILE).stat().st_size,
        "left_out": left_out,
    }


def _bare(cameras: CamerasFile) -> CamerasFile:
    """The cameras without masks and depth, which are not in the archive."""
    images = tuple(replace(image, mask=None, depth=None) for image in cameras.images)
    return replace(cameras, images=images)


EXPORT = Export(
    kind="dataset",
    version=2,
    run=run,
    options=DatasetOptions,
    reads=("ingest", "frames", "poses"),
    needs_gpu=False,
    time_limit_s=3600.0,
    artifacts=(
        Artifact("dataset.zip", _FILE, "application/zip", "nerfstudio, COLMAP, gsplat, here"),
    ),
)
