"""Where a lens shows a direction in its stored picture, and which direction a place there shows."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.nerf.space.lenses import CAMERA_MODELS, distort, undistort
from pipelines.scene.cameras_file import Intrinsics

Floats = NDArray[np.float64]


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
