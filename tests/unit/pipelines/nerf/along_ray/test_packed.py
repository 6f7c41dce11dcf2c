"""Packed samples against loops over rays, and against rows of equal length."""

from __future__ import annotations

import math

import pytest
import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.along_ray.packed import (
    PackedSamples,
    packed_composite,
    packed_expected_depth,
    packed_light,
    packed_median_depth,
    packed_weights,
    sum_by_ray,
    sums_before,
)
from pipelines.nerf.along_ray.rendering import composite
from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.rays import Rays

COUNTS = (3, 0, 1, 5, 0)
"""Samples of each of five rays; the second and the last have none."""


def _ragged(dtype: torch.dtype = torch.float64) -> tuple[PackedSamples, Tensor]:
    """(samples with gaps between them, densities)."""
    generator = torch.Generator().manual_seed(0)
    ray = torch.repeat_interleave(torch.arange(len(COUNTS)), torch.tensor(COUNTS))
    start = torch.cat([torch.arange(float(count)) for count in COUNTS])
    length = 0.2 + 0.7 * torch.rand(len(ray), generator=generator)
    density = 3.0 * torch.rand(len(ray), generator=generator)
    samples = PackedSamples(ray, start.to(dtype), (start + length).to(dtype), len(COUNTS))
    return samples, density.to(dtype)


def _weights_by_loop(samples: PackedSamples, density: Tensor) -> list[list[float]]:
    """T_i (1 - exp(-tau_i)) of each ray, one sample after the other."""
    found: list[list[float]] = [[] for _ in range(samples.num_rays)]
    light = [1.0] * samples.num_rays
    for ray, length, sigma in zip(
        samples.ray.tolist(), samples.lengths.tolist(), density.tolist(), strict=True
    ):
        passed = math.exp(-sigma * length)
        found[ray].append(light[ray] * (1.0 - passed))
        light[ray] *= passed
    return found


def test_sums_of_each_ray_are_those_of_a_loop() -> None:
    samples, values = _ragged()
    before, total = sums_before(values, samples), sum_by_ray(values, samples)
    for ray in range(samples.num_rays):
        mine = values[samples.ray == ray].tolist()
        assert total[ray].item() == pytest.approx(sum(mine))
        expected = [sum(mine[:i]) for i in range(len(mine))]
        assert before[samples.ray == ray].tolist() == pytest.approx(expected)
    assert samples.counts().tolist() == list(COUNTS)


def test_weights_are_those_of_a_loop() -> None:
    samples, density = _ragged()
    expected = [weight for ray in _weights_by_loop(samples, density) for weight in ray]
    assert packed_weights(density, samples).tolist() == pytest.approx(expected, abs=1e-12)


def test_weights_and_light_that_is_left_sum_to_one() -> None:
    samples, density = _ragged()
    light, alpha = packed_light(density, samples)
    last = torch.cumsum(samples.counts(), 0) - 1
    for ray, count in enumerate(COUNTS):
        if count:
            left = light[last[ray]] * (1.0 - alpha[last[ray]])
            total = sum_by_ray(light * alpha, samples)[ray]
            assert float(total + left) == pytest.approx(1.0)


def test_rows_of_equal_length_give_what_the_unpacked_formulas_give() -> None:
    generator = torch.Generator().manual_seed(1)
    edges = torch.rand(6, 9, generator=generator, dtype=torch.float64).cumsum(-1)
    density = 4.0 * torch.rand(6, 8, generator=generator, dtype=torch.float64)
    colors = torch.rand(6, 8, 3, generator=generator, dtype=torch.float64)
    ray = torch.arange(6).repeat_interleave(8)
    samples = PackedSamples(ray, edges[:, :-1].reshape(-1), edges[:, 1:].reshape(-1), 6)
    weights = packed_weights(density.reshape(-1), samples)
    dense = weights_from_density(density, edges)
    assert torch.allclose(weights, dense.reshape(-1), atol=1e-12)
    for background in ("last_sample", "black", "white"):
        packed = packed_composite(colors.reshape(-1, 3), weights, samples, background)
        assert torch.allclose(packed, composite(colors, dense, background), atol=1e-12)


