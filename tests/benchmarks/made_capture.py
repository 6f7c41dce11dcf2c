"""A made-up posed capture of any number and size of images, for what does not depend on content.

Cameras stand on a ring of radius 1 and look at its centre; every picture file is the same JPEG
under another name (a hard link), so a thousand large pictures cost a moment. Each is decoded anew.
"""

from __future__ import annotations

import json
import math
import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

CAMERA_HEIGHT = 0.3
PICTURE_DETAIL = 12
"""Random colours along each side of the picture; smooth between them."""


def write_made_capture(folder: Path, num_images: int, width: int, height: int) -> None:
    """Write `transforms.json` and `images/` into a new folder."""
    (folder / "images").mkdir(parents=True)
    first = folder / "images" / "0000.jpg"
    _picture(width, height).save(first, quality=90)
    frames = []
    for index in range(num_images):
        path = first.with_name(f"{index:04d}.jpg")
        if index > 0:
            os.link(first, path)
        pose = np.eye(4)
        pose[:3] = ring_pose(2.0 * math.pi * index / num_images)
        frames.append({"file_path": f"images/{path.name}", "transform_matrix": pose.tolist()})
    focal = 0.7 * max(width, height)
    values = {"w": width, "h": height, "fl_x": focal, "fl_y": focal, "frames": frames}
    (folder / "transforms.json").write_text(json.dumps(values), "utf-8")


def ring_pose(angle: float) -> NDArray[np.float64]:
    """[3, 4] OpenGL pose on the ring at an angle in radians, looking at its centre, +Z up."""
    eye = np.array([math.cos(angle), math.sin(angle), CAMERA_HEIGHT])
    back = eye / np.linalg.norm(eye)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(back, right), back, eye], axis=-1)


def _picture(width: int, height: int) -> Image.Image:
    colors = np.random.default_rng(0).integers(0, 256, (PICTURE_DETAIL, PICTURE_DETAIL, 3))
    small = Image.fromarray(colors.astype(np.uint8))
    return small.resize((width, height), Image.Resampling.BICUBIC)
