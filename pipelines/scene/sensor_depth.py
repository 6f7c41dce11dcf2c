"""Depth of a phone's sensor in files: what `ingest` writes beside images, and later stages read.

`depth/00001.npz` holds `z`: float32 [h, w], world units along the camera's axis (not the ray), 0
where nothing is known. A map shows what its image shows, with the lens's distortion, at a
resolution of its own: image pixel (x, y) of [H, W] lies at (x * w / W, y * h / H). Maps are named
by `PosedImage.depth`.
"""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

Depths = NDArray[np.float32]


def save_sensor_depth(path: Path, z: Depths) -> None:
    """Write a map, z: [h, w], 0 where unknown."""
    np.savez_compressed(path, z=z.astype(np.float32))


def load_sensor_depth(path: Path) -> Depths:
    """What `save_sensor_depth` wrote, [h, w]. Raises ValueError for what is no such file."""
    try:
        with np.load(path, allow_pickle=False) as held:
            z: Depths = np.asarray(held["z"], np.float32)
    except (OSError, EOFError, KeyError, ValueError, zipfile.BadZipFile, zlib.error) as error:
        raise ValueError(f"{path.name} is no depth map: {error}") from error
    if z.ndim != 2:
        raise ValueError(f"{path.name} is no depth map, but an array of shape {z.shape}")
    return z
