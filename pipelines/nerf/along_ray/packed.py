"""Samples of many rays in one row, as many per ray as it needs: no padding.

Symbols: R rays; P samples of all rays together, those of a ray side by side and in order; `tau` the
optical thickness of a sample, density times length. What is computed per ray here is the same as
`intervals` and `rendering` have it for rows of equal length.
"""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from pipelines.nerf.along_ray.rendering import BACKGROUNDS, MEDIAN
from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.rays import Rays

OPAQUE = 64.0
"""exp(-64) = 1.6e-28 of the light: thicker changes nothing in float32, and sums stay small."""


@dataclass(frozen=True)
class PackedSamples:
    """Intervals of rays, flat.

    ray: [P] int64, ascending: the ray of each sample. t_start, t_end: [P], scene units, increasing
    within a ray. num_rays: R.
    """

    ray: Tensor
    t_start: Tensor
    t_end: Tensor
    num_rays: int

    def __len__(self) -> int:
        return self.ray.shape[0]

    @property
    def t_mid(self) -> Tensor:
        """Midpoints [P], scene units."""
        return 0.5 * (self.t_start + self.t_end)

    @property
    def lengths(self) -> Tensor:
        """[P], scene units."""
        return self.t_end - self.t_start

    def counts(self) -> Tensor:
        """Samples of each ray, [R] int64."""
        return torch.bincount(self.ray, minlength=self.num_rays)

    def positions(self, rays: Rays) -> Tensor:
        """The midpoints as places in scene space, [P, 3]."""
        return torch.addcmul(rays.origins[self.ray], rays.directions[self.ray], self.t_mid[:, None])

    def select(self, mask: Tensor) -> PackedSamples:
        """Those samples where `mask` [P] is true."""
        return PackedSamples(self.ray[mask], self.t_start[mask], self.t_end[mask], self.num_rays)


def sum_by_ray(values: Tensor, samples: PackedSamples) -> Tensor:
    """The sum over each ray's samples: [P, ...] to [R, ...]; 0 for a ray without."""
    total = values.new_zeros(samples.num_rays, *values.shape[1:])
    return total.index_add(0, samples.ray, values)


def sums_before(values: Tensor, samples: PackedSamples) -> Tensor:
    """Of each sample, the sum of the samples before it on the same ray: [P] to [P], float64.

    One running sum over all rays, less what it was at the ray's start: no loop. It is taken in
    float64, since it goes on over all P samples.
    """
    precise = values.double()
    before = torch.cumsum(precise, dim=0) - precise
    counts = samples.counts()
    first = torch.cumsum(counts, dim=0) - counts
    return before - before[first[samples.ray]]


def packed_light(density: Tensor, samples: PackedSamples) -> tuple[Tensor, Tensor]:
    """What reaches each sample and what stops there: (T [P], alpha [P]), each in [0, 1].

    density: [P], >= 0, per scene unit. T_i = exp(-sum_{j<i} tau_j), alpha_i = 1 - exp(-tau_i).
    Source: NeRF, arXiv:2003.08934, eq. 3.
    """
    # An infinite density in a sample of no length is 0 * inf; such a sample holds nothing.
    thickness = torch.nan_to_num(density * samples.lengths)
    passed = sums_before(thickness.clamp_max(OPAQUE), samples)
    return torch.exp(-passed).to(density.dtype), -torch.expm1(-thickness)


def packed_weights(density: Tensor, samples: PackedSamples) -> Tensor:
    """The chance [P] that a ray ends in each sample, T_i alpha_i; `weights_from_density` packed."""
    light, alpha = packed_light(density, samples)
    return light * alpha


def packed_composite(
    colors: Tensor,
    weights: Tensor,
    samples: PackedSamples,
    background: str,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The colours of rays, [R, 3], as `rendering.composite` has them.

    colors: [P, 3] in [0, 1]. weights: [P]. Behind a ray without samples, `last_sample` is black.
    Raises NerfError `bad_config` for another background.
    """
    if background not in BACKGROUNDS:
        raise NerfError(
            "bad_config",
            f"There is no background '{background}'.",
            f"Choose one of {', '.join(BACKGROUNDS)}.",
        )
    rgb = sum_by_ray(weights[:, None] * colors, samples)
    missing = 1.0 - sum_by_ray(weights, samples)[:, None]
    if background == "white":
        return rgb + missing
    if background == "last_sample" and len(samples):
        counts = samples.counts()
        last = (torch.cumsum(counts, dim=0) - 1).clamp_min(0)
        return rgb + missing * torch.where((counts > 0)[:, None], colors[last], 0.0)
    if background == "random" and generator is not None:
        noise = torch.rand(rgb.shape, generator=generator, device=rgb.device, dtype=rgb.dtype)
        return rgb + missing * noise
    return rgb


def packed_median_depth(weights: Tensor, samples: PackedSamples, far: float) -> Tensor:
    """Midpoint [R] of the sample where the cumulative weight reaches one half; else `far`.

    weights: [P]. far: scene units.
    """
    reached = sums_before(weights, samples) + weights >= MEDIAN
    depth = weights.new_full((samples.num_rays,), far, dtype=samples.t_start.dtype)
    # The first sample of a ray where it is reached has the smallest distance.
    return depth.scatter_reduce(0, samples.ray[reached], samples.t_mid[reached], "amin")


def packed_expected_depth(weights: Tensor, samples: PackedSamples, far: float) -> Tensor:
    """sum(w t) / sum(w) [R]; `far` for a ray that meets nothing. weights: [P]."""
    total = sum_by_ray(weights, samples)
    depth = sum_by_ray(weights * samples.t_mid, samples) / total.clamp_min(1e-10)
    return torch.where(total > 1e-10, depth, far)
