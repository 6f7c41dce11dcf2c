"""Small captures for the tests: pictures, archives and the context of a stage."""

from __future__ import annotations

import io
import json
import tempfile
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import OpenEXR
import PIL.Image
from numpy.typing import NDArray
from PIL.TiffImagePlugin import IFDRational

from pipelines.stage import StageContext
from pipelines.workspace import Workspace


def picture(
    width: int = 64,
    height: int = 48,
    seed: int = 0,
    kind: str = "JPEG",
    **save: Any,
) -> bytes:
    """A noisy picture with a red top left corner, encoded."""
    pixels = np.random.default_rng(seed).integers(0, 120, (height, width, 3), np.uint8)
    pixels[: height // 2, : width // 2] = (255, 0, 0)
    stream = io.BytesIO()
    PIL.Image.fromarray(pixels).save(stream, kind, **save)
    return stream.getvalue()


def depth_png(counts: Any) -> bytes:
    """Numbers [h, w] as a PNG of one channel: 8 bits for uint8, 16 for uint16."""
    stream = io.BytesIO()
    PIL.Image.fromarray(np.asarray(counts)).save(stream, "PNG")
    return stream.getvalue()


def depth_tiff(values: Any) -> bytes:
    """Numbers [h, w] as a TIFF of one channel, of their type."""
    stream = io.BytesIO()
    PIL.Image.fromarray(np.asarray(values)).save(stream, "TIFF", compression="tiff_lzw")
    return stream.getvalue()


def depth_npy(values: Any, *, pickled: bool = False) -> bytes:
    """An array as NumPy saves it."""
    stream = io.BytesIO()
    np.save(stream, values, allow_pickle=pickled)
    return stream.getvalue()


def depth_exr(values: Any, channel: str = "R", **more: Any) -> bytes:
    """Numbers [h, w] as an OpenEXR of half floats and ZIP, as Record3D writes it."""
    channels = {channel: np.asarray(values, np.float16), **more}
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "depth.exr"
        OpenEXR.File(header, channels).write(str(path))
        return path.read_bytes()


def phone_exif(focal_mm: float, focal_35mm: int, orientation: int = 1) -> PIL.Image.Exif:
    """What a phone writes about a photo, with all that must not be kept."""
    made = PIL.Image.Exif()
    made[0x010F], made[0x0110], made[0x0112] = "Maker", "Phone 9", orientation
    made[0x013B] = "Owner Ownerson"
    detail = made.get_ifd(0x8769)
    detail[0x920A], detail[0xA405] = IFDRational(round(focal_mm * 100), 100), focal_35mm
    detail[0x9003], detail[0xA434] = "2024:05:06 07:08:09", f"back camera {focal_mm}mm"
    detail[0xA431] = detail[0xA435] = "SERIAL-4711"
    place = made.get_ifd(0x8825)
    place[1], place[2] = "N", (48.0, 46.0, 31.0)
    return made


def exif(orientation: int) -> PIL.Image.Exif:
    made = PIL.Image.Exif()
    made[0x0112] = orientation
    made[0x010F] = "Phone"
    made.get_ifd(0x8825)[1] = "N"
    return made


def red_corner(path: Path) -> tuple[bool, bool]:
    """Whether the red quarter is at the top, and whether it is at the left."""
    with PIL.Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).astype(int)
    red = (pixels[..., 0] - pixels[..., 1]) > 150
    rows, columns = np.nonzero(red)
    return bool(rows.mean() < red.shape[0] / 2), bool(columns.mean() < red.shape[1] / 2)


def write_zip(path: Path, files: Mapping[str, bytes | str], method: int = 8) -> Path:
    with zipfile.ZipFile(path, "w", method) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
    return path


def context(root: Path, stage: str = "ingest") -> StageContext:
    """A context with an empty `out`, as a runner makes it."""
    workspace = Workspace(root)
    out = workspace.partial(stage)
    out.mkdir(parents=True)
    return StageContext(
        stage=stage, workspace=workspace, out=out, checkpoint=workspace.checkpoint(stage)
    )


