"""What all captures that bring camera poses have in common: checks, axes, `cameras.json`.

World frame: +Z up. Camera frame: OpenGL (+X right, +Y up, looks along -Z).
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.captures.archive_rules import shown
from pipelines.captures.pictures import Picture, PictureWriter, store_all
from pipelines.captures.record import Found
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.options import IngestOptions
from pipelines.stage import StageContext

Matrix = npt.NDArray[np.float64]

Z_UP_FROM_Y_UP: Matrix = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
"""ARKit's gravity frame (+Y up) to ours (+Z up): x' = z, y' = x, z' = y."""

_SLACK = 0.05
"""How far a rotation may be from orthonormal before it is called malformed; files are rounded."""
_ASPECT_SLACK = 0.02


@dataclass(frozen=True)
class PosedSource:
    """One picture of the archive that has a pose.

    name: in the archive. lens: gives the intrinsics for the picture's real width and height.
    world_from_camera: [3, 4], +Z up, OpenGL camera.
    mask: a picture in the archive, or None.
    """

    name: str
    lens: Callable[[int, int], Intrinsics]
    world_from_camera: Matrix
    timestamp_s: float | None = None
    mask: str | None = None


def malformed(message: str) -> CaptureError:
    """The error for poses or intrinsics that make no sense."""
    return CaptureError(
        message, code="poses_malformed", hint="Export the capture again from the app."
    )


def missing(message: str) -> CaptureError:
    """The error for poses that are not there."""
    return CaptureError(
        message,
        code="poses_missing",
        hint="Export the capture with its poses, or send the pictures alone to have them found.",
    )


def number(value: Any, what: str) -> float:
    """A finite number from JSON. Raises CaptureError poses_malformed naming `what`."""
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise malformed(f"{what} is not a number.")
    try:
        result = float(value)
    except OverflowError:
        result = math.inf
    if not math.isfinite(result):
        raise malformed(f"{what} is not a finite number.")
    return result


def numbers(values: Any, count: int, what: str) -> list[float]:
    """A list of `count` finite numbers from JSON; errors as `number`."""
    if not isinstance(values, list) or len(values) != count:
        raise malformed(f"{what} is not a list of {count} numbers.")
    return [number(value, what) for value in values]


def checked_pose(matrix: Matrix, what: str) -> Matrix:
    """A pose whose rotation is made exactly orthonormal. [3, 4] to [3, 4].

    Raises CaptureError poses_malformed for a mirrored, sheared, scaled or empty rotation.
    """
    rotation = matrix[:, :3]
    error = np.abs(rotation.T @ rotation - np.eye(3)).max()
    if not np.isfinite(matrix).all() or error > _SLACK or np.linalg.det(rotation) < 0:
        raise malformed(f"The pose of {what} is no rotation and position.")
    u, _, vt = np.linalg.svd(rotation)
    result: Matrix = np.concatenate([u @ vt, matrix[:, 3:]], axis=1)
    return result


def z_up_from_y_up(matrix: Matrix) -> Matrix:
    """A pose [3, 4] in ARKit's world, in ours."""
    result: Matrix = Z_UP_FROM_Y_UP @ matrix
    return result


def resized(lens: Intrinsics, width: int, height: int) -> Intrinsics:
    """The intrinsics for the picture's real size.

    Raises CaptureError poses_malformed where the aspect differs: the picture was turned or cut.
    """
    if lens.width < 1 or lens.height < 1:
        raise malformed("The intrinsics are for a picture without pixels.")
    scale_x, scale_y = width / lens.width, height / lens.height
    if abs(scale_x / scale_y - 1) > _ASPECT_SLACK:
        raise malformed(
            f"A picture is {width}x{height}, but its intrinsics are for {lens.width}x{lens.height}."
        )
    return replace(
        lens,
        width=width,
        height=height,
        fl_x=lens.fl_x * scale_x,
        fl_y=lens.fl_y * scale_y,
        cx=lens.cx * scale_x,
        cy=lens.cy * scale_y,
    )


def checked_lens(lens: Intrinsics, what: str) -> Intrinsics:
    """Raise CaptureError poses_malformed for intrinsics that no camera has."""
    size = max(lens.width, lens.height)
    if not all(0.05 * size < focal < 100 * size for focal in (lens.fl_x, lens.fl_y)):
        raise malformed(f"The focal length of {what} is not one of a camera.")
    if not (-lens.width < lens.cx < 2 * lens.width and -lens.height < lens.cy < 2 * lens.height):
        raise malformed(f"The principal point of {what} is far outside the picture.")
    return lens


def write_posed(
    archive: CaptureArchive,
    sources: Sequence[PosedSource],
    ctx: StageContext,
    options: IngestOptions,
    *,
    source: str,
    metric: bool,
    notes: Mapping[str, Any],
) -> Found:
    """Write the pictures, masks and `cameras.json` of a posed capture into `ctx.out`.

    Raises CaptureError as `pictures.store_all` and `resized` do.
    """
    if len(sources) > options.max_images:
        raise CaptureError(
            f"The capture has {len(sources)} pictures; {options.max_images} are allowed.",
            code="too_large",
            hint="Send fewer pictures, or raise ingest.max_images.",
        )
    writer = PictureWriter(archive, ctx.out, max_pixels=options.max_pixels, upright=False)
    try:
        pictures, warnings = store_all(
            writer,
            [item.name for item in sources],
            lambda done: ctx.progress(done / len(sources), f"Picture {done} of {len(sources)}"),
        )
        cameras, images = _placed(writer, sources, pictures)
    finally:
        writer.close()
    CamerasFile(
        cameras=cameras,
        images=images,
        metric=metric,
        source=source,
        notes=dict(notes),
    ).save(ctx.out / "cameras.json")
    return Found(
        images=[picture.as_dict() for picture in pictures.values()],
        details={"num_posed": len(images), "num_lenses": len(cameras), "metric": metric},
        warnings=warnings,
    )


def _placed(
    writer: PictureWriter, sources: Sequence[PosedSource], pictures: Mapping[str, Picture]
) -> tuple[tuple[Intrinsics, ...], tuple[PosedImage, ...]]:
    """The lenses, each once, and the posed images of the pictures that were written."""
    cameras: dict[Intrinsics, int] = {}
    images: list[PosedImage] = []
    for item in sources:
        picture = pictures.get(item.name)
        if picture is None:
            continue
        what = f'"{shown(item.name)}"'
        lens = checked_lens(item.lens(picture.width, picture.height), what)
        mask = None
        if item.mask is not None:
            size = (picture.width, picture.height)
            mask = writer.store_mask(item.mask, len(images) + 1, size)
        images.append(
            PosedImage(
                file=picture.file,
                camera=cameras.setdefault(lens, len(cameras)),
                world_from_camera=tuple(
                    tuple(float(value) for value in row) for row in item.world_from_camera
                ),
                timestamp_s=item.timestamp_s,
                mask=mask,
            )
        )
    return tuple(cameras), tuple(images)


def some_of(names: Iterable[str], most: int = 5) -> str:
    """A few names for a message."""
    listed = sorted(names)
    more = f" and {len(listed) - most} more" if len(listed) > most else ""
    return ", ".join(shown(name) for name in listed[:most]) + more
