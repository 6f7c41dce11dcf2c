"""Where along the rays the networks are asked: piece-wise first, then where proposals see mass.

Symbols: R rays, S samples. Random numbers come from a `torch.Generator` in training; without one
the samples are the middle ones, as in rendering.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from pipelines.nerf.intervals import bin_midpoints, sample_pdf, t_from_s, weights_from_density
from pipelines.nerf.rays import Rays, RaySamples

DensityFunction = Callable[[Tensor], Tensor]
"""Scene points [..., 3] to densities [...], per scene unit."""


def uniform_jitter(
    num_rays: int, num_edges: int, single: bool, generator: torch.Generator | None, like: Tensor
) -> Tensor | None:
    """Uniform numbers [R, 1] (single) or [R, num_edges] in [0, 1); None without a generator."""
    if generator is None:
        return None
    shape = (num_rays, 1 if single else num_edges)
    return torch.rand(shape, generator=generator, device=like.device, dtype=like.dtype)


def sample_piecewise(
    rays: Rays,
    num_samples: int,
    near: float,
    far: float,
    *,
    single_jitter: bool = True,
    generator: torch.Generator | None = None,
) -> RaySamples:
    """Intervals even in `s`: half of them within distance 1.

    near, far: scene units. With a generator each edge moves between the midpoints beside it, by
    one number per ray (`single_jitter`) or one per edge.
    Source: Nerfacto, arXiv:2302.04264, section 5.
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
    return RaySamples(s_edges=edges, t_edges=t_from_s(edges, near, far))


def anneal_exponent(step: int, anneal_steps: int, slope: float) -> float:
    """The power that weights are raised to before resampling: from 0 (flat) to 1 (as they are).

    b t / ((b - 1) t + 1) with t = step / anneal_steps in [0, 1] and slope b.
    Source: Mip-NeRF 360, arXiv:2111.12077, eq. 18.
    """
    if anneal_steps <= 0:
        return 1.0
    t = min(max(step / anneal_steps, 0.0), 1.0)
    return slope * t / ((slope - 1.0) * t + 1.0)


def sample_proposals(
    rays: Rays,
    densities: Sequence[DensityFunction],
    num_proposal_samples: Sequence[int],
    num_final_samples: int,
    near: float,
    far: float,
    *,
    exponent: float = 1.0,
    single_jitter: bool = True,
    generator: torch.Generator | None = None,
) -> tuple[RaySamples, list[RaySamples], list[Tensor]]:
    """Rounds of proposals, each drawing the next round's samples where it found mass.

    densities: one function per round. exponent: see `anneal_exponent`.
    Returns (final samples, samples of each round, weights [R, S] of each round). Positions carry no
    gradient to the rays: cameras are moved by the colour loss alone, and half of the proposals'
    backward pass is spared. Weights carry one to the networks unless under `torch.no_grad()`.
    Source: Mip-NeRF 360, arXiv:2111.12077, section 3.
    """
    fixed = rays.detach()
    samples = sample_piecewise(
        fixed,
        num_proposal_samples[0],
        near,
        far,
        single_jitter=single_jitter,
        generator=generator,
    )
    rounds: list[RaySamples] = []
    weights: list[Tensor] = []
    wanted = (*num_proposal_samples[1:], num_final_samples)
    for density, num_next in zip(densities, wanted, strict=True):
        found = weights_from_density(density(samples.positions(fixed)), samples.t_edges)
        rounds.append(samples)
        weights.append(found)
        jitter = uniform_jitter(len(rays), num_next + 1, single_jitter, generator, found)
        # At exponent 0 even a weight of 0 counts as 1, as torch.pow has it: a flat histogram.
        shape = found.detach() if exponent == 1.0 else found.detach().pow(exponent)
        edges = sample_pdf(samples.s_edges, shape, num_next, jitter=jitter)
        samples = RaySamples(s_edges=edges, t_edges=t_from_s(edges, near, far))
    return samples, rounds, weights
