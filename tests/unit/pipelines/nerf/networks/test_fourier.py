"""Fourier features against their formula, and integrated ones against quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.fourier import FourierFeatures


def _points(num: int, dims: int) -> torch.Tensor:
    generator = torch.Generator().manual_seed(num + dims)
    return torch.rand(num, dims, generator=generator, dtype=torch.float64) * 2.0 - 0.5


def _gaussians(num: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Means [num, 3] and full covariances [num, 3, 3] with correlated axes."""
    generator = torch.Generator().manual_seed(7)
    roots = 0.04 * torch.randn(num, 3, 3, generator=generator, dtype=torch.float64)
    return _points(num, 3), roots @ roots.transpose(-1, -2)


def test_features_follow_the_formula_in_the_stated_order() -> None:
    encoding = FourierFeatures(2, 3, 0.0, 2.0, include_input=True).double()
    points = _points(6, 2)
    for point, found in zip(points.tolist(), encoding(points).tolist(), strict=True):
        angles = [2.0 * math.pi * 2.0**k * value for value in point for k in range(3)]
        expected = [math.sin(a) for a in angles] + [math.cos(a) for a in angles] + point
        assert len(expected) == encoding.num_outputs == 14
        assert found == pytest.approx(expected, abs=1e-12)


def test_exponents_are_evenly_spaced() -> None:
    # As the reference implementation takes them: ten frequencies from 2^0 to 2^8.
    encoding = FourierFeatures(1, 10, 0.0, 8.0, include_input=False)
    point = 0.3
    expected = [math.sin(2.0 * math.pi * 2.0 ** (8.0 * k / 9.0) * point) for k in range(10)]
    found = encoding(torch.tensor([point])).tolist()
    assert encoding.num_outputs == 20
    assert found[:10] == pytest.approx(expected, abs=1e-4)


def test_points_of_the_cube_get_the_paper_s_features_up_to_the_lowest_sign() -> None:
    # NeRF, eq. 4: sin(2^k pi p), cos(2^k pi p) with p in [-1, 1].
    encoding = FourierFeatures(1, 4, 0.0, 3.0, include_input=False).double()
    p = 0.37
    found = encoding(torch.tensor([0.5 * (p + 1.0)], dtype=torch.float64)).tolist()
    signs = [-1.0, 1.0, 1.0, 1.0]
    sines = [sign * math.sin(2.0**k * math.pi * p) for k, sign in enumerate(signs)]
    cosines = [sign * math.cos(2.0**k * math.pi * p) for k, sign in enumerate(signs)]
    assert found == pytest.approx(sines + cosines, abs=1e-12)


def test_high_frequencies_keep_their_digits_in_single_precision() -> None:
    encoding = FourierFeatures(1, 1, 16.0, 16.0, include_input=False)
    points = torch.rand(1000, 1, generator=torch.Generator().manual_seed(0))
    exact = torch.sin(2.0 * math.pi * 2.0**16 * points.double())
    assert (encoding(points)[:, :1] - exact).abs().max() < 1e-6


def test_integrated_features_equal_gauss_hermite_quadrature() -> None:
    encoding = FourierFeatures(3, 4, 0.0, 3.0, include_input=True).double()
    mean, covariance = _gaussians(5)
    found = encoding(mean, covariance)
    # E[f(x)] over a Gaussian in 3 dimensions, with x = mean + chol(cov) z: 40^3 nodes.
    nodes, weights = np.polynomial.hermite_e.hermegauss(40)
    z = np.stack(np.meshgrid(nodes, nodes, nodes, indexing="ij"), -1).reshape(-1, 3)
    w = np.einsum("i,j,k->ijk", weights, weights, weights).reshape(-1) / (2 * np.pi) ** 1.5
    for ray in range(5):
        root = np.linalg.cholesky(covariance[ray].numpy())
        x = mean[ray].numpy() + z @ root.T
        angles = 2.0 * np.pi * x[:, :, None] * 2.0 ** np.arange(4)
        values = np.concatenate(
            [np.sin(angles).reshape(-1, 12), np.cos(angles).reshape(-1, 12), x], axis=-1
        )
        assert np.abs(found[ray].numpy() - w @ values).max() < 1e-9


def test_a_diagonal_covariance_is_the_diagonal_of_the_full_one() -> None:
    encoding = FourierFeatures(3, 4, 0.0, 3.0, include_input=False).double()
    mean, covariance = _gaussians(5)
    diagonal = torch.stack([covariance[:, axis, axis] for axis in range(3)], dim=-1)
    assert torch.equal(encoding(mean, diagonal), encoding(mean, covariance))


def test_a_vanishing_covariance_gives_the_plain_features() -> None:
    encoding = FourierFeatures(3, 6, 0.0, 5.0, include_input=True).double()
    mean, covariance = _gaussians(5)
    assert torch.equal(encoding(mean, 0.0 * covariance), encoding(mean))
    assert torch.allclose(encoding(mean, 1e-10 * covariance), encoding(mean), atol=1e-6)


def test_a_wide_gaussian_shows_no_wave_but_its_mean() -> None:
    encoding = FourierFeatures(3, 2, 0.0, 1.0, include_input=True).double()
    mean = _points(4, 3)
    features = encoding(mean, torch.full_like(mean, 100.0))
    assert features[:, :12].abs().max() < 1e-300
    assert torch.equal(features[:, 12:], mean)


def test_gradients_are_those_of_the_values() -> None:
    encoding = FourierFeatures(3, 3, 0.0, 2.0, include_input=True).double()
    mean, covariance = _gaussians(3)
    inputs = (mean.requires_grad_(), covariance.requires_grad_())
    assert torch.autograd.gradcheck(encoding, inputs)
    assert torch.autograd.gradgradcheck(encoding, (mean,))


def test_leading_shapes_are_kept() -> None:
    encoding = FourierFeatures(3, 4, 0.0, 3.0, include_input=True).double()
    mean, covariance = _gaussians(6)
    stacked = encoding(mean.reshape(2, 3, 3), covariance.reshape(2, 3, 3, 3))
    assert torch.equal(stacked[1, 2], encoding(mean[5], covariance[5]))


def test_a_covariance_of_another_shape_is_refused() -> None:
    encoding = FourierFeatures(3, 4, 0.0, 3.0, include_input=True)
    with pytest.raises(ValueError, match=r"got \[5, 3, 3, 3\]"):
        encoding(torch.zeros(5, 3), torch.zeros(5, 3, 3, 3))


@pytest.mark.parametrize("arguments", [(0, 4, 0.0, 3.0), (3, 0, 0.0, 3.0), (3, 4, 2.0, 1.0)])
def test_features_that_cannot_be_are_refused(arguments: tuple[int, int, float, float]) -> None:
    with pytest.raises(NerfError) as caught:
        FourierFeatures(*arguments, include_input=True)
    assert caught.value.code == "bad_config"
