"""`cameras.json`: the one format in which stages hand cameras to each other and to people.

World frame: right-handed, +Z up (as far as the capture tells), units metres where `metric`, else
arbitrary. Camera frame: OpenGL (+X right, +Y up, looks along -Z). Pixel coordinates: the centre of
the top-left pixel is (0.5, 0.5). Image paths are relative to `Workspace.images_root`, with "/".
No torch and no pydantic here, so that every room can read the file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

FORMAT_VERSION = 1
CAMERA_MODELS = ("PINHOLE", "OPENCV", "OPENCV_FISHEYE")


@dataclass(frozen=True)
class Intrinsics:
    """A lens and its sensor, in pixels of the stored image.

    k1..k4, p1, p2: OpenCV's radial and tangential coefficients; for OPENCV_FISHEYE k1..k4 are its
    four angular coefficients and p1 = p2 = 0.
    """

    width: int
    height: int
    fl_x: float
    fl_y: float
    cx: float
    cy: float
    model: str = "PINHOLE"
    k1: float = 0.0
    k2: float = 0.0
    k3: float = 0.0
    k4: float = 0.0
    p1: float = 0.0
    p2: float = 0.0


@dataclass(frozen=True)
class PosedImage:
    """One registered image.

    camera: index into `CamerasFile.cameras`.
    world_from_camera: 3x4, row-major nested tuples, rotation and camera centre.
    split: "train" or "test" once training has chosen, else None.
    mask: path of a one-channel image, black = ignore, or None.
    depth: path of the depth that a sensor measured (`pipelines.scene.sensor_depth`): npz with `z`,
        float32 [h, w], world units along the camera's axis, 0 = unknown. It covers the image at a
        resolution of its own, lens distortion included. Or None.
    depth_lens: the lens by which that depth was written, where it is not the image's: then it
        covers what that lens shows in a picture of the image's size. Or None.
    light: how brightly it was taken, where pictures were levelled: gains of red, green and blue
        over the capture's mean light, and the camera's bend (`pipelines.nerf.data.light`). Or None.
    cut: path of a one-channel image by which a thing was cut out of its photo, black where nothing
        stands, or None.
    """

    file: str
    camera: int
    world_from_camera: tuple[tuple[float, ...], ...]
    timestamp_s: float | None = None
    split: str | None = None
    mask: str | None = None
    depth: str | None = None
    depth_lens: Intrinsics | None = None
    light: tuple[float, float, float, float] | None = None
    cut: str | None = None


@dataclass(frozen=True)
class CamerasFile:
    """All cameras of a capture. metric: whether one world unit is one metre."""

    cameras: tuple[Intrinsics, ...]
    images: tuple[PosedImage, ...]
    metric: bool = False
    source: str = ""
    notes: dict[str, Any] = field(default_factory=dict)

    @property
    def bend(self) -> float | None:
        """Of the camera's curve, where training brought the pictures to one light; else None."""
        bends = [image.light[3] for image in self.images if image.light is not None]
        return bends[0] if bends else None

    def as_dict(self) -> dict[str, Any]:
        """As plain JSON, for files that hold more than cameras; `from_dict` is its inverse."""
        plain: dict[str, Any] = json.loads(json.dumps(asdict(self)))
        return plain

    @classmethod
    def from_dict(cls, raw: Mapping[str, Any]) -> CamerasFile:
        """What `as_dict` gave. Raises ValueError naming the field that is wrong."""
        cameras = tuple(Intrinsics(**camera) for camera in raw["cameras"])
        images = tuple(
            PosedImage(
                **{
                    **image,
                    "world_from_camera": tuple(tuple(row) for row in image["world_from_camera"]),
                    "light": tuple(image["light"]) if image.get("light") else None,
                    "depth_lens": Intrinsics(**image["depth_lens"])
                    if image.get("depth_lens")
                    else None,
                }
            )
            for image in raw["images"]
        )
        for image in images:
            pose = image.world_from_camera
            if len(pose) != 3 or any(len(row) != 4 for row in pose):
                raise ValueError(f"{image.file}: world_from_camera is not 3x4")
            if not all(math.isfinite(value) for row in pose for value in row):
                raise ValueError(f"{image.file}: world_from_camera is not finite")
            if image.light is not None and not _is_light(image.light):
                raise ValueError(f"{image.file}: light is not three gains and a bend")
            if not 0 <= image.camera < len(cameras):
                raise ValueError(f"{image.file}: camera {image.camera} does not exist")
        return cls(
            cameras=cameras,
            images=images,
            metric=bool(raw["metric"]),
            source=str(raw["source"]),
            notes=dict(raw["notes"]),
        )

    def save(self, path: Path) -> None:
        """Write as JSON, with the conventions beside the numbers."""
        payload = {
            "version": FORMAT_VERSION,
            "world_axes": "right-handed, +Z up",
            "camera_axes": "OpenGL: +X right, +Y up, looks along -Z",
            **self.as_dict(),
        }
        path.write_text(json.dumps(payload, indent=1), "utf-8")

    @classmethod
    def load(cls, path: Path) -> CamerasFile:
        """Read what `save` wrote. Raises ValueError naming the field that is wrong."""
        raw = json.loads(path.read_text("utf-8"))
        if raw.get("version") != FORMAT_VERSION:
            raise ValueError(f"cameras.json has version {raw.get('version')}, not {FORMAT_VERSION}")
        return cls.from_dict(raw)


def _is_light(values: tuple[float, ...]) -> bool:
    return (
        len(values) == 4
        and all(0.0 < gain < math.inf for gain in values[:3])
        and 0.0 <= values[3] <= 1.0
    )
