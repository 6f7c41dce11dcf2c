"""A COLMAP model in a zip: `sparse/0/{cameras,images,points3D}`, as text and as binary.

COLMAP turns the world into the camera (cam_from_world), its cameras look along +Z with +Y down, and
its quaternions are (w, x, y, z). Pixel coordinates are ours: the centre of the top-left pixel is
(0.5, 0.5). Names are relative to the folder `images/` that belongs beside `sparse/`. Points are
those of the cloud, if any, and no image's keypoints: the poses are those that training corrected,
and no sparse point was found with them.

Source: colmap.github.io/format.html, src/colmap/sensor/models.h.
"""

from __future__ import annotations

import io
import struct
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ExportError
from pipelines.exports.formats.archive import entry
from pipelines.exports.frame import Frame
from pipelines.scene.cameras_file import CamerasFile, Intrinsics
from pipelines.scene.rotations import quaternions

Floats = NDArray[np.float64]

_FOLDER = "sparse/0"
_IMAGES = "images/"
_MODELS = {
    "PINHOLE": (1, ()),
    "OPENCV": (4, ("k1", "k2", "p1", "p2")),
    "OPENCV_FISHEYE": (5, ("k1", "k2", "k3", "k4")),
    "FULL_OPENCV": (6, ("k1", "k2", "p1", "p2", "k3")),
}
"""COLMAP's model: its number, and its terms behind (fl_x, fl_y, cx, cy)."""
_NO_DENOMINATOR = (0.0, 0.0, 0.0)
"""k4, k5 and k6 of FULL_OPENCV divide; our k4 is the eighth power's."""
_POINT = np.dtype(
    [
        ("id", "<u8"),
        ("xyz", "<f8", (3,)),
        ("rgb", "u1", (3,)),
        ("error", "<f8"),
        ("num_seen", "<u8"),
    ]
)
"""Of points3D.bin; how many images saw it, by their keypoints, is none."""
_GREY = 127
_WORLD = Frame()


@dataclass(frozen=True)
class _Camera:
    model: str
    number: int
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class _Image:
    """q: (w, x, y, z), t: of cam_from_world. camera: its number, from 1."""

    q: tuple[float, ...]
    t: tuple[float, ...]
    camera: int
    name: str


def write_colmap(path: Path, cameras: CamerasFile, frame: Frame = _WORLD) -> None:
    """Write the zip, without points. frame: that in which the cameras lie.

    Raises ExportError for a lens that COLMAP has no model for.
    """
    files = model_files(cameras, "text") | model_files(cameras, "binary")
    _write(path, files | frame_file(frame))


def write_colmap_points(
    path: Path,
    cameras: CamerasFile,
    points: Floats,
    colors: NDArray[np.uint8],
    frame: Frame = _WORLD,
) -> None:
    """Write the zip with points and no text, which would be long.

    points: [P, 3] where the cameras are, in `frame`. colors: [P, 3], sRGB. Raises ExportError as
    `check_lenses`.
    """
    _write(path, model_files(cameras, "binary", points, colors) | frame_file(frame))


def frame_file(frame: Frame) -> dict[str, bytes]:
    """`frame.txt`, which tells of a frame that is not the world of cameras.json; else no file.

    COLMAP's own files have no room for that.
    """
    if frame.from_world is None:
        return {}
    return {"frame.txt": "".join(f"{line}\n" for line in frame.lines()).encode("ascii")}


def model_files(
    cameras: CamerasFile,
    form: Literal["text", "binary"],
    points: Floats | None = None,
    colors: NDArray[np.uint8] | None = None,
) -> dict[str, bytes]:
    """The three files of a model in one form, by their names in an archive.

    points: [P, 3] world, or None. colors: [P, 3], sRGB; grey where there are none.
    Raises ExportError as `check_lenses`.
    """
    lenses = [_camera(lens) for lens in cameras.cameras]
    images = _images(cameras)
    places = np.zeros((0, 3)) if points is None else points
    records = np.zeros(len(places), _POINT)
    records["id"] = np.arange(1, len(places) + 1)
    records["xyz"] = places
    records["rgb"] = _GREY if colors is None else colors
    if form == "text":
        files = {
            "cameras.txt": _cameras_text(lenses),
            "images.txt": _images_text(images),
            "points3D.txt": _points_text(records),
        }
    else:
        files = {
            "cameras.bin": _cameras_binary(lenses),
            "images.bin": _images_binary(images),
            "points3D.bin": struct.pack("<Q", len(records)) + records.tobytes(),
        }
    return {f"{_FOLDER}/{name}": data for name, data in files.items()}


