"""The capture as a data set, for other tools and for ours again: `dataset.zip`.

    transforms.json             nerfstudio's layout, each frame with its lens where they differ
    images/ masks/ depth/       as they were trained on; masks and depth where the capture has any
    sparse_pc.ply               sparse points, where structure from motion or the capture found some
    sparse/0/                   a COLMAP model of the same cameras and points
    frame.txt                   where they lie, if not in the world of cameras.json

All in one frame, that of cameras.json unless another is asked for, with the poses that training
corrected. Depth is 16-bit PNG, a millimetre a count where the world is metric and it fits, else as
fine as 16 bits hold: depth_unit_scale_factor says which. A format that cannot hold the capture's
lenses is left out, and the summary says why.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field

from pipelines.errors import ExportError
from pipelines.exports.export import Export
from pipelines.exports.options import FrameOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from pathlib import Path
    from zipfile import ZipFile

    from pipelines.exports.formats.dataset import Packed
    from pipelines.exports.formats.ply import Ply
    from pipelines.exports.placement import Placement
    from pipelines.scene.cameras_file import CamerasFile
    from pipelines.scene.trained_scene import TrainedScene

_FILE = "dataset.zip"
_POINTS = "sparse_pc.ply"
_MEBIBYTE = 1 << 20


class DatasetOptions(FrameOptions):
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
    import tempfile
    import zipfile
    from pathlib import Path

    from pipelines.exports.formats.dataset import Packed, num_bytes, pack, store_file
    from pipelines.exports.placement import placement_of

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
    place = placement_of(options.frame, cameras)
    with (
        tempfile.TemporaryDirectory(dir=ctx.out, prefix=".points-") as folder,
        zipfile.ZipFile(ctx.out / _FILE, "w") as archive,
    ):
        path, cloud = _sparse(ctx.workspace.sparse_points, place, Path(folder))
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
        left_out |= _write_poses(archive, packed, cloud, place, options)
    for what, why in left_out.items():
        ctx.logger.warning("no %s in %s: %s", what, _FILE, why)
    ctx.progress(1.0, f"{_FILE}: {count} frames", 0.0)
    return {
        "frame": place.as_dict(),
        "num_images": 0 if "images/" in left_out else count,
        "num_masks": packed.num_masks,
        "num_depths": packed.num_depths,
        "num_points": 0 if cloud is None else len(cloud.points),
        "bytes": (ctx.out / _FILE).stat().st_size,
        "left_out": left_out,
    }


def _sparse(path: Path, place: Placement, folder: Path) -> tuple[Path, Ply | None]:
    """The sparse points in the frame, and the file that holds them; None where there are none."""
    import numpy as np

    from pipelines.exports.formats.ply import read_ply, write_points

    cloud = read_ply(path) if path.is_file() else None
    if cloud is None or place.similarity is None:
        return path, cloud
    points = place.points(cloud.points.astype(np.float64))
    moved = folder / _POINTS
    write_points(moved, points, cloud.colors, None, place.frame())
    return moved, read_ply(moved)


def _write_poses(
    archive: ZipFile, packed: Packed, cloud: Ply | None, place: Placement, options: DatasetOptions
) -> dict[str, str]:
    """`transforms.json` and the COLMAP model. What is left out, and why."""
    from pipelines.exports.formats.archive import entry
    from pipelines.exports.formats.colmap import frame_file, model_files
    from pipelines.exports.formats.transforms import transforms_text

    left_out = {}
    cameras, frame = place.cameras(packed.cameras), place.frame()
    unit = None if packed.depth_unit is None else place.scale * packed.depth_unit
    try:
        points = None if cloud is None else _POINTS
        text = transforms_text(cameras, depth_unit=unit, points=points, frame=frame)
        archive.writestr(entry("transforms.json"), text)
    except ExportError as error:
        left_out["transforms.json"] = error.message
    for name, data in frame_file(frame).items():
        archive.writestr(entry(name), data)
    if options.colmap != "none":
        try:
            known = () if cloud is None else (cloud.points, cloud.colors)
            for name, data in model_files(cameras, options.colmap, *known).items():
                archive.writestr(entry(name), data)
        except ExportError as error:
            left_out["sparse/0/"] = error.message
    return left_out


def _bare(cameras: CamerasFile) -> CamerasFile:
    """The cameras without masks and depth, which are not in the archive."""
    images = tuple(replace(image, mask=None, depth=None) for image in cameras.images)
    return replace(cameras, images=images)


EXPORT = Export(
    kind="dataset",
    version=3,
    run=run,
    options=DatasetOptions,
    reads=("ingest", "frames", "poses"),
    needs_gpu=False,
    time_limit_s=3600.0,
    artifacts=(
        Artifact("dataset.zip", _FILE, "application/zip", "nerfstudio, COLMAP, gsplat, here"),
    ),
)
