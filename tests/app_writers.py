"""Captures as further apps and RGB-D programs write them, from the analytic scene.

As in `tests.capture_writers`: each writer returns the exact cameras of the pictures that an
importer should find, whose names are those in the archive.
"""

from __future__ import annotations

import json
import zipfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.sample.film import walk
from pipelines.sample.scene import depth_image, pose_matrix, render
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from tests.capture_writers import Floats, arkit_pose, jpeg, landscape_camera, named, png, reduced

_CLOCK_S = 104_137.25
"""What the phone's clock shows at the first frame, seconds."""


def counts_of(lens: Intrinsics, pose: Floats, farthest_m: float = 65.0) -> Any:
    """Depth in millimetres, 16 bits, 0 from `farthest_m` on. [h, w]."""
    z = depth_image(lens, pose)
    return np.round(np.where(z < farthest_m, z, 0.0) * 1000.0).astype(np.uint16)


def shown(truth: CamerasFile, image: PosedImage) -> NDArray[np.uint8]:
    """The picture of a camera, [H, W, 3]."""
    picture: NDArray[np.uint8] = render(truth.cameras[image.camera], pose_matrix(image))
    return picture


def breathing(truth: CamerasFile) -> CamerasFile:
    """The same walk with a lens of its own for every picture, as autofocus has it."""
    (lens,) = truth.cameras
    scales = 1.0 + 0.004 * np.sin(np.arange(len(truth.images)))
    lenses = tuple(
        replace(lens, fl_x=lens.fl_x * s, fl_y=lens.fl_y * s, cx=lens.cx + s) for s in scales
    )
    images = tuple(replace(image, camera=index) for index, image in enumerate(truth.images))
    return replace(truth, cameras=lenses, images=images)


def _projection(lens: Intrinsics) -> list[float]:
    """OpenGL's projection of a lens, row-major, as ARKit has it (far plane at infinity)."""
    rows = np.zeros((4, 4))
    rows[0, 0], rows[1, 1] = 2 * lens.fl_x / lens.width, 2 * lens.fl_y / lens.height
    rows[0, 2], rows[1, 2] = 1 - 2 * lens.cx / lens.width, 2 * lens.cy / lens.height - 1
    rows[2], rows[3, 2] = (0, 0, -1, -0.001), -1
    return [float(value) for value in rows.ravel()]


def write_scanner_app(path: Path, num: int = 5, width: int = 160, step: int = 3) -> CamerasFile:
    """3D Scanner App's "All Data": a picture of every third frame, the rest of every frame.

    Intrinsics are for the phone's own size, 1920 wide, and differ between frames; their pixel
    centres are at integers. num: pictures.
    """
    walked = breathing(walk(num * step, landscape_camera(1920), frame_rate=6.0))
    pictures: dict[int, str] = {}
    with zipfile.ZipFile(path, "w") as archive:
        for index, image in enumerate(walked.images):
            pose = pose_matrix(image)
            lens = walked.cameras[image.camera]
            rows = np.vstack([arkit_pose(pose), [0, 0, 0, 1]])
            k = [lens.fl_x, 0, lens.cx - 0.5, 0, lens.fl_y, lens.cy - 0.5, 0, 0, 1]
            values = {
                "cameraGrain": 0,
                "hasGPS": True,
                "latitude": 37.5447,
                "longitude": 126.9639,
                "intrinsics": k,
                "projectionMatrix": _projection(lens),
                "cameraPoseARFrame": [float(value) for value in rows.ravel()],
                "time": _CLOCK_S + index / 6.0,
                "frame_index": index,
                "motionQuality": 1,
            }
            stem = f"{index:05d}"
            archive.writestr(f"All_Data/frame_{stem}.json", json.dumps(values, indent=2))
            depth = counts_of(reduced(lens, 24), pose, 5.0)
            archive.writestr(f"All_Data/depth_{stem}.png", png(depth))
            rated = np.where(depth > 0, 2, 0).astype(np.uint8)
            archive.writestr(f"All_Data/conf_{stem}.png", png(rated))
            if index % step == 0:
                pictures[index] = f"All_Data/frame_{stem}.jpg"
        lenses = tuple(reduced(lens, 1920 // width) for lens in walked.cameras)
        truth = named(replace(walked, cameras=lenses), pictures)
        for picture in truth.images:
            archive.writestr(picture.file, jpeg(shown(truth, picture)))
        archive.writestr("All_Data/info.json", json.dumps({"appVersionString": "1.9.7"}))
        archive.writestr("All_Data/thumb_00000.jpg", jpeg(shown(truth, truth.images[0])[::4, ::4]))
    return truth
