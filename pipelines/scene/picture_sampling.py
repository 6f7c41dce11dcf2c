"""Pictures asked between their pixels, and points of a surface asked where pictures show them."""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.space.cameras import Cameras

Floats = NDArray[np.floating[Any]]


def between_pixels(picture: NDArray[np.float32], u: Floats, v: Floats) -> NDArray[np.float32]:
    """Bilinear interpolation of [H, W, C] at columns u [N] and rows v [N], [N, C].

    The centre of the top-left pixel is at 0.5, 0.5; beyond the outermost centres their value holds.
    """
    places = sampling_grid(u, v, picture.shape[1], picture.shape[0])
    found: NDArray[np.float32] = at_grid(picture, places[None])[0]
    return found


def sampling_grid(u: Floats, v: Floats, width: int, height: int) -> Tensor:
    """Places [..., 2] for `at_grid`, of columns u and rows v of pictures of a size, [...] each."""
    places = np.stack([2.0 * u / width - 1.0, 2.0 * v / height - 1.0], axis=-1)
    return torch.from_numpy(places.astype(np.float32))


def at_grid(picture: NDArray[np.float32], places: Tensor) -> NDArray[np.float32]:
    """`between_pixels` of a picture [H, W, C] at places [R, N, 2]: [R, N, C]."""
    channels = torch.from_numpy(picture).permute(2, 0, 1)[None]
    found = torch.nn.functional.grid_sample(
        channels, places[None], mode="bilinear", padding_mode="border", align_corners=False
    )
    values: NDArray[np.float32] = found[0].permute(1, 2, 0).numpy()
    return values


def points_in_frame(
    points: Floats, cameras: Cameras, index: int, margin_px: float = 0.0
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32]]:
    """Of points [P, 3] those that camera `index` has in its frame, hidden by nothing or not.

    Returns which [Q], their pixels [Q, 2] and their z-depth [Q]. margin_px: of the frame, left out.
    """
    places = torch.as_tensor(np.ascontiguousarray(points, np.float32))
    which, pixels, z_depth = cameras.points_in_frame(places, index, margin_px)
    return which.numpy(), pixels.numpy(), z_depth.numpy()
