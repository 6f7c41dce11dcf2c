"""Gaussians of frustums against integrals over the cone, their limits and their gradients."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.space.frustums import cone_radius, frustum_gaussians

ORIGIN = torch.tensor([0.3, -1.0, 2.0], dtype=torch.float64)
DIRECTION = torch.nn.functional.normalize(
    torch.tensor([2.0, -1.0, 0.5], dtype=torch.float64), dim=0
)


def _one(start: float, end: float, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    found = frustum_gaussians(
        ORIGIN[None],
        DIRECTION[None],
        torch.tensor([[start, end]], dtype=torch.float64),
        torch.tensor([radius], dtype=torch.float64),
    )
    return found.mean[0, 0], found.covariance[0, 0]


def _integrated(start: float, end: float, radius: float) -> tuple[torch.Tensor, torch.Tensor]:
    """Mean and covariance by quadrature over the volume, exact for the polynomials in it."""
    nodes, weights = np.polynomial.legendre.leggauss(12)
    nodes, weights = 0.5 * (nodes + 1.0), 0.5 * weights  # on [0, 1]
    angles = np.arange(12) * (2.0 * math.pi / 12)
    d = DIRECTION.numpy()
    u = np.cross(d, [0.0, 0.0, 1.0])
    u /= np.linalg.norm(u)
    v = np.cross(d, u)
    mass, places = [], []
    for t, t_weight in zip(start + (end - start) * nodes, weights, strict=True):
        for share, share_weight in zip(nodes, weights, strict=True):
            rho = share * radius * t
            for angle in angles:
                # dV = rho drho dangle dt, with drho = radius t dshare
                mass.append(t_weight * share_weight * rho * radius * t)
                across = math.cos(angle) * u + math.sin(angle) * v
                places.append(ORIGIN.numpy() + t * d + rho * across)
    share_of, points = np.array(mass) / np.sum(mass), np.array(places)
    mean = share_of @ points
    covariance = (points - mean).T @ ((points - mean) * share_of[:, None])
    return torch.from_numpy(mean), torch.from_numpy(covariance)


@pytest.mark.parametrize(
    ("start", "end", "radius"),
    [
        (0.5, 1.5, 0.2),
        (0.0, 1.0, 0.05),
        (2.0, 2.01, 0.01),
        (1.0, 40.0, 0.003),
        (900.0, 1000.0, 1.0),
    ],
)
def test_mean_and_covariance_are_those_of_the_volume(
    start: float, end: float, radius: float
) -> None:
    mean, covariance = _one(start, end, radius)
    expected_mean, expected_covariance = _integrated(start, end, radius)
    assert torch.allclose(mean, expected_mean, rtol=1e-11)
    scale = float(expected_covariance.abs().max())
    assert float((covariance - expected_covariance).abs().max()) < 1e-9 * scale


def test_the_formula_is_that_of_mip_nerf() -> None:
    start, end, radius = 0.7, 1.9, 0.04
    mu, h = (start + end) / 2, (end - start) / 2
    t_mean = mu + 2 * mu * h**2 / (3 * mu**2 + h**2)
    t_var = h**2 / 3 - (4 / 15) * h**4 * (12 * mu**2 - h**2) / (3 * mu**2 + h**2) ** 2
    r_var = radius**2 * (mu**2 / 4 + 5 * h**2 / 12 - 4 * h**4 / (15 * (3 * mu**2 + h**2)))
    mean, covariance = _one(start, end, radius)
    along = torch.outer(DIRECTION, DIRECTION)
    expected = t_var * along + r_var * (torch.eye(3, dtype=torch.float64) - along)
    assert torch.allclose(mean, ORIGIN + t_mean * DIRECTION, rtol=1e-12)
    assert torch.allclose(covariance, expected, rtol=1e-12)


def test_a_cone_without_radius_is_a_line() -> None:
    _, covariance = _one(1.0, 3.0, 0.0)
    values = torch.linalg.eigvalsh(covariance)
    assert float(values[:2].abs().max()) < 1e-15
    # The share of a thin cone at t grows with t^2: moments of t^2 on [1, 3].
    moment = [(3.0 ** (n + 3) - 1.0) / (n + 3) for n in range(3)]
    expected = moment[2] / moment[0] - (moment[1] / moment[0]) ** 2
    assert float(values[2]) == pytest.approx(expected, rel=1e-12)


def test_a_frustum_without_length_is_a_disc() -> None:
    mean, covariance = _one(2.0, 2.0, 0.1)
    assert torch.allclose(mean, ORIGIN + 2.0 * DIRECTION)
    values = torch.linalg.eigvalsh(covariance)
    # A disc of radius 0.2 has the variance 0.2^2 / 4 in each direction across.
    assert torch.allclose(values, torch.tensor([0.0, 0.01, 0.01], dtype=torch.float64), atol=1e-15)


def test_a_frustum_of_no_size_at_the_camera_is_a_point() -> None:
    mean, covariance = _one(0.0, 0.0, 0.1)
    assert torch.equal(mean, ORIGIN)
    assert torch.equal(covariance, torch.zeros(3, 3, dtype=torch.float64))


def test_float32_variances_stay_positive_far_out() -> None:
    edges = torch.logspace(-2, 5, 200)[None]
    found = frustum_gaussians(
        torch.zeros(1, 3), torch.tensor([[0.0, 0.0, 1.0]]), edges, torch.tensor([1e-3])
    )
    exact = frustum_gaussians(
        torch.zeros(1, 3).double(),
        torch.tensor([[0.0, 0.0, 1.0]]).double(),
        edges.double(),
        torch.tensor([1e-3]).double(),
    )
    for axis in range(3):
        variance = found.covariance[0, :, axis, axis]
        assert torch.allclose(variance.double(), exact.covariance[0, :, axis, axis], rtol=1e-4)


def test_radius_gives_a_disc_of_the_pixels_area() -> None:
    area = torch.tensor([1e-6, 4e-4], dtype=torch.float64)
    assert torch.allclose(math.pi * cone_radius(area) ** 2, area)


def test_gaussians_have_the_right_gradient() -> None:
    generator = torch.Generator().manual_seed(0)
    origins = torch.randn(2, 3, generator=generator, dtype=torch.float64).requires_grad_()
    directions = torch.randn(2, 3, generator=generator, dtype=torch.float64).requires_grad_()
    steps = torch.rand(2, 4, generator=generator, dtype=torch.float64)
    edges = torch.cumsum(steps, dim=-1).requires_grad_()
    radius = torch.tensor([0.1, 0.02], dtype=torch.float64, requires_grad=True)

    def moments(*inputs: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        found = frustum_gaussians(*inputs)
        return found.mean, found.covariance

    assert torch.autograd.gradcheck(moments, (origins, directions, edges, radius))
