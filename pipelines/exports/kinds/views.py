"""What training cameras, or those of a path, see, as numbers, in one zip: depth and normals beside
the colours.

Undistorted views of the trained scene from the corrected poses, `transforms.json` with their lenses
and poses in nerfstudio's layout. Depth is z, along the camera's axis: 16-bit PNG in whole steps of
a stated unit, and OpenEXR in world units, as channel Z and as the three colours of a picture, which
programs show that know no Z. Normals are in the camera's axes (x right, y up, z to
the camera): a picture, and OpenEXR. 0 is unknown.
"""

from __future__ import annotations

import json
import tempfile
import time
import zipfile
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from pydantic import Field, field_validator, model_validator

from pipelines.exports.export import Export
from pipelines.exports.options import RenderingOptions
from pipelines.exports.paths.options import PathOptions
from pipelines.stage import Artifact, StageContext

if TYPE_CHECKING:
    from collections.abc import Iterable

    import numpy as np
    from numpy.typing import NDArray

    from pipelines.scene.depth_views import DepthView, Pinhole
    from pipelines.scene.trained_scene import TrainedScene

    _Camera = tuple[Pinhole, NDArray[np.float64], str | None]

Content = Literal["rgb", "depth", "normals"]
Format = Literal["png", "exr"]

_MILLIMETRE = 0.001


