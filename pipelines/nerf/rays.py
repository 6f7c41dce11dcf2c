"""Bundles of tensors: rays, and the intervals they are cut into.

Symbols: R rays, S intervals per ray. `t` is the distance along a unit ray in scene units, `s` the
same mapped to [0, 1] by the spacing function of `intervals`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import torch
from torch import Tensor


@dataclass(frozen=True)
class Rays:
    """Rays in scene space.

    origins: [R, 3], scene units. directions: [R, 3], unit vectors.
    camera_indices: [R] int64, the row of the `Cameras` batch that each ray comes from.
    pixel_area: [R], solid angle of the pixel in steradian, or None where nobody asked for it.
    """

    origins: Tensor
    directions: Tensor
    camera_indices: Tensor
    pixel_area: Tensor | None = None

    def __len__(self) -> int:
        return self.origins.shape[0]

    def detach(self) -> Rays:
        """The same rays, cut from the graph of the camera optimiser."""
        return replace(self, origins=self.origins.detach(), directions=self.directions.detach())

    def to(self, device: torch.device | str) -> Rays:
        """The rays on another device."""
        return Rays(
            origins=self.origins.to(device),
            directions=self.directions.to(device),
            camera_indices=self.camera_indices.to(device),
            pixel_area=None if self.pixel_area is None else self.pixel_area.to(device),
        )


@dataclass(frozen=True)
class RaySamples:
    """Each ray cut into S adjoining intervals.

    s_edges: [R, S + 1] in [0, 1], increasing. t_edges: [R, S + 1], the same in scene units.
    """

    s_edges: Tensor
    t_edges: Tensor

    @property
    def num_samples(self) -> int:
        """S."""
        return self.t_edges.shape[-1] - 1

    @property
    def t_mid(self) -> Tensor:
        """Midpoints [R, S], scene units."""
        return 0.5 * (self.t_edges[..., 1:] + self.t_edges[..., :-1])

    def positions(self, rays: Rays) -> Tensor:
        """The midpoints as places in scene space, [R, S, 3]."""
        return torch.addcmul(
            rays.origins[:, None, :], rays.directions[:, None, :], self.t_mid[..., None]
        )
