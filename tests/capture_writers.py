"""Captures in the formats of other programs, written from the analytic scene.

Each writer returns the exact cameras (`CamerasFile`, world of `pipelines.sample.scene`, +Z up,
metres) of the pictures that an importer should find; `file` is a picture's path inside the
archive. Formats: the public readers of each program's files, and a real Record3D export.
An importer may turn its world around +Z: compare by `pipelines.sample.align.similarity`, whose
scale must then be 1 for the metric formats.
"""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
from numpy.typing import NDArray
from PIL import Image

from pipelines.sample.film import encode_sideways, phone_camera, render_all, walk
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.scene.cameras_file import CamerasFile, Intrinsics

Floats = NDArray[np.float64]

Given = Callable[[CamerasFile], CamerasFile]
"""What an app believes of the true cameras: the poses that are written."""

ARKIT_FROM_WORLD: Floats = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [1.0, 0.0, 0.0]])
"""ARKit's frame is +Y up; rows [2, 0, 1] of its poses give our world back."""

_CLOCK_US = 7_214_336_541
"""What the phone's clock shows at the first picture, microseconds."""


def jpeg(picture: NDArray[np.uint8], **options: Any) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, "JPEG", quality=92, **options)
    return buffer.getvalue()


def png(array: NDArray[Any]) -> bytes:
    buffer = io.BytesIO()
    Image.fromarray(array).save(buffer, "PNG")
    return buffer.getvalue()


def _exr(z: NDArray[Any]) -> bytes:
    """Half floats in the channel R, ZIP, as Record3D writes them."""
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "depth.exr"
        OpenEXR.File(header, {"R": z.astype(np.float16)}).write(str(path))
        return path.read_bytes()


def _json(value: Any) -> str:
    return json.dumps(value, indent=1)


def _matrix(pose: Floats) -> list[list[float]]:
    return [[float(value) for value in row] for row in np.vstack([pose, [0.0, 0.0, 0.0, 1.0]])]


def named(truth: CamerasFile, names: dict[int, str]) -> CamerasFile:
    """The truth of those images alone, under their names in the archive."""
    return replace(
        truth,
        images=tuple(replace(truth.images[i], file=name) for i, name in names.items()),
    )


def exact(truth: CamerasFile) -> CamerasFile:
    """The true cameras themselves."""
    return truth


def arkit_pose(pose: Floats) -> Floats:
    """world_from_camera [3, 4] in ARKit's gravity frame."""
    turned: Floats = ARKIT_FROM_WORLD @ pose
    return turned


def landscape_camera(width: int = 640) -> Intrinsics:
    """A 4:3 camera held sideways, its principal point a little off the centre."""
    height = width * 3 // 4
    focal = 0.72 * width
    return Intrinsics(
        width=width, height=height, fl_x=focal, fl_y=focal, cx=width / 2 + 3.2, cy=height / 2 - 2.4
    )


def reduced(camera: Intrinsics, factor: int = 4) -> Intrinsics:
    """The same view with fewer pixels, as a depth sensor has it."""
    return replace(
        camera,
        width=camera.width // factor,
        height=camera.height // factor,
        fl_x=camera.fl_x / factor,
        fl_y=camera.fl_y / factor,
        cx=camera.cx / factor,
        cy=camera.cy / factor,
    )


def quaternion(rotation: Floats) -> list[float]:
    """[qx, qy, qz, qw] of a rotation [3, 3], by its largest component."""
    m = rotation
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    index = int(np.argmax(squares))
    columns = np.array(
        [
            [squares[0], m[1, 0] + m[0, 1], m[0, 2] + m[2, 0], m[2, 1] - m[1, 2]],
            [m[1, 0] + m[0, 1], squares[1], m[2, 1] + m[1, 2], m[0, 2] - m[2, 0]],
            [m[0, 2] + m[2, 0], m[2, 1] + m[1, 2], squares[2], m[1, 0] - m[0, 1]],
            [m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1], squares[3]],
        ]
    )
    found = columns[index] / np.linalg.norm(columns[index])
    return [float(value) for value in found]


