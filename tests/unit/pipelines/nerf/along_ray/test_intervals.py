"""Weights, spacing and resampling against loops, inverses and limits."""

from __future__ import annotations

import bisect
import math

import pytest
import torch

from pipelines.nerf.along_ray.intervals import (
    HISTOGRAM_PADDING,
    SPACINGS,
    sample_pdf,
    spacing_piecewise,
    t_from_s,
    unspacing_piecewise,
    weights_from_density,
)
from pipelines.nerf.errors import NerfError


def _random(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.rand(*shape, generator=torch.Generator().manual_seed(seed), dtype=torch.float64)


def _edges(rows: int, num: int, seed: int = 0) -> torch.Tensor:
    edges = torch.cumsum(_random(rows, num + 1, seed=seed) + 0.01, dim=-1)
    return (edges - edges[:, :1]) / (edges[:, -1:] - edges[:, :1])


def test_spacing_gives_half_of_the_range_to_distances_below_one() -> None:
    values = spacing_piecewise(torch.tensor([0.0, 0.5, 1.0, 2.0, 1000.0], dtype=torch.float64))
    assert torch.allclose(values, torch.tensor([0, 0.25, 0.5, 0.75, 0.9995], dtype=torch.float64))


@pytest.mark.parametrize("name", SPACINGS)
def test_the_inverse_of_a_spacing_gives_distances_back(name: str) -> None:
    t = torch.logspace(-3, 3, 200, dtype=torch.float64)
    spacing = SPACINGS[name]
    assert torch.allclose(spacing.inverse(spacing.forward(t)), t, rtol=1e-9)


def test_piecewise_is_the_spacing_unless_another_is_named() -> None:
    assert SPACINGS["piecewise"] == (spacing_piecewise, unspacing_piecewise)
    s = torch.linspace(0, 1, 50)
    assert torch.equal(t_from_s(s, 0.05, 1000.0), t_from_s(s, 0.05, 1000.0, "piecewise"))


@pytest.mark.parametrize("name", SPACINGS)
def test_ends_of_s_are_near_and_far(name: str) -> None:
    t = t_from_s(torch.tensor([0.0, 1.0], dtype=torch.float64), 0.05, 1000.0, name)
    assert torch.allclose(t, torch.tensor([0.05, 1000.0], dtype=torch.float64), rtol=1e-6)


def test_uniform_steps_have_one_length_and_disparity_steps_one_disparity() -> None:
    s = torch.linspace(0, 1, 5, dtype=torch.float64)
    even = t_from_s(s, 2.0, 6.0, "uniform")
    assert torch.allclose(even, torch.tensor([2.0, 3.0, 4.0, 5.0, 6.0], dtype=torch.float64))
    found = t_from_s(s, 0.5, 4.0, "disparity")
    for share, t in zip(s.tolist(), found.tolist(), strict=True):
        assert math.isclose(1.0 / t, (1.0 - share) / 0.5 + share / 4.0, rel_tol=1e-12)


def test_disparity_is_one_over_the_distance() -> None:
    t = torch.tensor([0.5, 4.0])
    assert SPACINGS["disparity"].forward(t).tolist() == [2.0, 0.25]


def test_float32_disparity_reaches_far_without_loss() -> None:
    t = t_from_s(torch.linspace(0, 1, 1001), 0.05, 1e6, "disparity")
    assert bool((t[1:] > t[:-1]).all())
    assert math.isclose(float(t[-1]), 1e6, rel_tol=1e-6)


@pytest.mark.parametrize(
    ("near", "far", "spacing", "problem"),
    [
        (0.0, 10.0, "disparity", "0 < near < far < infinity"),
        (0.1, math.inf, "disparity", "far < infinity"),
        (0.1, math.inf, "piecewise", "0 <= near < far < infinity"),
        (2.0, 1.0, "uniform", "from 2.0 to 1.0"),
        (-1.0, 1.0, "uniform", "0 <= near"),
        (0.1, 1.0, "logarithmic", "piecewise, uniform, disparity"),
    ],
)
def test_ranges_that_cannot_be_sampled_are_refused(
    near: float, far: float, spacing: str, problem: str
) -> None:
    with pytest.raises(NerfError, match=problem) as caught:
        t_from_s(torch.zeros(1), near, far, spacing)
    assert caught.value.code == "bad_config"


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


def _slow_resampling(edges: list[float], weights: list[float], draws: list[float]) -> list[float]:
    """The inverse of the cumulative histogram, one draw at a time."""
    total = sum(weight + HISTOGRAM_PADDING for weight in weights)
    sums = [0.0]
    for weight in weights:
        sums.append(sums[-1] + (weight + HISTOGRAM_PADDING) / total)
    places = []
    for draw in draws:
        i = min(bisect.bisect_right(sums, draw), len(weights)) - 1
        share = (draw - sums[i]) / (sums[i + 1] - sums[i])
        places.append(edges[i] + share * (edges[i + 1] - edges[i]))
    return places


@pytest.mark.parametrize("jitter_columns", [0, 1, 21])
def test_resampling_equals_the_loop(jitter_columns: int) -> None:
    edges, weights = _edges(6, 8, seed=7), _random(6, 8, seed=8).pow(4)
    jitter = _random(6, jitter_columns, seed=9) if jitter_columns else None
    found = sample_pdf(edges, weights, 20, jitter=jitter)
    for ray in range(6):
        offsets = [0.5] if jitter is None else jitter[ray].tolist()
        draws = [(k + offsets[k % len(offsets)]) / 21 for k in range(21)]
        expected = _slow_resampling(edges[ray].tolist(), weights[ray].tolist(), draws)
        assert found[ray].tolist() == pytest.approx(expected, rel=1e-10)


@pytest.mark.parametrize("jitter_columns", [0, 1, 5000])
def test_many_samples_reproduce_the_distribution(jitter_columns: int) -> None:
    edges, weights = _edges(4, 12, seed=3), _random(4, 12, seed=4).pow(6)
    jitter = _random(4, jitter_columns, seed=5) if jitter_columns else None
    found = sample_pdf(edges, weights, 4999, jitter=jitter)
    pdf = weights + HISTOGRAM_PADDING
    cdf = torch.cumsum(pdf / pdf.sum(-1, keepdim=True), dim=-1)
    for ray in range(4):
        # Kolmogorov and Smirnov's distance between the samples and the histogram, which is linear
        # between its edges. One draw in each of 5000 shares keeps it below one share.
        low, high, before = edges[ray, :-1], edges[ray, 1:], cdf[ray] - pdf[ray] / pdf[ray].sum()
        places = found[ray].sort().values
        i = torch.searchsorted(high, places).clamp(max=11)
        share = (places - low[i]) / (high[i] - low[i])
        expected = before[i] + share * (cdf[ray][i] - before[i])
        rank = torch.arange(5000, dtype=torch.float64) / 5000
        distance = torch.maximum((expected - rank).abs(), (expected - rank - 1 / 5000).abs())
        assert float(distance.max()) < 1.001 / 5000


def test_resampling_without_jitter_is_always_the_same() -> None:
    edges, weights = _edges(3, 8), _random(3, 8, seed=5)
    assert torch.equal(sample_pdf(edges, weights, 9), sample_pdf(edges, weights, 9))


@pytest.mark.parametrize("jitter_columns", [0, 1, 5])
def test_resampling_of_one_interval_cuts_it_evenly(jitter_columns: int) -> None:
    edges = torch.tensor([[0.25, 0.75], [0.0, 1.0]], dtype=torch.float64)
    jitter = _random(2, jitter_columns) if jitter_columns else None
    for weights in (torch.zeros(2, 1), torch.ones(2, 1)):
        new = sample_pdf(edges, weights.double(), 4, jitter=jitter)
        offsets = torch.full((2, 1), 0.5, dtype=torch.float64) if jitter is None else jitter
        draws = (torch.arange(5, dtype=torch.float64) + offsets) / 5
        assert torch.allclose(new, edges[:, :1] + draws * (edges[:, 1:] - edges[:, :1]))


def test_resampling_of_empty_intervals_finds_only_the_full_one() -> None:
    edges = torch.tensor([[0.0, 0.3, 0.4, 1.0]], dtype=torch.float64)
    weights = torch.tensor([[0.0, 1.0, 0.0]], dtype=torch.float64)
    new = sample_pdf(edges, weights, 50, padding=0.0)
    assert bool(((new >= 0.3) & (new <= 0.4)).all())
    first = sample_pdf(edges, weights, 50, jitter=torch.zeros(1, 1).double(), padding=0.0)[0, 0]
    assert float(first) == 0.3
