"""Where along the rays the networks are asked: evenly spaced first, then where mass was seen.

Symbols: R rays, S samples. Random numbers come from a `torch.Generator` in training; without one
the samples are the middle ones, as in rendering.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import (
    HISTOGRAM_PADDING,
    bin_midpoints,
    sample_pdf,
    t_from_s,
    weights_from_density,
)
from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.rays import Rays, RaySamples

DensityFunction = Callable[[Tensor], Tensor]
"""Scene points [..., 3] to densities [...], per scene unit."""


def weigh_density(density: Any, rays: Rays, samples: RaySamples) -> Tensor:
    """The weights [R, S] of a `DensityFunction` along rays."""
    return weights_from_density(density(samples.positions(rays)), samples.t_edges)


def uniform_jitter(
    num_rays: int, num_edges: int, single: bool, generator: torch.Generator | None, like: Tensor
) -> Tensor | None:
    """Uniform numbers [R, 1] (single) or [R, num_edges] in [0, 1); None without a generator."""
    if generator is None:
        return None
    shape = (num_rays, 1 if single else num_edges)
    return torch.rand(shape, generator=generator, device=like.device, dtype=like.dtype)


def sample_along(
    rays: Rays,
    num_samples: int,
    near: float,
    far: float,
    *,
    spacing: str = "piecewise",
    single_jitter: bool = True,
    generator: torch.Generator | None = None,
) -> RaySamples:
    """Intervals even in `s`, in the sense of a spacing function.

    near, far: scene units. spacing: one of `intervals.SPACINGS`; `piecewise` puts half of the
    intervals within distance 1. With a generator each edge moves between the midpoints beside it,
    by one number per ray (`single_jitter`) or one per edge.
    Source: Nerfacto, arXiv:2302.04264, section 5; NeRF, arXiv:2003.08934, eq. 2.
    """
    edges = torch.linspace(
        0.0, 1.0, num_samples + 1, dtype=rays.origins.dtype, device=rays.origins.device
    ).expand(len(rays), -1)
    jitter = uniform_jitter(len(rays), num_samples + 1, single_jitter, generator, edges)
    if jitter is not None:
        middles = bin_midpoints(edges)
        upper = torch.cat([middles, edges[:, -1:]], dim=-1)
        lower = torch.cat([edges[:, :1], middles], dim=-1)
        edges = torch.lerp(lower, upper, jitter.expand_as(edges))
    return RaySamples(s_edges=edges, t_edges=t_from_s(edges, near, far, spacing))


def anneal_exponent(step: int, anneal_steps: int, slope: float) -> float:
    """The power that weights are raised to before resampling: from 0 (flat) to 1 (as they are).

    b t / ((b - 1) t + 1) with t = step / anneal_steps in [0, 1] and slope b >= 0. With slope 0
    weights stay flat until the last of these steps is done.
    Source: Mip-NeRF 360, arXiv:2111.12077, eq. 18.
    """
    if step >= anneal_steps:
        return 1.0  # also for slope 0, where the formula is 0 / 0
    t = step / anneal_steps
    return slope * t / ((slope - 1.0) * t + 1.0)


def sample_proposals(
    rays: Rays,
    densities: Sequence[DensityFunction],
    num_proposal_samples: Sequence[int],
    num_final_samples: int,
    near: float,
    far: float,
    *,
    spacing: str = "piecewise",
    exponent: float | Tensor = 1.0,
    single_jitter: bool = True,
    generator: torch.Generator | None = None,
    weigh: Callable[[Any, Rays, RaySamples], Tensor] = weigh_density,
    resample: Callable[..., Tensor] = sample_pdf,
) -> tuple[RaySamples, list[RaySamples], list[Tensor]]:
    """Rounds of proposals, each drawing the next round's samples where it found mass.

    densities: one function per round, at least one; the same one may serve several rounds.
    num_proposal_samples: intervals of each round. near, far, spacing: see `sample_along`.
    exponent: see `anneal_exponent`; a tensor in a step that is captured.
    weigh, resample: compiled twins of `weigh_density` and `intervals.sample_pdf`, where the caller
    has them.
    Returns (final samples, samples of each round, weights [R, S] of each round). Positions carry no
    gradient to the rays: cameras are moved by the colour loss alone, and half of the proposals'
    backward pass is spared. Weights carry one to the networks unless under `torch.no_grad()`.
    Source: Mip-NeRF 360, arXiv:2111.12077, section 3. Raises NerfError `bad_config` where the
    numbers of functions and of rounds differ.
    """
    if not 1 <= len(densities) == len(num_proposal_samples):
        raise NerfError(
            "bad_config",
            f"There are {len(densities)} proposal densities and sample counts for "
            f"{len(num_proposal_samples)} rounds; allowed: one of each per round, at least one.",
            "Give a density function and a sample count for every round.",
        )
    fixed = rays.detach()
    samples = sample_along(
        fixed,
        num_proposal_samples[0],
        near,
        far,
        spacing=spacing,
        single_jitter=single_jitter,
        generator=generator,
    )
    rounds: list[RaySamples] = []
    weights: list[Tensor] = []
    wanted = (*num_proposal_samples[1:], num_final_samples)
    for density, num_next in zip(densities, wanted, strict=True):
        found = weigh(density, fixed, samples)
        rounds.append(samples)
        weights.append(found)
        jitter = uniform_jitter(len(rays), num_next + 1, single_jitter, generator, found)
        # At exponent 0 even a weight of 0 counts as 1, as torch.pow has it: a flat histogram.
        is_one = isinstance(exponent, float) and exponent == 1.0
        shape = found.detach() if is_one else found.detach().pow(exponent)
        edges = resample(samples.s_edges, shape, num_next, jitter=jitter)
        samples = RaySamples(s_edges=edges, t_edges=t_from_s(edges, near, far, spacing))
    return samples, rounds, weights


def sample_fine(
    rays: Rays,
    coarse: RaySamples,
    weights: Tensor,
    num_samples: int,
    near: float,
    far: float,
    *,
    include_coarse: bool = True,
    padding: float = HISTOGRAM_PADDING,
    spacing: str = "piecewise",
    single_jitter: bool = True,
    generator: torch.Generator | None = None,
) -> RaySamples:
    """NeRF's second round: more samples where the first one found mass.

    coarse: S intervals, made with the same near, far and spacing. weights: [R, S], theirs.
    num_samples: N > 0. include_coarse: keep the coarse edges and cut them further by N new ones,
    which gives S + N intervals; otherwise N intervals between new edges alone.
    Returns samples with increasing edges that carry no gradient.
    Source: NeRF, arXiv:2003.08934, section 5.2 (there with padding 1e-5).
    """
    num_edges = num_samples if include_coarse else num_samples + 1
    jitter = uniform_jitter(len(rays), num_edges, single_jitter, generator, weights)
    edges = sample_pdf(coarse.s_edges, weights, num_edges - 1, jitter=jitter, padding=padding)
    if include_coarse:
        edges = torch.cat([coarse.s_edges.detach(), edges], dim=-1).sort(dim=-1).values
    return RaySamples(s_edges=edges, t_edges=t_from_s(edges, near, far, spacing))
