"""`transforms.json` in nerfstudio's layout: the cameras for other programs, and for ours again.

`transform_matrix` is world_from_camera, 4x4, OpenGL axes, in the world of `cameras.json`: +Z up
already, so `orientation_override` is "none". In another frame (`from_world` says how that world
came there) it is so only where +Z is up. Pixel coordinates are the same too: the centre of the
top-left pixel is (0.5, 0.5). Paths are those of `cameras.json`, relative to the folder that holds
`images/`, `masks/` and `depth/`. Where the capture's own file had been moved into its world
(`applied_transform`, `applied_scale`), both are passed on.

Source: nerfstudio, docs/quickstart/data_conventions.md and data/dataparsers/nerfstudio_dataparser.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from pipelines.errors import ExportError
from pipelines.exports.frame import FROM_WORLD, Frame
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage

_PERSPECTIVE = ("PINHOLE", "OPENCV")
_DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
_METRIC = "metric"
"""A word of our own, which other readers pass over: the world's unit is the metre."""
_PASSED_ON = ("applied_transform", "applied_scale")
_WORLD = Frame()


def write_transforms(path: Path, cameras: CamerasFile, frame: Frame = _WORLD) -> None:
    """Write the file. Raises ExportError where the lenses cannot stand in one such file."""
    path.write_text(transforms_text(cameras, frame=frame), "utf-8")


def transforms_text(
    cameras: CamerasFile,
    *,
    depth_unit: float | None = None,
    points: str | None = None,
    frame: Frame = _WORLD,
) -> str:
    """The content of the file. frame: that in which the cameras lie.

    depth_unit: world units a count of the 16-bit PNGs that the images' `depth` then names; None
    where there are none. points: path of a point cloud in the same world, or None.
    Raises ExportError where the lenses cannot stand in one such file.
    """
    images = cameras.images
    lenses = [cameras.cameras[image.camera] for image in images]
    matrix = frame.matrix()
    content: dict[str, Any] = {
        "camera_model": _camera_model(lenses),
        **({"orientation_override": "none"} if frame.is_upright() else {}),
        **({} if matrix is None else {FROM_WORLD: matrix.tolist()}),
        **({_METRIC: True} if cameras.metric else {}),
        **{name: cameras.notes[name] for name in _PASSED_ON if name in cameras.notes},
    }
    if points is not None:
        content["ply_file_path"] = points
    with_depth = depth_unit is not None and all(image.depth is not None for image in images)
    if depth_unit is not None and with_depth:
        # Who reads depth multiplies it by applied_scale, by which ours has been multiplied already.
        content["depth_unit_scale_factor"] = depth_unit / content.get("applied_scale", 1.0)
    # An intrinsic is global or each frame's own, never both.
    shared = len(set(lenses)) == 1
    if shared:
        content |= _intrinsics(lenses[0])
    content |= _splits(images)
    with_masks = all(image.mask is not None for image in images)
    content["frames"] = [
        {
            "file_path": image.file,
            **({"mask_path": image.mask} if with_masks else {}),
            **({"depth_file_path": image.depth} if with_depth else {}),
            **({} if image.timestamp_s is None else {"timestamp": image.timestamp_s}),
            "transform_matrix": [*map(list, image.world_from_camera), [0.0, 0.0, 0.0, 1.0]],
            "colmap_im_id": number,
            **({} if shared else _intrinsics(lens)),
        }
        for number, (image, lens) in enumerate(zip(images, lenses, strict=True), start=1)
    ]
    return json.dumps(content, indent=1)


def _camera_model(lenses: list[Intrinsics]) -> str:
    """The one model that the file may name: OPENCV holds PINHOLE, with all terms 0."""
    models = {lens.model for lens in lenses}
    if len(models) == 1:
        return models.pop()
    if models <= set(_PERSPECTIVE):
        return "OPENCV"
    raise ExportError(
        f"transforms.json has one camera model for all images, not {' and '.join(sorted(models))}.",
        code="format_cannot_hold",
        hint="Use cameras.json, where each image has its own.",
    )


def _intrinsics(lens: Intrinsics) -> dict[str, float | int]:
    plain: dict[str, float | int] = {
        "w": lens.width,
        "h": lens.height,
        "fl_x": lens.fl_x,
        "fl_y": lens.fl_y,
        "cx": lens.cx,
        "cy": lens.cy,
    }
    return plain | {name: getattr(lens, name) for name in _DISTORTION}


def _splits(images: tuple[PosedImage, ...]) -> dict[str, list[str]]:
    """What was trained on and what was held out; if one split is listed, each that is used must be.

    Validation and test are the same images: training chose by neither.
    """
    held_out = [image.file for image in images if image.split == "test"]
    if not held_out:
        return {}
    trained = [image.file for image in images if image.split != "test"]
    return {"train_filenames": trained, "val_filenames": held_out, "test_filenames": held_out}