def pose(x: float = 0.0, y: float = 0.0, z: float = 0.0) -> list[list[float]]:
    """A camera at a place, unrotated, 4x4."""
    return [[1, 0, 0, x], [0, 1, 0, y], [0, 0, 1, z], [0, 0, 0, 1]]


def nerfstudio_files(count: int = 4, **top: Any) -> dict[str, bytes | str]:
    """A capture in nerfstudio's layout, as archive entries."""
    frames = [
        {"file_path": f"images/{n}.jpg", "transform_matrix": pose(x=float(n))} for n in range(count)
    ]
    transforms = {"fl_x": 60.0, "fl_y": 61.0, "cx": 31.0, "cy": 23.0, "w": 64, "h": 48}
    return {
        "transforms.json": json.dumps({**transforms, "frames": frames, **top}),
        **{f"images/{n}.jpg": picture(seed=n) for n in range(count)},
    }


def polycam_files(
    count: int = 4, corrected: bool = True, blur_scores: list[float] | None = None
) -> dict[str, bytes | str]:
    """A Polycam raw export: camera n is at ARKit position (n, 0.5, -2)."""
    prefix = "corrected_" if corrected else ""
    files: dict[str, bytes | str] = {"mesh_info.json": "{}"}
    for n in range(count):
        camera: dict[str, float] = {
            "fx": 60.0, "fy": 60.0, "cx": 32.0, "cy": 24.0, "width": 64, "height": 48,
            "blur_score": blur_scores[n] if blur_scores else 100.0,
        }  # fmt: skip
        rows = pose(float(n), 0.5, -2.0)
        camera |= {f"t_{r}{c}": float(rows[r][c]) for r in range(3) for c in range(4)}
        stamp = 1_000_000 + n * 500_000
        files[f"keyframes/{prefix}images/{stamp}.jpg"] = picture(seed=n)
        files[f"keyframes/{prefix}cameras/{stamp}.json"] = json.dumps(camera)
    return files


def record3d_files(
    count: int = 12, absent: tuple[int, ...] = (), **metadata: Any
) -> dict[str, bytes | str]:
    """A Record3D export: frame n is at ARKit position (n, 0.5, -2)."""
    values = {
        "w": 64,
        "h": 48,
        "K": [60.0, 0, 0, 0, 61.0, 0, 31.0, 23.0, 1],
        "poses": [[0, 0, 0, 1, n, 0.5, -2.0] for n in range(count)],
        "frameTimestamps": [n / 60 for n in range(count)],
        **metadata,
    }
    return {
        "EXR_RGBD/metadata.json": json.dumps(values),
        **{f"EXR_RGBD/rgb/{n}.jpg": picture(seed=n) for n in range(count) if n not in absent},
    }


def scanner_app_files(count: int = 5, step: int = 3, **frame: Any) -> dict[str, bytes | str]:
    """An "All Data" export: picture n is of frame `step * n`, at ARKit position (frame, 0.5, -2).

    Depth of frame f: 1 m and f cm, of confidence 2 but for its first row. frame: other values.
    """
    size = {"projectionMatrix": [60 / 32, *[0.0] * 4, 61 / 24, *[0.0] * 10]}
    files: dict[str, bytes | str] = {"All_Data/info.json": "{}"}
    files["All_Data/thumb_00000.jpg"] = picture(16, 12)
    confidence = np.full((12, 16), 2, np.uint8)
    confidence[0] = 1
    for n in range(count * step):
        values = {
            "cameraPoseARFrame": [value for row in pose(float(n), 0.5, -2.0) for value in row],
            "intrinsics": [60.0, 0, 31.0, 0, 61.0, 23.0, 0, 0, 1],
            "time": 100 + n / 10,
            "frame_index": n,
            **size,
            **frame,
        }
        files[f"All_Data/frame_{n:05d}.json"] = json.dumps(values)
        files[f"All_Data/depth_{n:05d}.png"] = depth_png(
            np.full((12, 16), 1000 + 10 * n, np.uint16)
        )
        files[f"All_Data/conf_{n:05d}.png"] = depth_png(confidence)
        if n % step == 0:
            files[f"All_Data/frame_{n:05d}.jpg"] = picture(seed=n)
    return files


