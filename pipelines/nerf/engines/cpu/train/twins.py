"""What engine "fast" puts in the place of the plain parts while training on the CPU.

Everything here has its plain twin's values and gradients to float32 rounding, and falls back to the
twin by itself for parts that no kernel knows. Imported only where the fast engine is chosen: a
machine that trains on a GPU never loads the compiler.
"""

from __future__ import annotations

from collections.abc import Iterable

import torch
from torch import Tensor, nn

from pipelines.nerf.along_ray.samplers import weigh_density
from pipelines.nerf.engines.cpu.parts.intervals import CONTRACTION_CODES
from pipelines.nerf.engines.cpu.train.adam import FusedAdam
from pipelines.nerf.engines.cpu.train.field import render_field, supports
from pipelines.nerf.engines.cpu.train.losses import interlevel_loss_fast, sample_pdf_fast
from pipelines.nerf.engines.cpu.train.proposal import proposal_weights
from pipelines.nerf.networks.encodings import SphericalHarmonics
from pipelines.nerf.networks.fields import DensityField, NerfactoField
from pipelines.nerf.space.rays import Rays, RaySamples

interlevel_loss = interlevel_loss_fast
resample = sample_pdf_fast


def weigh(density: object, rays: Rays, samples: RaySamples) -> Tensor:
    """Twin of `samplers.weigh_density`, in one kernel for a `DensityField`."""
    if isinstance(density, DensityField):
        return proposal_weights(rays.origins, rays.directions, samples.t_edges, density)
    return weigh_density(density, rays, samples)


def knows_field(field: NerfactoField) -> bool:
    """Whether `shade` can take the field."""
    return (
        field.hash_grid is not None
        and isinstance(field.direction_encoding, SphericalHarmonics)
        and field.contraction in CONTRACTION_CODES
        and supports(field)
    )


def shade(
    field: NerfactoField,
    rays: Rays,
    samples: RaySamples,
    codes: Tensor | None,
    background: str,
    generator: torch.Generator | None,
) -> tuple[Tensor, Tensor]:
    """Colours [R, 3] and weights [R, S] of a field: density, weights, colour and `composite`."""
    noise = None
    if background == "random" and generator is not None:
        noise = torch.rand((len(rays), 3), generator=generator)
    return render_field(
        rays.origins, rays.directions, samples.t_edges, codes, field, background, noise=noise
    )


def make_adam(parameters: Iterable[nn.Parameter], lr: float, eps: float) -> torch.optim.Adam:
    """Adam in one pass over memory."""
    return FusedAdam(parameters, lr=lr, eps=eps)
