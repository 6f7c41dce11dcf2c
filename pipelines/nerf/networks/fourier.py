"""Fourier features: a coordinate as sines and cosines of many wavelengths, plain and integrated.

Symbols: D inputs, K frequencies f_k = 2^e_k with evenly spaced exponents e_k, mu and Sigma the mean
and covariance of a Gaussian in the space of the inputs. Convention: an input x enters as
2 pi f_k x, so that the wave of frequency 2^0 goes once through the unit interval. NeRF's gamma has
pi 2^k p for p in [-1, 1]; with x = (p + 1) / 2 that is the same up to the sign of the terms of 2^0.
Turning a frustum into a Gaussian is left to `rays`, bounding the world to `contraction`.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from pipelines.nerf.errors import NerfError


class FourierFeatures(nn.Module):
    """Fixed sines and cosines of every input; nothing here is trained.

    num_inputs: D. num_frequencies: K >= 1.
    min_exponent, max_exponent: e_1 and e_K. NeRF takes 0 to K - 1; the reference implementation
        takes 0 to 8 for its 10 frequencies. With K = 1 only the first counts.
    include_input: append the input itself, without which x and x + 2^-min_exponent look alike.
    Source: NeRF, arXiv:2003.08934, eq. 4; integrated: Mip-NeRF, arXiv:2103.13415, section 3.1,
    eqs. 13 to 16.
    """

    frequencies: Tensor

    def __init__(
        self,
        num_inputs: int,
        num_frequencies: int,
        min_exponent: float,
        max_exponent: float,
        include_input: bool,
    ) -> None:
        super().__init__()
        if num_inputs < 1 or num_frequencies < 1 or max_exponent < min_exponent:
            raise NerfError(
                "bad_config",
                f"Fourier features of {num_inputs} inputs cannot have {num_frequencies} "
                f"frequencies with exponents from {min_exponent:g} to {max_exponent:g}.",
                "Give at least one input and one frequency, and the smaller exponent first.",
            )
        self.num_inputs = num_inputs
        self.include_input = include_input
        exponents = torch.linspace(min_exponent, max_exponent, num_frequencies, dtype=torch.float64)
        frequencies = torch.exp2(exponents).to(torch.get_default_dtype())
        self.register_buffer("frequencies", frequencies, persistent=False)

    @property
    def num_outputs(self) -> int:
        """Values per point: 2 D K, and D more with the input."""
        doubled = 2 * self.num_inputs * len(self.frequencies)
        return doubled + (self.num_inputs if self.include_input else 0)

    def forward(self, mean: Tensor, covariance: Tensor | None = None) -> Tensor:
        """The features of points, or their mean over Gaussians.

        mean: [..., D], unit space. covariance: None for points; [..., D] its diagonal or
            [..., D, D] the whole, of which only the diagonal matters (each wave sees one axis).
        Returns [..., num_outputs]: sines (input by input, frequencies ascending), cosines in the
        same order, inputs. E[sin(a x)] = exp(-a^2 Sigma_ii / 2) sin(a mu_i), a = 2 pi f_k.
        """
        turns = mean[..., None] * self.frequencies
        # Whole turns change nothing but cost float32 its digits: sin(2 pi 512 x) would keep three.
        angle = 2.0 * math.pi * (turns - turns.detach().round())
        waves = torch.stack([torch.sin(angle), torch.cos(angle)], dim=-3)  # [..., 2, D, K]
        if covariance is not None:
            variance = _diagonal(covariance, mean)[..., None]
            damping = torch.exp(-2.0 * (math.pi * self.frequencies).square() * variance)
            waves = waves * damping[..., None, :, :]
        features = waves.flatten(-3)
        return torch.cat([features, mean], dim=-1) if self.include_input else features


def _diagonal(covariance: Tensor, mean: Tensor) -> Tensor:
    """The variances [..., D] of a covariance given as [..., D] or [..., D, D]."""
    if covariance.dim() == mean.dim():
        return covariance
    if covariance.dim() == mean.dim() + 1 and covariance.shape[-1] == covariance.shape[-2]:
        return covariance.diagonal(dim1=-2, dim2=-1)
    raise ValueError(
        f"a covariance of means {list(mean.shape)} has the same shape or one axis more, "
        f"got {list(covariance.shape)}"
    )
