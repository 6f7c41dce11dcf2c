"""Captures of analytic scenes: a phone's film, or pictures with exact poses and depth."""

from __future__ import annotations

import io
import json
import zipfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.sample.film import film_capture, phone_camera, render_all, walk
from pipelines.sample.scene import depth_image, pose_matrix
from pipelines.sample.takes import Take

DEPTH_UNIT_M = 0.001


def scene_capture(
    folder: Path, take: Take, num_frames: int, long_side_px: int, posed: bool
) -> Path:
    """The capture's file in `folder`, made unless it is there."""
    kind = "zip" if posed else "mp4"
    path = folder / f"{take.scene.name}-{num_frames}-{long_side_px}.{kind}"
    if not path.is_file():
        partial = path.with_name(f".partial-{path.name}")
        if posed:
            write_posed_capture(partial, take, num_frames, long_side_px)
        else:
            film_capture(partial, num_frames, long_side_px, take=take)
        partial.replace(path)
    return path


def write_posed_capture(path: Path, take: Take, num_frames: int, long_side_px: int) -> None:
    """A .zip in nerfstudio's layout: pictures, exact poses in the scene's world, depth in mm."""
    truth = walk(num_frames, phone_camera(long_side_px), take=take)
    camera = truth.cameras[0]
    frames = []
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for index, picture in enumerate(render_all(truth, take=take)):
            image = truth.images[index]
            depth = depth_image(camera, pose_matrix(image), take.scene) / DEPTH_UNIT_M
            archive.writestr(f"images/{index:05d}.jpg", encoded(picture, "JPEG"))
            archive.writestr(
                f"depth/{index:05d}.png", encoded(np.rint(depth).astype(np.uint16), "PNG")
            )
            pose = np.vstack([pose_matrix(image), [0.0, 0.0, 0.0, 1.0]])
            frames.append(
                {
                    "file_path": f"images/{index:05d}.jpg",
                    "depth_file_path": f"depth/{index:05d}.png",
                    "transform_matrix": pose.tolist(),
                    "timestamp": image.timestamp_s,
                }
            )
        transforms = {
            "w": camera.width,
            "h": camera.height,
            "fl_x": camera.fl_x,
            "fl_y": camera.fl_y,
            "cx": camera.cx,
            "cy": camera.cy,
            "depth_unit_scale_factor": DEPTH_UNIT_M,
            "frames": frames,
        }
        archive.writestr("transforms.json", json.dumps(transforms))


def encoded(picture: NDArray[np.uint8] | NDArray[np.uint16], kind: str) -> bytes:
    """A picture as a file: JPEG at 95, or PNG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, kind, **({"quality": 95} if kind == "JPEG" else {}))
    return buffer.getvalue()
