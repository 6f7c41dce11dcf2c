"""Bundles of tensors: rays, and the intervals they are cut into.

Symbols: R rays, S intervals per ray. `t` is the distance along a unit ray in scene units, `s` the
same mapped to [0, 1] by the spacing function of `intervals`.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.frustums import Gaussians, cone_radius, frustum_gaussians


@dataclass(frozen=True)
class Rays:
    """Rays in scene space.

    origins: [R, 3], scene units. directions: [R, 3], unit vectors.
    camera_indices: [R] int64, the row of the `Cameras` batch that each ray comes from.
    pixel_area: [R], solid angle of the pixel in steradian, or None where nobody asked for it.
    times: [R] in [0, 1], when each ray was seen, or None in a scene that stands still.
    """

    origins: Tensor
    directions: Tensor
    camera_indices: Tensor
    pixel_area: Tensor | None = None
    times: Tensor | None = None

    def __len__(self) -> int:
        return self.origins.shape[0]

    def detach(self) -> Rays:
        """The same rays, cut from the graph of the camera optimiser."""
        return replace(self, origins=self.origins.detach(), directions=self.directions.detach())

    def select(self, rows: Tensor | slice) -> Rays:
        """Some of the rays: int64 positions, a [R] bool mask or a slice."""
        return self._map(lambda values: values[rows])

    def to(self, device: torch.device | str) -> Rays:
        """The rays on another device."""
        return self._map(lambda values: values.to(device))

    def _map(self, change: Callable[[Tensor], Tensor]) -> Rays:
        return Rays(
            origins=change(self.origins),
            directions=change(self.directions),
            camera_indices=change(self.camera_indices),
            pixel_area=None if self.pixel_area is None else change(self.pixel_area),
            times=None if self.times is None else change(self.times),
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

    def gaussians(self, rays: Rays) -> Gaussians:
        """The intervals as volumes of the pixels' cones: mean [R, S, 3], covariance [R, S, 3, 3].

        Scene units. Source: Mip-NeRF, arXiv:2103.13415, eqs. 7 and 8. Raises NerfError `bad_rays`
        where the rays carry no `pixel_area`.
        """
        if rays.pixel_area is None:
            raise NerfError(
                "bad_rays",
                f"The {len(rays)} rays carry no pixel area, so their samples have no volume.",
                "Make the rays with generate_rays(..., with_pixel_area=True).",
            )
        radius = cone_radius(rays.pixel_area)
        return frustum_gaussians(rays.origins, rays.directions, self.t_edges, radius)
