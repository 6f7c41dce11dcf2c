"""Weights, spacing and resampling against loops, inverses and limits."""

from __future__ import annotations

import math

import torch

from pipelines.nerf.intervals import (
    sample_pdf,
    spacing_piecewise,
    t_from_s,
    unspacing_piecewise,
    weights_from_density,
)


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _edges(rows: int, num: int, seed: int = 0) -> torch.Tensor:
    edges = torch.cumsum(_random(rows, num + 1, seed=seed) + 0.01, dim=-1)
    return (edges - edges[:, :1]) / (edges[:, -1:] - edges[:, :1])


def test_spacing_gives_half_of_the_range_to_distances_below_one() -> None:
    values = spacing_piecewise(torch.tensor([0.0, 0.5, 1.0, 2.0, 1000.0], dtype=torch.float64))
    assert torch.allclose(values, torch.tensor([0, 0.25, 0.5, 0.75, 0.9995], dtype=torch.float64))


def test_unspacing_inverts_spacing() -> None:
    t = torch.logspace(-3, 3, 200, dtype=torch.float64)
    assert torch.allclose(unspacing_piecewise(spacing_piecewise(t)), t, rtol=1e-9)


def test_ends_of_s_are_near_and_far() -> None:
    t = t_from_s(torch.tensor([0.0, 1.0], dtype=torch.float64), 0.05, 1000.0)
    assert torch.allclose(t, torch.tensor([0.05, 1000.0], dtype=torch.float64), rtol=1e-6)


def test_weights_equal_the_quadrature_loop() -> None:
    density, edges = 5 * _random(4, 9), 3 * _edges(4, 9, seed=1)
    weights = weights_from_density(density, edges)
    for ray in range(4):
        left = 1.0
        for i in range(9):
            alpha = 1.0 - math.exp(-float(density[ray, i] * (edges[ray, i + 1] - edges[ray, i])))
            assert math.isclose(float(weights[ray, i]), left * alpha, rel_tol=1e-12)
            left *= 1.0 - alpha


def test_weights_sum_to_one_minus_what_passes() -> None:
    density, edges = 5 * _random(4, 9), 3 * _edges(4, 9, seed=1)
    passed = torch.exp(-(density * (edges[:, 1:] - edges[:, :-1])).sum(-1))
    assert torch.allclose(weights_from_density(density, edges).sum(-1), 1.0 - passed)


def test_infinite_density_stops_the_ray_and_gives_no_nan() -> None:
    density = torch.tensor([[0.0, math.inf, 5.0, math.inf]])
    edges = torch.tensor([[0.0, 1.0, 2.0, 3.0, 3.0]])  # the last interval has no width
    expected = torch.tensor([[0.0, 1.0, 0.0, 0.0]])
    assert torch.equal(weights_from_density(density, edges), expected)


def test_weights_have_the_right_gradient() -> None:
    density = (2 * _random(2, 5)).requires_grad_()
    edges = _edges(2, 5, seed=3)
    assert torch.autograd.gradcheck(lambda d: weights_from_density(d, edges), (density,))


def test_resampling_inverts_the_cumulative_distribution() -> None:
    edges, weights = _edges(3, 8), _random(3, 8, seed=5)
    new = sample_pdf(edges, weights, 20)
    pdf = (weights + 0.01) / (weights + 0.01).sum(-1, keepdim=True)
    for ray in range(3):
        for k, place in enumerate(new[ray].tolist()):
            mass = 0.0
            for i in range(8):
                low, high = float(edges[ray, i]), float(edges[ray, i + 1])
                mass += float(pdf[ray, i]) * min(max((place - low) / (high - low), 0.0), 1.0)
            assert math.isclose(mass, (k + 0.5) / 21, abs_tol=1e-9)


def test_resampling_of_an_even_histogram_is_even() -> None:
    edges = torch.linspace(0, 1, 9, dtype=torch.float64)[None]
    new = sample_pdf(edges, torch.ones(1, 8, dtype=torch.float64), 4)
    assert torch.allclose(new, torch.tensor([[0.1, 0.3, 0.5, 0.7, 0.9]], dtype=torch.float64))


def test_jittered_edges_increase_and_stay_inside() -> None:
    edges, weights = _edges(50, 8), _random(50, 8, seed=5).pow(8)
    new = sample_pdf(edges, weights, 16, jitter=_random(50, 1, seed=6))
    assert bool((new[:, 1:] >= new[:, :-1]).all())
    assert bool((new >= edges[:, :1]).all() and (new <= edges[:, -1:]).all())


def test_jittered_edges_follow_the_histogram_on_average() -> None:
    edges = torch.linspace(0, 1, 3, dtype=torch.float64).expand(2000, 3)
    weights = torch.tensor([3.0, 1.0], dtype=torch.float64).expand(2000, 2)
    new = sample_pdf(edges, weights, 16, jitter=_random(2000, 1, seed=2), padding=0.0)
    assert abs(float((new < 0.5).double().mean()) - 0.75) < 0.005