def check_lenses(cameras: CamerasFile) -> None:
    """Raises ExportError (format_cannot_hold) for a lens that COLMAP has no model for."""
    for lens in cameras.cameras:
        _camera(lens)


def _write(path: Path, files: dict[str, bytes]) -> None:
    with zipfile.ZipFile(path, "w") as archive:
        for name, data in files.items():
            archive.writestr(entry(name), data)


def _camera(lens: Intrinsics) -> _Camera:
    model = lens.model
    if model == "OPENCV" and lens.k3 != 0.0:
        model = "FULL_OPENCV"
    if model not in _MODELS or (model != "OPENCV_FISHEYE" and lens.k4 != 0.0):
        raise ExportError(
            f"COLMAP has no camera model for {lens.model} with k4 = {lens.k4:g}.",
            code="format_cannot_hold",
            hint="Use transforms.json or cameras.json, which hold every lens.",
        )
    number, terms = _MODELS[model]
    params = (lens.fl_x, lens.fl_y, lens.cx, lens.cy, *(getattr(lens, name) for name in terms))
    if model == "FULL_OPENCV":
        params += _NO_DENOMINATOR
    return _Camera(model, number, lens.width, lens.height, params)


def _images(cameras: CamerasFile) -> list[_Image]:
    poses = np.asarray([image.world_from_camera for image in cameras.images], np.float64)
    world_from_opencv = poses[:, :, :3] * np.array([1.0, -1.0, -1.0])
    rotation = world_from_opencv.transpose(0, 2, 1)
    translation = -np.einsum("nij,nj->ni", rotation, poses[:, :, 3])
    q = quaternions(rotation)
    q *= np.where(q[:, :1] < 0.0, -1.0, 1.0)
    return [
        _Image(tuple(q[row].tolist()), tuple(translation[row].tolist()), image.camera + 1, name)
        for row, image in enumerate(cameras.images)
        for name in [image.file.removeprefix(_IMAGES)]
    ]


def _cameras_text(lenses: Sequence[_Camera]) -> bytes:
    lines = ["# CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]"]
    for number, lens in enumerate(lenses, start=1):
        lines.append(f"{number} {lens.model} {lens.width} {lens.height} {_numbers(lens.params)}")
    return ("\n".join(lines) + "\n").encode()


def _images_text(images: Sequence[_Image]) -> bytes:
    """Two lines an image, of which the second, for its points, is empty."""
    lines = ["# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME"]
    for number, image in enumerate(images, start=1):
        lines += [f"{number} {_numbers((*image.q, *image.t))} {image.camera} {image.name}", ""]
    return ("\n".join(lines) + "\n").encode()


def _points_text(records: NDArray[np.void]) -> bytes:
    """A line a point, seen by no image."""
    lines = ["# POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)"]
    lines += [
        f"{row['id']} {_numbers(row['xyz'])} {' '.join(map(str, row['rgb']))} 0.0"
        for row in records
    ]
    return ("\n".join(lines) + "\n").encode()


def _numbers(values: Sequence[float]) -> str:
    """As text from which the same doubles are read."""
    return " ".join(repr(float(value)) for value in values)


def _cameras_binary(lenses: Sequence[_Camera]) -> bytes:
    out = io.BytesIO()
    out.write(struct.pack("<Q", len(lenses)))
    for number, lens in enumerate(lenses, start=1):
        out.write(struct.pack("<IiQQ", number, lens.number, lens.width, lens.height))
        out.write(struct.pack(f"<{len(lens.params)}d", *lens.params))
    return out.getvalue()


def _images_binary(images: Sequence[_Image]) -> bytes:
    out = io.BytesIO()
    out.write(struct.pack("<Q", len(images)))
    for number, image in enumerate(images, start=1):
        out.write(struct.pack("<I7dI", number, *image.q, *image.t, image.camera))
        out.write(image.name.encode() + b"\0" + struct.pack("<Q", 0))
    return out.getvalue()
