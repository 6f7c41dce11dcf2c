"""A sensor's depth as the image beside it has it, where it was written by another lens."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.lens_places import rays_of, through
from pipelines.scene.sensor_depth import Depths, load_sensor_depth


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
