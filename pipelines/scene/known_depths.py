"""The capture's own depth maps as views, to be fused beside those of the trained field.

The maps know plain surfaces better, where several pictures agreed on them; the field knows what no
picture could be matched on, and thin things. Depths are [H, W], 0 where unknown.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.maps import FEW_PHOTOS
from pipelines.scene.depth_maps_file import DepthMapsFile
from pipelines.scene.depth_sampling import sampled
from pipelines.scene.depth_views import DepthView, Pinhole

Depths = NDArray[np.float32]


class KnownDepths:
    """The maps of a capture, by the images' names; of a folder without any, none."""

    def __init__(self, folder: Path) -> None:
        self._maps = DepthMapsFile(folder)
        self._index = {image.file: index for index, image in enumerate(self._maps.images)}

    @property
    def measured(self) -> bool:
        """Whether a sensor had a part in the maps."""
        return self._maps.measured

    @property
    def few(self) -> bool:
        """Whether they are of so few photos that many places are in one or two of them."""
        return len(self._index) < FEW_PHOTOS

    def view_of(self, file: str, view: DepthView) -> DepthView | None:
        """What the map of an image says, as another view of it has its pixels; None without one."""
        index = self._index.get(file)
        if index is None:
            return None
        z = resampled(self._maps.read(index).z, self._maps.images[index].lens, view.lens)
        return replace(view, z_depth=z, is_partial=True) if z.any() else None


def resampled(z: Depths, lens: Pinhole, wanted: Pinhole) -> Depths:
    """A depth map as another lens in the same place has it: `depth_sampling.sampled`."""
    x, y = wanted.directions()[0, :, 0], -wanted.directions()[:, 0, 1]
    u, v = x * lens.fl_x + lens.cx - 0.5, y * lens.fl_y + lens.cy - 0.5
    return sampled(z, *np.meshgrid(u, v))