def rows_of(values: Any) -> str:
    """Numbers [r, c] as text."""
    return "\n".join(" ".join(str(float(value)) for value in row) for row in values) + "\n"


K = [[60.0, 0.0, 31.0], [0.0, 61.0, 23.0], [0.0, 0.0, 1.0]]


def rgbd_files(count: int = 5, layout: str = "folder") -> dict[str, bytes | str]:
    """An RGB-D capture: camera n is at (n, 0.5, -2), its depth 1 m and n cm.

    layout: "beside" (7-Scenes), "folder" (ScanNet) or "list" (K.txt and poses.txt).
    """
    files: dict[str, bytes | str] = {}
    for n in range(count):
        stem = f"{n:06d}"
        color, depth, text = {
            "beside": (
                f"frame-{stem}.color.png",
                f"frame-{stem}.depth.png",
                f"frame-{stem}.pose.txt",
            ),
            "folder": (f"color/{n}.png", f"depth/{n}.png", f"pose/{n}.txt"),
            "list": (f"images/{stem}.png", f"depth/{stem}.png", ""),
        }[layout]
        files[color] = picture(seed=n, kind="PNG")
        files[depth] = depth_png(np.full((12, 16), 1000 + 10 * n, np.uint16))
        if text:
            files[text] = rows_of(pose(float(n), 0.5, -2.0))
    files["intrinsic/intrinsic_color.txt" if layout == "folder" else "K.txt"] = rows_of(K)
    if layout == "list":
        rows = [np.ravel(pose(float(n), 0.5, -2.0)) for n in range(count)]
        files["poses.txt"] = rows_of(rows)
    return files


def llff_table(count: int = 5) -> NDArray[np.float64]:
    """Rows of `poses_bounds.npy` for pictures of 64x48: camera n is at (n, 0.5, -2), unrotated."""
    rows = np.zeros((count, 17))
    for n in range(count):
        table: list[list[float]] = [[0, 1, 0, n, 48], [-1, 0, 0, 0.5, 64], [0, 0, 1, -2.0, 60]]
        rows[n] = [*(value for row in table for value in row), 1.0, 9.0]
    return rows


def npy(values: Any, **given: Any) -> bytes:
    """An array as a .npy file."""
    stream = io.BytesIO()
    np.save(stream, np.asarray(values), **given)
    return stream.getvalue()


def llff_files(count: int = 5) -> dict[str, bytes | str]:
    """An LLFF capture whose pictures have padded names."""
    files: dict[str, bytes | str] = {"poses_bounds.npy": npy(llff_table(count))}
    return files | {f"images/{n:03d}.jpg": picture(seed=n) for n in range(count)}


def stray_files(film: bytes, count: int = 12) -> dict[str, bytes | str]:
    """A Stray Scanner recording of 320x192: frame n is at ARKit position (n, 0.5, -2)."""
    files: dict[str, bytes | str] = {"scan/rgb.mp4": film, "scan/imu.csv": "timestamp, a_x"}
    rows = ["timestamp, frame, x, y, z, qx, qy, qz, qw, fx, fy, cx, cy, distortion_center_x"]
    confidence = np.full((24, 40), 2, np.uint8)
    confidence[0] = 1
    for n in range(count):
        rows.append(f"{100 + n / 30}, {n:06d}, {n}.0, 0.5, -2.0, 1, 0, 0, 0, 300, 301, 158, 94, ")
        depth = np.full((24, 40), 1000 + 10 * n, np.uint16)
        files[f"scan/depth/{n:06d}.png"] = depth_png(depth)
        files[f"scan/confidence/{n:06d}.png"] = depth_png(confidence)
    files["scan/odometry.csv"] = "\n".join(rows)
    files["scan/camera_matrix.csv"] = "310.0, 0.0, 158.0\n0.0, 311.0, 94.0\n0.0, 0.0, 1.0"
    return files
