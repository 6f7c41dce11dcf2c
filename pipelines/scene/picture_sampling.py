"""Pictures asked between their pixels, and points of a surface asked where pictures show them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from pipelines.nerf.space.cameras import Cameras

Floats = NDArray[np.floating[Any]]


def between_pixels(picture: NDArray[np.float32], u: Floats, v: Floats) -> NDArray[np.float32]:
    """Bilinear interpolation of [H, W, C] at columns u [N] and rows v [N], [N, C].

    The centre of the top-left pixel is at 0.5, 0.5; beyond the outermost centres their value holds.
    """
    height, width = picture.shape[:2]
    u, v = np.clip(u - 0.5, 0.0, width - 1.0), np.clip(v - 0.5, 0.0, height - 1.0)
    i, j = np.minimum(u.astype(int), width - 2), np.minimum(v.astype(int), height - 2)
    fu, fv = (u - i)[:, None], (v - j)[:, None]
    top = picture[j, i] * (1.0 - fu) + picture[j, i + 1] * fu
    bottom = picture[j + 1, i] * (1.0 - fu) + picture[j + 1, i + 1] * fu
    found: NDArray[np.float32] = (top * (1.0 - fv) + bottom * fv).astype(np.float32)
    return found


def points_in_frame(
    points: Floats, cameras: Cameras, index: int, margin_px: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Of points [P, 3] those that camera `index` has in its frame, hidden by nothing or not.

    Returns which [Q], their pixels [Q, 2] and their z-depth [Q]. margin_px: of the frame, left out.
    """
    places = torch.as_tensor(np.ascontiguousarray(points, np.float32))
    which, pixels, z_depth = cameras.points_in_frame(places, index, margin_px)
    return which.numpy(), pixels.numpy(), z_depth.numpy()
