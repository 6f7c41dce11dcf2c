"""Samples of rays whose depth is known."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.along_ray.guided import samples_around
from pipelines.nerf.along_ray.intervals import spacing_piecewise

NEAR, FREE, AROUND = 0.05, 3, 5


def drawn(distances: torch.Tensor, spread: float, seed: int = 0) -> torch.Tensor:
    generator = torch.Generator().manual_seed(seed)
    return samples_around(distances, NEAR, FREE, AROUND, spread, generator).t_edges


@pytest.mark.parametrize("spread", [0.3, 0.1, 0.02])
def test_edges_rise_from_the_nearest_sample_to_behind_the_surface(spread: float) -> None:
    distances = torch.logspace(-1, 2, 1000)
    edges = drawn(distances, spread)
    assert edges.shape == (1000, FREE + AROUND + 1)
    assert (edges[:, 1:] > edges[:, :-1]).all()
    assert torch.allclose(edges[:, 0], torch.full_like(distances, NEAR))
    assert torch.allclose(edges[:, FREE], distances * (1.0 - spread), rtol=1e-5)
    beyond = edges[:, -1] / distances - 1.0
    half = spread / AROUND  # half of an interval around the surface
    assert beyond.min() > spread - half - 1e-5
    assert beyond.max() < spread + half + 1e-5


def test_intervals_around_the_surface_are_alike_and_move() -> None:
    distances = torch.full((2000,), 2.0)
    around = drawn(distances, 0.1)[:, FREE:]
    widths = around[:, 2:] - around[:, 1:-1]
    assert torch.allclose(widths, torch.full_like(widths, 2.0 * 0.1 * 2.0 / AROUND), atol=1e-6)
    ends = around[:, -1]
    assert 0.9 * 0.08 < float(ends.amax() - ends.amin()) <= 0.08 + 1e-6
    assert float(ends.mean()) == pytest.approx(2.2, abs=2e-3)


def test_samples_before_the_surface_are_even_where_rays_are_sampled_evenly() -> None:
    distances = torch.full((4000,), 8.0)
    inner = spacing_piecewise(drawn(distances, 0.1)[:, 1:FREE])
    first, last = spacing_piecewise(torch.tensor([NEAR, 7.2])).tolist()
    share = (inner - first) / (last - first)
    assert share.mean(dim=0).tolist() == pytest.approx([1 / 3, 2 / 3], abs=0.01)
    # Each edge moves by itself, by up to half an interval.
    assert share.std(dim=0).tolist() == pytest.approx([1 / 3 / 12**0.5] * 2, rel=0.05)
    assert abs(float(torch.corrcoef(share.T)[0, 1])) < 0.06


def test_they_carry_no_gradient_and_follow_the_generator() -> None:
    distances = torch.tensor([1.0, 2.0], requires_grad=True)
    edges = drawn(distances, 0.1)
    assert not edges.requires_grad
    assert torch.equal(edges, drawn(distances, 0.1))
    assert not torch.equal(edges, drawn(distances, 0.1, seed=1))
