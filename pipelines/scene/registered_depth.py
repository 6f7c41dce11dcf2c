"""A sensor's depth as the image beside it has it, where it was written by another lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.nerf.space.lenses import CAMERA_MODELS, distort, undistort
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.sensor_depth import Depths, load_sensor_depth

Floats = NDArray[np.float64]


def registered_depth(root: Path, image: PosedImage, lens: Intrinsics) -> Depths:
    """The map [h, w] of an image with depth, in the image's own lens; 0 where unknown.

    As it is stored, unless `depth_lens` says that another lens shows it: then each pixel takes the
    nearest one of the same direction. Raises ValueError for what is no depth map.
    """
    assert image.depth is not None
    z = load_sensor_depth(root / image.depth)
    if image.depth_lens is None:
        return z
    height, width = z.shape
    u, v = np.meshgrid(
        (np.arange(width) + 0.5) * (lens.width / width),
        (np.arange(height) + 0.5) * (lens.height / height),
    )
    there = through(image.depth_lens, rays_of(lens, np.stack([u, v], axis=-1).reshape(-1, 2)))
    scaled = there * (width / lens.width, height / lens.height)
    inside = np.isfinite(scaled).all(axis=1) & (scaled >= 0).all(axis=1)
    inside &= (scaled < (width, height)).all(axis=1)
    columns, rows = np.where(inside[:, None], scaled, 0.0).astype(np.int64).T
    found: Depths = np.where(inside, z[rows, columns], np.float32(0.0)).reshape(z.shape)
    return found


def through(lens: Intrinsics, rays: Floats) -> Floats:
    """Where in its picture a lens shows directions [P, 3], OpenCV axes: [P, 2], pixels."""
    flat = torch.from_numpy(np.ascontiguousarray(rays))
    plane = distort(flat, *_model(lens, len(flat))).numpy()
    places: Floats = plane * (lens.fl_x, lens.fl_y) + (lens.cx, lens.cy)
    return places


def rays_of(lens: Intrinsics, places: Floats) -> Floats:
    """Unit directions [P, 3], OpenCV axes, of places [P, 2], pixels, in a lens's picture."""
    plane = (places - (lens.cx, lens.cy)) / (lens.fl_x, lens.fl_y)
    ways = undistort(torch.from_numpy(plane), *_model(lens, len(plane))).numpy()
    found: Floats = ways / np.linalg.norm(ways, axis=1, keepdims=True)
    return found


def _model(lens: Intrinsics, num: int) -> tuple[torch.Tensor, torch.Tensor, tuple[int, ...]]:
    """`terms`, `model` and `kinds` of `nerf.space.lenses` for so many rows."""
    kind = CAMERA_MODELS.index(lens.model)
    terms = [lens.k1, lens.k2, lens.k3, lens.k4, lens.p1, lens.p2]
    rows = torch.tensor([terms], dtype=torch.float64).expand(num, -1)
    return rows, torch.full((num,), kind), (kind,)