def write_polycam(
    path: Path, num: int = 24, width: int = 640, corrected: bool = True, given: Given = exact
) -> CamerasFile:
    """A Polycam raw export: `keyframes/` with pictures, camera files, depth and confidence.

    Names are microseconds. With `corrected`, `corrected_cameras/` holds the true poses and
    `cameras/` drifted ones, as ARKit's are. The picture of keyframe 2 and the camera file of
    keyframe 4 are missing, as happens in real exports; only the others are in the truth. given:
    what is written in place of the true poses, where nothing was corrected.
    """
    camera = landscape_camera(width)
    truth = walk(num, camera, frame_rate=10.0)
    believed = given(truth)
    pictures = render_all(truth)
    kind = "corrected_" if corrected else ""
    names: dict[int, str] = {}
    low = reduced(camera)
    with zipfile.ZipFile(path, "w") as archive:
        for index, picture in enumerate(pictures):
            pose = pose_matrix(truth.images[index])
            stem = str(_CLOCK_US + 100_000 * index)
            if index == 0:
                archive.writestr("thumbnail.jpg", jpeg(picture[::4, ::4]))
            if index != 2:
                archive.writestr(f"keyframes/images/{stem}.jpg", jpeg(picture))
                if corrected:
                    archive.writestr(f"keyframes/corrected_images/{stem}.jpg", jpeg(picture))
            if index != 4:
                drifted = pose.copy()
                drifted[:, 3] += 0.15 * index / num * np.array([1.0, -0.5, 0.3])
                as_given = pose_matrix(believed.images[index])
                first = _polycam_camera(camera, drifted if corrected else as_given, index)
                archive.writestr(f"keyframes/cameras/{stem}.json", first)
                if corrected:
                    archive.writestr(
                        f"keyframes/corrected_cameras/{stem}.json",
                        _polycam_camera(camera, pose, index),
                    )
            depth_mm = np.round(depth_image(low, pose) * 1000.0)
            depth = np.where(depth_mm < 5000, depth_mm, 0).astype(np.uint16)
            archive.writestr(f"keyframes/depth/{stem}.png", png(depth))
            confidence = np.where(depth > 0, 255, 0).astype(np.uint8)
            archive.writestr(f"keyframes/confidence/{stem}.png", png(confidence))
            if index not in (2, 4):
                names[index] = f"keyframes/{kind}images/{stem}.jpg"
        identity = [float(value) for value in np.eye(4).ravel()]
        archive.writestr("mesh_info.json", _json({"alignmentTransform": identity}))
    return named(truth, names)


def _polycam_camera(camera: Intrinsics, pose: Floats, index: int) -> str:
    arkit = arkit_pose(pose)
    fields: dict[str, Any] = {
        f"t_{row}{column}": float(arkit[row, column]) for row in range(3) for column in range(4)
    }
    fields |= {
        "fx": camera.fl_x,
        "fy": camera.fl_y,
        "cx": camera.cx,
        "cy": camera.cy,
        "width": camera.width,
        "height": camera.height,
        "blur_score": 90.0 + index % 5,
        "timestamp": _CLOCK_US + 100_000 * index,
        "manual_keyframe": False,
    }
    return _json(fields)


def write_record3d(
    path: Path,
    num: int = 24,
    long_side_px: int = 640,
    missing: int = 5,
    folder: str = "EXR_RGBD/",
    depth: bool = False,
    given: Given = exact,
) -> CamerasFile:
    """A Record3D "EXR + JPG" export: `rgb/<n>.jpg`, `metadata.json`, and `depth/<n>.exr` if wanted.

    K is column-major, poses are [qx, qy, qz, qw, tx, ty, tz] in ARKit's frame, upright pictures.
    The picture of frame `missing` is not there, but its pose is: number n belongs to `poses[n]`.
    given: what is written in place of the true poses.
    """
    height, width = long_side_px, long_side_px * 3 // 4
    focal = 0.73 * height
    camera = Intrinsics(
        width=width, height=height, fl_x=focal, fl_y=focal, cx=width / 2 + 2.3, cy=height / 2 + 1.9
    )
    rate = 60.0
    truth = walk(num, camera, frame_rate=rate)
    believed = given(truth)
    names: dict[int, str] = {}
    poses: list[list[float]] = []
    with zipfile.ZipFile(path, "w") as archive:
        for index, picture in enumerate(render_all(truth)):
            pose = arkit_pose(pose_matrix(believed.images[index]))
            poses.append([*quaternion(pose[:, :3]), *(float(value) for value in pose[:, 3])])
            if index != missing:
                names[index] = f"{folder}rgb/{index}.jpg"
                archive.writestr(names[index], jpeg(picture))
                if depth:
                    z = depth_image(reduced(camera), pose_matrix(truth.images[index]))
                    archive.writestr(f"{folder}depth/{index}.exr", _exr(z))
        metadata = {
            "w": width,
            "h": height,
            "dw": 192,
            "dh": 256,
            "fps": rate,
            "K": [focal, 0, 0, 0, focal, 0, camera.cx, camera.cy, 1],
            "poses": poses,
            "initPose": [0, 0, 0, 1, 0, 0, 0],
            "frameTimestamps": [index / rate for index in range(num)],
            "cameraType": 1,
        }
        archive.writestr(f"{folder}metadata.json", json.dumps(metadata))
    return named(truth, names)