def test_an_opaque_ray_does_not_disturb_the_next() -> None:
    # A running sum in float32 would have no digits left behind 1e9.
    ray = torch.tensor([0, 0, 1, 1])
    start = torch.tensor([0.0, 1.0, 0.0, 1.0])
    samples = PackedSamples(ray, start, start + 1.0, 2)
    weights = packed_weights(torch.tensor([1e9, torch.inf, 0.5, 0.25]), samples)
    first = 1.0 - math.exp(-0.5)
    second = math.exp(-0.5) * (1.0 - math.exp(-0.25))
    assert weights.tolist() == pytest.approx([1.0, 0.0, first, second], abs=1e-7)


def test_gradients_of_weights_are_those_of_differences() -> None:
    samples, density = _ragged()
    density = density.requires_grad_()
    assert torch.autograd.gradcheck(lambda sigma: packed_weights(sigma, samples), (density,))


def test_depths_are_those_of_a_loop() -> None:
    samples, density = _ragged()
    weights = packed_weights(density, samples)
    median = packed_median_depth(weights, samples, 99.0).tolist()
    mean = packed_expected_depth(weights, samples, 99.0).tolist()
    for ray, found in enumerate(_weights_by_loop(samples, density)):
        middles = samples.t_mid[samples.ray == ray].tolist()
        reached = [m for i, m in enumerate(middles) if sum(found[: i + 1]) >= 0.5]
        assert median[ray] == pytest.approx(reached[0] if reached else 99.0)
        moment = sum(w * m for w, m in zip(found, middles, strict=True))
        assert mean[ray] == pytest.approx(moment / sum(found) if found else 99.0)


def test_behind_a_ray_without_samples_lies_the_background() -> None:
    samples, density = _ragged()
    colors = torch.ones(len(samples), 3, dtype=torch.float64)
    weights = packed_weights(density, samples)
    shown = {
        name: packed_composite(colors, weights, samples, name)[1].tolist()
        for name in ("white", "black", "last_sample", "random")
    }
    assert shown == {
        "white": [1.0] * 3,
        "black": [0.0] * 3,
        "last_sample": [0.0] * 3,
        "random": [0.0] * 3,
    }
    noisy = [
        packed_composite(
            colors, weights, samples, "random", generator=torch.Generator().manual_seed(seed)
        )
        for seed in (0, 0, 1)
    ]
    assert torch.equal(noisy[0], noisy[1])
    assert not torch.equal(noisy[0], noisy[2])
    with pytest.raises(NerfError, match="last_sample, black, white, random"):
        packed_composite(colors, weights, samples, "pink")


def test_without_any_sample_every_ray_shows_the_background() -> None:
    nothing = torch.zeros(0)
    samples = PackedSamples(nothing.long(), nothing, nothing, 2)
    weights = packed_weights(nothing, samples)
    assert torch.equal(
        packed_composite(torch.zeros(0, 3), weights, samples, "white"), torch.ones(2, 3)
    )
    assert packed_composite(torch.zeros(0, 3), weights, samples, "last_sample").sum() == 0.0
    assert packed_median_depth(weights, samples, 7.0).tolist() == [7.0, 7.0]
    assert packed_expected_depth(weights, samples, 7.0).tolist() == [7.0, 7.0]


def test_positions_lie_on_their_rays() -> None:
    samples, _ = _ragged(torch.float32)
    origins, directions = torch.randn(5, 3), torch.nn.functional.normalize(torch.randn(5, 3), dim=1)
    points = samples.positions(Rays(origins, directions, torch.zeros(5, dtype=torch.int64)))
    for point, ray, t in zip(points, samples.ray, samples.t_mid, strict=True):
        assert torch.allclose(point, origins[ray] + t * directions[ray], atol=1e-6)
