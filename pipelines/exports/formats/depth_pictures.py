"""Depth as 16-bit PNG in whole steps of a unit, and numbers of any kind as OpenEXR.

0 is unknown in both. OpenEXR holds float32 as it is, one channel a number, losslessly compressed.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from pipelines.scene.depth_views import DepthView

_LARGEST = 65_535


def unit_of(views: Sequence[DepthView]) -> float:
    """The least power of ten with which 16 bits hold the farthest depth of views, doubled.

    They are few and small: what is a little farther in others has room. 0.001 where nothing is
    known.
    """
    farthest = max((float(view.z_depth.max()) for view in views), default=0.0)
    if farthest <= 0.0:
        return 0.001
    return float(10.0 ** math.ceil(math.log10(2.0 * farthest / _LARGEST)))


def write_png(path: Path, z: NDArray[np.float32], unit: float) -> int:
    """Write depths [H, W]. Returns how many are too far for 16 bits and are unknown in the file.

    A known depth nearer than half a step is the first step: 0 would be unknown.
    """
    steps = np.rint(np.asarray(z, np.float64) / unit)
    steps[(z > 0) & (steps < 1)] = 1
    beyond = steps > _LARGEST
    steps[beyond] = 0
    Image.fromarray(steps.astype(np.uint16)).save(path, "PNG")
    return int(beyond.sum())


def as_seen(z: NDArray[np.float32]) -> dict[str, NDArray[np.float32]]:
    """Depths [H, W] as channels of OpenEXR: Z, as it is called there, and the same as a picture.

    Blender, ffmpeg and picture viewers read colours alone: of a file that has Z and no more they
    show black, or nothing. Compression makes little of a number that is there four times.
    """
    return {"R": z, "G": z, "B": z, "Z": z}


def write_exr(path: Path, channels: Mapping[str, NDArray[np.float32]]) -> None:
    """Write channels [H, W] by their names."""
    # Large, and few jobs want it.
    import OpenEXR

    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage}
    values = {name: np.ascontiguousarray(channel, np.float32) for name, channel in channels.items()}
    with OpenEXR.File(header, values) as file:
        file.write(str(path))