def write_nerfstudio(
    path: Path,
    num: int = 24,
    long_side_px: int = 480,
    missing: int = 3,
    folder: str = "",
    depth: bool = False,
) -> CamerasFile:
    """nerfstudio's layout: `transforms.json`, +Z up, OpenGL cameras, `images/`, `depth/` if wanted.

    `transforms.json` lists one picture that is not there, and lists them in another order than
    their names have.
    """
    camera = phone_camera(long_side_px)
    truth = walk(num, camera)
    names = {index: f"{folder}images/frame_{index + 1:05d}.jpg" for index in range(num)}
    frames: list[dict[str, Any]] = [
        {
            "file_path": names[index].removeprefix(folder),
            "transform_matrix": _matrix(pose_matrix(truth.images[index])),
        }
        for index in reversed(range(num))
    ]
    if depth:
        for frame in frames:
            frame["depth_file_path"] = f"depth/{Path(frame['file_path']).stem}.png"
    transforms = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fl_x,
        "fl_y": camera.fl_y,
        "cx": camera.cx,
        "cy": camera.cy,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "frames": frames,
    }
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr(f"{folder}transforms.json", _json(transforms))
        for index, picture in enumerate(render_all(truth)):
            if index != missing:
                archive.writestr(names[index], jpeg(picture))
                if depth:
                    z = depth_image(reduced(camera), pose_matrix(truth.images[index]))
                    counts = np.round(np.clip(z, 0.0, 65.0) * 1000.0).astype(np.uint16)
                    archive.writestr(f"{folder}depth/{Path(names[index]).stem}.png", png(counts))
    del names[missing]
    return named(truth, names)


def write_photos(
    path: Path, num: int = 24, long_side_px: int = 480, exif_orientation: int = 1
) -> CamerasFile:
    """A zip of photos, nothing else. exif_orientation: 1 (upright) or 6 (stored sideways)."""
    if exif_orientation not in (1, 6):
        raise ValueError(f"photos are written upright (1) or sideways (6), not {exif_orientation}")
    truth = walk(num, phone_camera(long_side_px))
    names = {index: f"IMG_{2041 + index}.JPG" for index in range(num)}
    exif = Image.Exif()
    exif[0x0112] = exif_orientation
    with zipfile.ZipFile(path, "w") as archive:
        for index, picture in enumerate(render_all(truth)):
            stored = np.rot90(picture) if exif_orientation == 6 else picture
            archive.writestr(names[index], jpeg(np.ascontiguousarray(stored), exif=exif))
    return named(truth, names)


def write_hdr_hevc(
    path: Path, num: int = 48, long_side_px: int = 480, transfer: str = "hlg"
) -> CamerasFile:
    """An HDR clip as phones film it: 10-bit HEVC, BT.2020, HLG or PQ, with a rotation flag.

    path: .mov or .mp4. transfer: "hlg" or "pq". White of the scene is diffuse white, 203 cd/m2.
    """
    curve = {"hlg": "arib-std-b67", "pq": "smpte2084"}[transfer]
    truth = walk(num, phone_camera(long_side_px))
    tags = f"color_primaries=bt2020:color_trc={curve}:colorspace=bt2020nc"
    options: dict[str, str | int] = {
        "vf": "format=gbrp,"
        "setparams=range=pc:color_primaries=bt709:color_trc=iec61966-2-1:colorspace=gbr,"
        "zscale=t=linear:npl=203,format=gbrpf32le,"
        f"zscale=p=bt2020:t={curve}:m=bt2020nc:r=limited:npl=203,format=yuv420p10le,"
        f"setparams=range=tv:{tags}",
        "c:v": "libx265",
        "preset": "ultrafast",
        "crf": 14,
        "tag:v": "hvc1",
        "x265-params": f"log-level=error:colorprim=bt2020:transfer={curve}:colormatrix=bt2020nc",
    }
    encode_sideways(path, render_all(truth), truth, options)
    return truth
