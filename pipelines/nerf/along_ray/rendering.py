"""From weights along a ray to what a pixel shows.

Symbols: R rays, S samples; `w` [R, S] from `intervals.weights_from_density`. Depth is the distance
along the unit ray in scene units, not z.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import bin_midpoints
from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.vectors import unit_vectors

BACKGROUNDS = ("last_sample", "black", "white", "random")
MEDIAN = 0.5


def accumulation(weights: Tensor) -> Tensor:
    """Chance that the ray ends anywhere before its last sample: [R] in [0, 1]."""
    return weights.sum(dim=-1)


def composite(
    colors: Tensor,
    weights: Tensor,
    background: str,
    *,
    generator: torch.Generator | None = None,
) -> Tensor:
    """The pixel's colour: sum_i w_i c_i + (1 - sum_i w_i) c_background.

    colors: [R, S, 3] in [0, 1]. weights: [R, S].
    background: "last_sample" (colour of the last sample), "black", "white", or "random": uniform
        numbers from the generator in training, black without one.
    Returns [R, 3] in [0, 1]. Raises NerfError `bad_config` for another name.
    Source: NeRF, arXiv:2003.08934, eq. 3.
    """
    if background not in BACKGROUNDS:
        raise NerfError(
            "bad_config",
            f"There is no background '{background}'.",
            f"Choose one of {', '.join(BACKGROUNDS)}.",
        )
    rgb = (weights[..., None] * colors).sum(dim=-2)
    missing = 1.0 - accumulation(weights)[..., None]
    if background == "last_sample":
        return rgb + missing * colors[..., -1, :]
    if background == "white":
        return rgb + missing
    if background == "random" and generator is not None:
        noise = torch.rand(rgb.shape, generator=generator, device=rgb.device, dtype=rgb.dtype)
        return rgb + missing * noise
    return rgb


def median_depth(weights: Tensor, t_edges: Tensor) -> Tensor:
    """Midpoint of the first interval where the cumulative weight reaches one half.

    weights: [R, S]; t_edges: [R, S + 1]. Returns [R]; the last midpoint where half is not reached.
    """
    reached = torch.cumsum(weights, dim=-1)
    half = torch.full_like(reached[..., :1], MEDIAN)
    index = torch.searchsorted(reached, half).clamp_max(weights.shape[-1] - 1)
    low, high = t_edges.gather(-1, index), t_edges.gather(-1, index + 1)
    return (0.5 * (low + high)).squeeze(-1)


def expected_depth(weights: Tensor, t_edges: Tensor) -> Tensor:
    """sum(w t) / (sum(w) + 1e-10), kept within the sampled range. [R, S], [R, S + 1] -> [R]."""
    middles = bin_midpoints(t_edges)
    depth = (weights * middles).sum(dim=-1) / (weights.sum(dim=-1) + 1e-10)
    return torch.minimum(torch.maximum(depth, middles[..., 0]), middles[..., -1])


def composite_normals(normals: Tensor, weights: Tensor) -> Tensor:
    """The direction of sum_i w_i n_i, with length one; 0 for a ray that meets nothing.

    normals: [R, S, 3], unit, any axes. weights: [R, S]. Returns [R, 3] in the same axes.
    """
    return unit_vectors((weights[..., None] * normals).sum(dim=-2))