class ViewsOptions(RenderingOptions, PathOptions):
    """Depth, normals and colours of training cameras, or along a camera path."""

    contents: tuple[Content, ...] = Field(
        ("rgb", "depth", "normals"),
        min_length=1,
        max_length=3,
        description="What is written of each view: rgb, depth, normals.",
    )
    formats: tuple[Format, ...] = Field(
        ("png", "exr"),
        min_length=1,
        max_length=2,
        description="png: depth in 16 bits, normals as a picture; exr: both as they are. Colours "
        "are always png.",
    )
    depth_unit: float | None = Field(
        None,
        gt=0,
        le=1e3,
        description="A step of the PNG's depth, in the world's unit; null for a millimetre where "
        "the world is metric, else the least power of ten with which the farthest depth fits.",
    )
    cameras: Literal["training", "path"] = Field(
        "training", description="Whose views: the training cameras', or those along the path."
    )
    num_views: int = Field(
        0, ge=0, le=5000, description="Training views written, evenly picked; 0 for all."
    )
    num_frames: int = Field(
        120,
        ge=2,
        le=5000,
        description="Views along the path, where it is no camera_path, which has its own number.",
    )
    long_side_px: int = Field(
        640, ge=16, le=8192, description="Long side of the pictures, in pixels."
    )

    @field_validator("contents", "formats")
    @classmethod
    def _each_once(cls, values: tuple[str, ...]) -> tuple[str, ...]:
        return tuple(dict.fromkeys(values))

    @classmethod
    def understood(
        cls, base: dict[str, Any], given: dict[str, Any]
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """As in StageOptions: who asks for a path asks for the views along it."""
        base, given = super().understood(base, given)
        return base, {"cameras": "path", **given} if "path" in given else given

    @model_validator(mode="after")
    def _is_perspective(self) -> ViewsOptions:
        if self.camera_path is not None and self.camera_path.camera_type != "perspective":
            raise ValueError(
                f"views are perspective; the camera_path is {self.camera_path.camera_type}"
            )
        return self


def run(scene: TrainedScene, options: ViewsOptions, ctx: StageContext) -> dict[str, Any]:
    """Render and write the views."""
    # Imported where it runs: the API reads this file too.
    from pipelines.exports.formats.archive import entry
    from pipelines.exports.formats.depth_pictures import unit_of

    if options.cameras == "path":
        cameras = _path_cameras(scene, options, ctx.workspace.stage("mesh"))
    else:
        cameras = _training_cameras(scene, options)
    unit = options.depth_unit
    if unit is None and scene.cameras.metric:
        unit = _MILLIMETRE
    if unit is None:
        ctx.progress(0.0, "looking for the range of depths")
        unit = unit_of(scene.probe_views(ctx.check_cancelled))
    frames: list[dict[str, Any]] = []
    num_beyond, started = 0, time.monotonic()
    with (
        tempfile.TemporaryDirectory(dir=ctx.out, prefix=".views-") as folder,
        zipfile.ZipFile(ctx.out / "views.zip", "w") as archive,
    ):
        for done, (lens, pose, of) in enumerate(cameras, start=1):
            files, beyond = _write(
                scene.depth_view(lens, pose), f"{done:05d}", Path(folder), options, unit
            )
            for name, path in files.items():
                archive.writestr(entry(name, compressed=False), path.read_bytes())
                path.unlink()
            num_beyond += beyond
            frames.append(_frame(lens, pose, of, files))
            eta = (time.monotonic() - started) / done * (len(cameras) - done)
            ctx.progress(done / len(cameras), f"view {done}/{len(cameras)}", eta)
        archive.writestr(entry("transforms.json"), _transforms(frames, unit, scene))
    if num_beyond:
        ctx.logger.warning(
            "%d depths are too far for 16 bits in steps of %g and are unknown in the PNG files; "
            "OpenEXR has them, and so does a larger views.depth_unit.",
            num_beyond,
            unit,
        )
    return {
        "num_views": len(frames),
        "depth_unit": unit,
        "metric": scene.cameras.metric,
        "num_pixels_beyond_png": num_beyond,
        "contents": list(options.contents),
        "formats": list(options.formats),
    }


def _training_cameras(scene: TrainedScene, options: ViewsOptions) -> list[_Camera]:
    """Those of the training images, freed of their distortion, and the images' names."""
    import numpy as np

    from pipelines.scene.depth_views import Pinhole

    return [
        (
            Pinhole.of(scene.lens_of(image), options.long_side_px),
            np.asarray(image.world_from_camera, np.float64),
            image.file,
        )
        for image in scene.training_images(options.num_views)
    ]


def _path_cameras(scene: TrainedScene, options: ViewsOptions, mesh: Path) -> list[_Camera]:
    """Those of the path's frames. mesh: its folder. Raises ExportError as the path does."""
    from pipelines.exports.paths.flight import lens_of_size, make_path, typical_lens
    from pipelines.scene.depth_views import Pinhole

    images = scene.cameras.images
    own = typical_lens([scene.lens_of(image) for image in images])
    lens, count = Pinhole.of(own, options.long_side_px), options.num_frames
    if options.path == "camera_path" and options.camera_path is not None:
        file = options.camera_path
        lens, count = lens_of_size(own, file.render_width, file.render_height), file.frames()
    flight = make_path(options, images, count, mesh)
    return [(flight.lens(index, lens), pose, None) for index, pose in enumerate(flight.poses)]


def _write(
    view: DepthView, name: str, folder: Path, options: ViewsOptions, unit: float
) -> tuple[dict[str, Path], int]:
    """One view's files by their names in the zip, and how many depths the PNG cannot hold."""
    from PIL import Image

    from pipelines.exports import shades
    from pipelines.exports.formats import depth_pictures

    files: dict[str, Path] = {}

    def place(content: Content, ending: Format) -> Path:
        files[f"{content}/{name}.{ending}"] = folder / f"{content}-{name}.{ending}"
        return files[f"{content}/{name}.{ending}"]

    beyond = 0
    if "rgb" in options.contents:
        Image.fromarray(view.rgb).save(place("rgb", "png"))
    if "depth" in options.contents and "png" in options.formats:
        beyond = depth_pictures.write_png(place("depth", "png"), view.z_depth, unit)
    if "depth" in options.contents and "exr" in options.formats:
        depth_pictures.write_exr(place("depth", "exr"), depth_pictures.as_seen(view.z_depth))
    if "normals" in options.contents:
        normals = shades.normals_of(view)
        if "png" in options.formats:
            Image.fromarray(shades.normals_picture(normals)).save(place("normals", "png"))
        if "exr" in options.formats:
            channels = {axis: normals[..., index] for index, axis in enumerate("XYZ")}
            depth_pictures.write_exr(place("normals", "exr"), channels)
    return files, beyond


def _frame(
    lens: Pinhole, pose: NDArray[np.float64], of: str | None, files: Iterable[str]
) -> dict[str, Any]:
    """The entry of `transforms.json` for one view. of: the image that its camera took."""
    names = sorted(files)
    pictures = {name.split("/")[0]: name for name in names if name.endswith(".png")}
    return {
        **({"file_path": pictures["rgb"]} if "rgb" in pictures else {}),
        **({"depth_file_path": pictures["depth"]} if "depth" in pictures else {}),
        **{"w": lens.width, "h": lens.height, "fl_x": lens.fl_x, "fl_y": lens.fl_y},
        **{"cx": lens.cx, "cy": lens.cy},
        "transform_matrix": [*pose.tolist(), [0.0, 0.0, 0.0, 1.0]],
        "files": names,
        **({} if of is None else {"of": of}),
    }


def _transforms(frames: list[dict[str, Any]], unit: float, scene: TrainedScene) -> str:
    """`transforms.json`: nerfstudio's keys, and what the numbers mean."""
    from pipelines.exports.frame import Frame

    content = {
        "camera_model": "PINHOLE",
        "orientation_override": "none",
        "frame": Frame(metric=scene.cameras.metric).note(),
        "depth": "z along the camera's axis, 0 is unknown; EXR in the world's unit, Z and colours",
        "depth_unit_scale_factor": unit,
        "normals": "in the camera's axes, x right, y up, z to the camera; 0 is unknown",
        "frames": frames,
    }
    return json.dumps(content, indent=1)


EXPORT = Export(
    kind="views",
    version=5,
    reads=("mesh",),
    run=run,
    options=ViewsOptions,
    on_request=True,
    artifacts=(
        Artifact(
            "views.zip",
            "views.zip",
            "application/zip",
            "unpacked: nerfstudio, Blender, Nuke",
            on_request=True,
        ),
    ),
)
