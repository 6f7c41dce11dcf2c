"""Samplers: where samples lie, and that proposals find the surface."""

from __future__ import annotations

import torch

from pipelines.nerf.rays import Rays, RaySamples
from pipelines.nerf.samplers import anneal_exponent, sample_piecewise, sample_proposals


def _rays(num: int) -> Rays:
    directions = torch.nn.functional.normalize(torch.ones(num, 3), dim=-1)
    return Rays(torch.zeros(num, 3), directions, torch.zeros(num, dtype=torch.int64))


def test_half_of_the_piecewise_samples_lie_within_distance_one() -> None:
    samples = sample_piecewise(_rays(2), 200, 0.0, 1e6)
    assert abs(float((samples.t_mid < 1.0).float().mean()) - 0.5) < 0.01


def test_jittered_edges_stay_between_the_neighbouring_midpoints() -> None:
    plain = sample_piecewise(_rays(100), 8, 0.05, 100.0)
    generator = torch.Generator().manual_seed(0)
    moved = sample_piecewise(_rays(100), 8, 0.05, 100.0, generator=generator)
    middles = 0.5 * (plain.s_edges[:, 1:] + plain.s_edges[:, :-1])
    assert bool((moved.s_edges[:, 1:-1] >= middles[:, :-1]).all())
    assert bool((moved.s_edges[:, 1:-1] <= middles[:, 1:]).all())
    inner = moved.s_edges[:, 1:-1] - plain.s_edges[:, 1:-1]
    assert float((inner - inner[:, :1]).abs().max()) < 1e-6  # one number per ray
    assert float(inner[:, 0].std()) > 0.01


def test_separate_jitter_moves_each_edge_on_its_own() -> None:
    generator = torch.Generator().manual_seed(0)
    moved = sample_piecewise(
        _rays(4), 8, 0.05, 100.0, generator=generator, single_jitter=False
    ).s_edges
    assert float((moved[:, 2:] - moved[:, 1:-1]).std()) > 0.01


def test_positions_are_the_midpoints_along_the_ray() -> None:
    rays = Rays(torch.tensor([[1.0, 0, 0]]), torch.tensor([[0.0, 1, 0]]), torch.tensor([0]))
    samples = RaySamples(torch.tensor([[0.0, 0.5, 1.0]]), torch.tensor([[1.0, 2.0, 4.0]]))
    expected = torch.tensor([[[1.0, 1.5, 0.0], [1.0, 3.0, 0.0]]])
    assert torch.allclose(samples.positions(rays), expected)


def test_anneal_rises_from_flat_to_full() -> None:
    assert anneal_exponent(0, 1000, 10.0) == 0.0
    assert abs(anneal_exponent(500, 1000, 10.0) - 5.0 / 5.5) < 1e-12
    assert anneal_exponent(1000, 1000, 10.0) == 1.0
    assert anneal_exponent(5000, 1000, 10.0) == 1.0
    assert anneal_exponent(0, 0, 10.0) == 1.0


def test_proposals_gather_the_samples_at_a_surface() -> None:
    def wall(points: torch.Tensor) -> torch.Tensor:
        return 200.0 * ((points.norm(dim=-1) > 2.0) & (points.norm(dim=-1) < 2.3)).float()

    final, rounds, weights = sample_proposals(_rays(3), [wall, wall], (128, 64), 32, 0.05, 100.0)
    assert [samples.num_samples for samples in rounds] == [128, 64]
    assert [found.shape for found in weights] == [(3, 128), (3, 64)]
    assert final.num_samples == 32
    near_wall = (final.t_mid > 1.8) & (final.t_mid < 2.5)
    assert float(near_wall.float().mean()) > 0.4
    flat, _, _ = sample_proposals(_rays(3), [wall, wall], (128, 64), 32, 0.05, 100.0, exponent=0.0)
    assert float(((flat.t_mid > 1.8) & (flat.t_mid < 2.5)).float().mean()) < 0.2


def test_proposal_positions_carry_no_gradient_to_the_rays() -> None:
    rays = _rays(2)
    rays.origins.requires_grad_()
    seen = []

    def fog(points: torch.Tensor) -> torch.Tensor:
        seen.append(points.requires_grad)
        return torch.ones(points.shape[:-1])

    sample_proposals(rays, [fog, fog], (16, 8), 4, 0.05, 100.0)
    assert seen == [False, False]
