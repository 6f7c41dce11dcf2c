"""The capture's own depth maps as views, to be fused beside those of the trained field.

The maps know plain surfaces better, where several pictures agreed on them; the field knows what no
picture could be matched on, and thin things. Depths are [H, W], 0 where unknown.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.depth_views import DepthView, Pinhole

Depths = NDArray[np.float32]

_SAME_SURFACE = 0.02
"""Relative difference up to which neighbouring depths are one surface, to be drawn through."""


class KnownDepths:
    """The maps of a capture, by the images' names; of a folder without any, none."""

    def __init__(self, folder: Path) -> None:
        self._maps = DepthMapsFile(folder)
        self._index = {image.file: index for index, image in enumerate(self._maps.images)}

    def view_of(self, file: str, view: DepthView) -> DepthView | None:
        """What the map of an image says, as another view of it has its pixels; None without one."""
        index = self._index.get(file)
        if index is None:
            return None
        z = resampled(self._maps.read(index).z, self._maps.images[index].lens, view.lens)
        return replace(view, z_depth=z) if z.any() else None


def resampled(z: Depths, lens: Pinhole, wanted: Pinhole) -> Depths:
    """A depth map as another lens in the same place has it.

    Between four pixels of one surface inverse depth is interpolated, which planes are exact in;
    elsewhere the nearest pixel tells.
    """
    x, y = wanted.directions()[0, :, 0], -wanted.directions()[:, 0, 1]
    u, v = x * lens.fl_x + lens.cx - 0.5, y * lens.fl_y + lens.cy - 0.5
    inside = ((u >= -0.5) & (u < lens.width - 0.5))[None, :] & (
        (v >= -0.5) & (v < lens.height - 0.5)
    )[:, None]
    nearest = z[
        np.clip(np.rint(v).astype(int), 0, lens.height - 1)[:, None],
        np.clip(np.rint(u).astype(int), 0, lens.width - 1)[None, :],
    ]
    i = np.clip(np.floor(u).astype(int), 0, max(lens.width - 2, 0))
    j = np.clip(np.floor(v).astype(int), 0, max(lens.height - 2, 0))
    fu, fv = np.clip(u - i, 0.0, 1.0)[None, :], np.clip(v - j, 0.0, 1.0)[:, None]
    right, below = np.minimum(i + 1, lens.width - 1), np.minimum(j + 1, lens.height - 1)
    corners = np.stack(
        [z[np.ix_(a, b)] for a, b in ((j, i), (j, right), (below, i), (below, right))]
    )
    least, most = corners.min(axis=0), corners.max(axis=0)
    inverse = 1.0 / np.where(corners > 0, corners, 1.0)
    top = inverse[0] + fu * (inverse[1] - inverse[0])
    bottom = inverse[2] + fu * (inverse[3] - inverse[2])
    smooth = (least > 0) & (most - least <= _SAME_SURFACE * least)
    values = np.where(smooth, 1.0 / (top + fv * (bottom - top)), nearest)
    return np.where(inside, values, 0.0).astype(np.float32)
