"""Where along a ray to look when its depth is known: around the surface, and a little before it.

A ray that looks for its surface takes two rounds of proposals and two dozen samples; one that knows
takes eight. So a step of equal cost learns from several times as many pixels. Samples before the
surface keep space free there; nothing is asked behind it.
After the depth-guided sampling of Roessle et al., "Dense Depth Priors for Neural Radiance Fields",
arXiv:2112.03288, section 4.2, and DONeRF, arXiv:2103.03231; there beside a ray's other samples,
here in steps of their own, so that no sample at all is spent on looking.
"""

from __future__ import annotations

import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import spacing_piecewise, unspacing_piecewise
from pipelines.nerf.space.rays import RaySamples


def samples_around(
    distances: Tensor,
    near: float,
    num_free: int,
    num_near: int,
    spread: float,
    generator: torch.Generator,
) -> RaySamples:
    """Intervals of rays whose surfaces are known: F from `near` to a little before, N around.

    distances: [R], scene units along the unit rays, each above near / (1 - spread). spread: s, with
    N intervals of equal length between D (1 - s) and D (1 + s). The F before them are even in
    `spacing_piecewise`. Edges between F move by random numbers each, those between N all by the
    same part of an interval, the last one too.
    Returns t_edges [R, F + N + 1], increasing, without a gradient; s_edges are the same, as nobody
    reads them.
    """
    distances = distances.detach()[:, None]
    first = distances * (1.0 - spread)
    steps = torch.arange(num_free + 1, device=distances.device)
    moved = steps + _drawn((len(distances), num_free + 1), generator, distances) - 0.5
    share = torch.where((steps == 0) | (steps == num_free), steps.to(moved.dtype), moved) / num_free
    begin = spacing_piecewise(torch.full_like(distances, near))
    before = unspacing_piecewise(begin + (spacing_piecewise(first) - begin) * share)
    places = torch.arange(1, num_near + 1, device=distances.device)
    within = (places + _drawn((len(distances), 1), generator, distances) - 0.5) / num_near
    around = first + 2.0 * spread * distances * within
    edges = torch.cat([before[:, :-1], first, around], dim=-1)
    return RaySamples(s_edges=edges, t_edges=edges)


def _drawn(shape: tuple[int, int], generator: torch.Generator, like: Tensor) -> Tensor:
    """Uniform in [0, 1)."""
    return torch.rand(shape, generator=generator, device=like.device, dtype=like.dtype)
