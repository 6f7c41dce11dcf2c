"""Depth maps beside the training images, asked by ray.

A map belongs to an image, but not to its pixels: it is that of an undistorted (pinhole) camera in
the same place, of any size. So it is asked in which direction a ray leaves. Symbols: N images, R
rays.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.along_ray.losses import termination_loss
from pipelines.nerf.models.base import Outputs
from pipelines.nerf.options.train import DepthLossConfig
from pipelines.nerf.space.cameras import Cameras
from pipelines.nerf.space.rays import Rays

Lens = tuple[float, float, float, float]


@dataclass(frozen=True)
class DepthMaps:
    """N maps, of the training images in their order.

    z: [1 + P] float32, depth along the camera's axis in scene units, 0 where unknown, infinite
        where nothing stands; first one 0 for pixels outside of every map, then map after map, row
        by row.
    starts: [N] int64, each map's first row in `z`. sizes: [N, 2] int64, width and height.
    lenses: [N, 4] float32: fx, fy, cx, cy in px.
    """

    z: Tensor
    starts: Tensor
    sizes: Tensor
    lenses: Tensor

    @classmethod
    def from_arrays(
        cls, maps: Sequence[NDArray[np.float32]], lenses: Sequence[Lens], scale: float
    ) -> DepthMaps:
        """maps: [H, W] each, world units, 0 where unknown, infinite where nothing stands.

        lenses: fx, fy, cx, cy of each, px. scale: scene units per world unit.
        """
        counts = torch.tensor([item.size for item in maps], dtype=torch.int64)
        flat = np.concatenate([np.zeros(1, np.float32), *(item.reshape(-1) for item in maps)])
        return cls(
            z=torch.from_numpy(flat * np.float32(scale)),
            starts=1 + counts.cumsum(0) - counts,
            sizes=torch.tensor([item.shape[::-1] for item in maps]).reshape(-1, 2).long(),
            lenses=torch.tensor(lenses, dtype=torch.float32).reshape(-1, 4),
        )

    def __len__(self) -> int:
        return len(self.starts)

    @property
    def num_known(self) -> int:
        """Pixels with a depth, be it infinite."""
        return int((self.z > 0).sum())

    @property
    def known_share(self) -> float:
        """Share of the pixels where something is known to stand, and how far away."""
        found = int((torch.isfinite(self.z) & (self.z > 0)).sum())
        return found / max(1, len(self.z) - 1)

    def to(self, device: torch.device | str) -> DepthMaps:
        """The maps on another device."""
        return DepthMaps(*(item.to(device) for item in vars(self).values()))

    def distances(self, rays: Rays, cameras: Cameras) -> Tensor:
        """How far along each ray its image's map says the surface is, [R] scene units, 0 unknown,
        infinite where there is none.

        rays: as `Cameras.generate_rays` makes them of these N cameras. The pixel that the ray
        passes through tells; nothing is made up between two.
        """
        index = rays.camera_indices
        turn = cameras.scene_from_camera[index, :, :3]
        local = (rays.directions[:, None, :] @ turn).squeeze(1)
        ahead = -local[:, 2]
        safe = torch.where(ahead > 1e-6, ahead, 1.0)
        fx, fy, cx, cy = self.lenses[index].unbind(-1)
        width, height = self.sizes[index].unbind(-1)
        column = torch.floor(fx * local[:, 0] / safe + cx).long()
        row = torch.floor(cy - fy * local[:, 1] / safe).long()
        inside = (ahead > 1e-6) & (column >= 0) & (row >= 0) & (column < width) & (row < height)
        place = torch.where(inside, self.starts[index] + row * width + column, 0)
        return self.z[place] / safe


@dataclass(frozen=True)
class DepthSupervision:
    """Depth maps as a term of the loss.

    maps: on the device of the cameras, one for each training image.
    """

    maps: DepthMaps
    config: DepthLossConfig
    max_steps: int

    def to(self, device: torch.device | str) -> DepthSupervision:
        """The same on another device."""
        return DepthSupervision(self.maps.to(device), self.config, self.max_steps)

    def schedule(self, step: int) -> tuple[float, float]:
        """(weight, spread) of a step: the weight linear over the run, the spread as a power."""
        config, share = self.config, min(step / self.max_steps, 1.0)
        weight = config.weight + (config.weight_final - config.weight) * share
        narrowed = min(share / config.spread_share, 1.0) if config.spread_share > 0.0 else 1.0
        spread = config.spread * (config.spread_final / config.spread) ** narrowed
        return weight, spread

    def loss(
        self,
        outputs: Outputs,
        rays: Rays,
        cameras: Cameras,
        weight: float | Tensor,
        spread: float | Tensor,
    ) -> Tensor | None:
        """The weighted term of a step; None for methods whose rays have no common samples.

        weight, spread: of `schedule`.
        """
        if not outputs["weights"]:
            return None
        distances = self.maps.distances(rays, cameras)
        found, edges = outputs["weights"][-1], outputs["samples"][-1].t_edges
        return weight * termination_loss(found, edges, distances, spread)
