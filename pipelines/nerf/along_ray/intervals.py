"""Step functions along a ray: spacing, weights, resampling.

Symbols: S intervals with S + 1 edges; `t` distance along a unit ray (scene units); `s` in [0, 1];
`sigma` density per scene unit; `w` the chance that a ray ends in an interval. Where the intervals
come from is left to `samplers`, what the weights are used for to `rendering` and `losses`.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.plugins import plugin_components

HISTOGRAM_PADDING = 0.01
"""Added to every weight before resampling, so that no interval is lost for good."""


def spacing_piecewise(t: Tensor) -> Tensor:
    """Half of [0, 1] for distances up to 1, the other half for all beyond, linear in disparity.

    t: >= 0, scene units. Returns values in [0, 1), same shape: t / 2 below 1, 1 - 1 / (2 t) above.
    Source: Nerfacto, arXiv:2302.04264, section 5 (piece-wise sampler).
    """
    return torch.where(t < 1.0, 0.5 * t, 1.0 - 0.5 / t.clamp_min(1.0))


def unspacing_piecewise(x: Tensor) -> Tensor:
    """The inverse of `spacing_piecewise`: x in [0, 1) to distances >= 0."""
    # The clamp keeps the branch that `where` drops from dividing by zero.
    return torch.where(x < 0.5, 2.0 * x, 0.5 / (1.0 - x.clamp_min(0.5)))


def spacing_uniform(t: Tensor) -> Tensor:
    """The identity: steps of one length. Source: NeRF, arXiv:2003.08934, eq. 2."""
    return t


def spacing_disparity(t: Tensor) -> Tensor:
    """1 / t for t > 0, its own inverse: even steps seem even to a camera, as in forward scenes."""
    return 1.0 / t


class Spacing(NamedTuple):
    """A monotone map of distances, even steps of which are taken, and its inverse."""

    forward: Callable[[Tensor], Tensor]
    inverse: Callable[[Tensor], Tensor]


SPACINGS: dict[str, Spacing] = {
    "piecewise": Spacing(spacing_piecewise, unspacing_piecewise),
    "uniform": Spacing(spacing_uniform, spacing_uniform),
    "disparity": Spacing(spacing_disparity, spacing_disparity),
}
"""By the name that options use."""


def t_from_s(s: Tensor, near: float, far: float, spacing: str = "piecewise") -> Tensor:
    """Distances of normalised positions: s = 0 is `near`, s = 1 is `far`. Same shape.

    near, far: scene units. spacing: one of `SPACINGS` or a plugin's. Raises NerfError `bad_config`
    unless 0 <= near < far < infinity, with near > 0 for `disparity`.
    """
    forward, inverse = _checked_spacing(spacing, near, far)
    first, last = forward(torch.tensor([near, far], dtype=torch.float64)).tolist()
    if spacing == "disparity":
        # first + s (last - first) would lose 1 / far beside 1 / near in float32.
        return inverse((1.0 - s) * first + s * last)
    return inverse(first + s * (last - first))


def _checked_spacing(spacing: str, near: float, far: float) -> Spacing:
    known: dict[str, Spacing] = SPACINGS
    if spacing not in known:
        known = SPACINGS | plugin_components("spacing")
    if spacing not in known:
        raise NerfError(
            "bad_config",
            f"There is no spacing {spacing!r}; allowed: {', '.join(known)}.",
            "Choose one of them.",
        )
    if not 0.0 <= near < far < math.inf or (spacing == "disparity" and near == 0.0):
        lowest = "0 < near" if spacing == "disparity" else "0 <= near"
        raise NerfError(
            "bad_config",
            f"Samples cannot lie from {near} to {far} with spacing {spacing!r}; "
            f"allowed: {lowest} < far < infinity.",
            "Change near and far, in scene units.",
        )
    return known[spacing]


def bin_midpoints(edges: Tensor) -> Tensor:
    """Midpoints [..., S] of edges [..., S + 1]."""
    return 0.5 * (edges[..., 1:] + edges[..., :-1])


def weights_from_density(density: Tensor, t_edges: Tensor) -> Tensor:
    """Chance that each ray ends in each interval: w_i = T_i (1 - exp(-sigma_i d_i)).

    density: [..., S], >= 0, per scene unit.
    t_edges: [..., S + 1], increasing, scene units along a unit ray.
    Returns [..., S] in [0, 1]; sums to at most 1.
    Source: NeRF, arXiv:2003.08934, eqs. 3 and 5.
    """
    thickness = density * (t_edges[..., 1:] - t_edges[..., :-1])
    passed = torch.cumsum(thickness[..., :-1], dim=-1)
    before = torch.cat([torch.zeros_like(thickness[..., :1]), passed], dim=-1)
    weights = torch.exp(-before) * -torch.expm1(-thickness)
    # An infinite density in an interval of no width is 0 * inf; such an interval holds nothing.
    return torch.nan_to_num(weights)


def sample_pdf(
    s_edges: Tensor,
    weights: Tensor,
    num_samples: int,
    *,
    jitter: Tensor | None = None,
    padding: float = HISTOGRAM_PADDING,
) -> Tensor:
    """New edges where the histogram has its mass, by inverting its cumulative sum.

    s_edges: [R, S + 1], increasing, S >= 1. weights: [R, S], >= 0, need not sum to 1.
    num_samples: intervals wanted, N.
    jitter: [R, 1] or [R, N + 1] uniform in [0, 1) for training; None puts the draws at the middle
        of their N + 1 equal shares.
    padding: added to every weight.
    Returns [R, N + 1], increasing, within the old edges, without a gradient.
    Source: Mip-NeRF 360, arXiv:2111.12077, section 3; NeRF, eq. 5 and "hierarchical sampling".
    """
    with torch.no_grad():
        num_edges = num_samples + 1
        padded = weights.detach() + padding
        pdf = padded / padded.sum(-1, keepdim=True)
        cdf = torch.cumsum(pdf[..., :-1], dim=-1)
        # A histogram of one interval has no inner edge: both ends are made like the pdf.
        none, all_of_it = torch.zeros_like(pdf[..., :1]), torch.ones_like(pdf[..., :1])
        cdf = torch.cat([none, cdf, all_of_it], dim=-1).clamp_max_(1.0)
        grid = torch.arange(num_edges, dtype=cdf.dtype, device=cdf.device) / num_edges
        offset = 0.5 if jitter is None else jitter
        draws = (grid + offset / num_edges).expand(*cdf.shape[:-1], num_edges).contiguous()
        # cdf[below] <= draw < cdf[above]
        above = torch.searchsorted(cdf, draws, right=True).clamp_(1, cdf.shape[-1] - 1)
        below = above - 1
        cdf_low, cdf_high = cdf.gather(-1, below), cdf.gather(-1, above)
        edge_low, edge_high = s_edges.gather(-1, below), s_edges.gather(-1, above)
        share = ((draws - cdf_low) / (cdf_high - cdf_low)).nan_to_num_(0.0).clamp_(0.0, 1.0)
        return torch.lerp(edge_low, edge_high, share)
