"""Samplers: where samples lie, and that proposals find the surface."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.along_ray.intervals import SPACINGS, sample_pdf, t_from_s
from pipelines.nerf.along_ray.samplers import (
    anneal_exponent,
    sample_along,
    sample_fine,
    sample_proposals,
)
from pipelines.nerf.errors import NerfError
from pipelines.nerf.space.rays import Rays, RaySamples


def _rays(num: int) -> Rays:
    directions = torch.nn.functional.normalize(torch.ones(num, 3), dim=-1)
    return Rays(torch.zeros(num, 3), directions, torch.zeros(num, dtype=torch.int64))


def test_half_of_the_piecewise_samples_lie_within_distance_one() -> None:
    samples = sample_along(_rays(2), 200, 0.0, 1e6)
    assert abs(float((samples.t_mid < 1.0).float().mean()) - 0.5) < 0.01


def test_jittered_edges_stay_between_the_neighbouring_midpoints() -> None:
    plain = sample_along(_rays(100), 8, 0.05, 100.0)
    generator = torch.Generator().manual_seed(0)
    moved = sample_along(_rays(100), 8, 0.05, 100.0, generator=generator)
    middles = 0.5 * (plain.s_edges[:, 1:] + plain.s_edges[:, :-1])
    assert bool((moved.s_edges[:, 1:-1] >= middles[:, :-1]).all())
    assert bool((moved.s_edges[:, 1:-1] <= middles[:, 1:]).all())
    inner = moved.s_edges[:, 1:-1] - plain.s_edges[:, 1:-1]
    assert float((inner - inner[:, :1]).abs().max()) < 1e-6  # one number per ray
    assert float(inner[:, 0].std()) > 0.01


def test_separate_jitter_moves_each_edge_on_its_own() -> None:
    generator = torch.Generator().manual_seed(0)
    moved = sample_along(_rays(4), 8, 0.05, 100.0, generator=generator, single_jitter=False).s_edges
    assert float((moved[:, 2:] - moved[:, 1:-1]).std()) > 0.01


@pytest.mark.parametrize("spacing", SPACINGS)
def test_samples_are_even_in_their_spacing_from_near_to_far(spacing: str) -> None:
    samples = sample_along(_rays(3), 16, 0.5, 20.0, spacing=spacing)
    assert torch.allclose(samples.s_edges, torch.linspace(0, 1, 17).expand(3, -1))
    spaced = SPACINGS[spacing].forward(samples.t_edges.double())
    steps = spaced[:, 1:] - spaced[:, :-1]
    assert torch.allclose(steps, steps[:1, :1], rtol=1e-3)
    ends = torch.tensor([0.5, 20.0])
    assert torch.allclose(samples.t_edges[:, [0, -1]], ends, rtol=1e-5)


def test_anneal_rises_from_flat_to_full() -> None:
    assert anneal_exponent(0, 1000, 10.0) == 0.0
    assert abs(anneal_exponent(500, 1000, 10.0) - 5.0 / 5.5) < 1e-12
    assert anneal_exponent(1000, 1000, 10.0) == 1.0
    assert anneal_exponent(5000, 1000, 10.0) == 1.0
    assert anneal_exponent(0, 0, 10.0) == 1.0


@pytest.mark.parametrize("slope", [0.0, 0.5, 1.0, 1000.0])
def test_any_slope_ends_at_one_and_stays_there(slope: float) -> None:
    found = [anneal_exponent(step, 8, slope) for step in range(12)]
    assert found[0] == 0.0
    assert found[8:] == [1.0] * 4
    assert found == sorted(found)
    if slope in (0.0, 1.0):
        assert found[:8] == [slope * step / 8 for step in range(8)]


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


@pytest.mark.parametrize("exponent", [1.0, 0.5])
@pytest.mark.parametrize("single_jitter", [True, False])
def test_every_round_is_jittered_anew_in_the_precision_of_the_rays(
    single_jitter: bool, exponent: float
) -> None:
    rays = Rays(_rays(5).origins.double(), _rays(5).directions.double(), torch.arange(5))
    density = [lambda points: points.norm(dim=-1), lambda points: 2.0 + points[..., 0]]
    final, rounds, weights = sample_proposals(
        rays,
        density,
        (9, 7),
        4,
        0.1,
        9.0,
        exponent=exponent,
        single_jitter=single_jitter,
        generator=torch.Generator().manual_seed(3),
    )
    drawn = torch.Generator().manual_seed(3)
    expected = sample_along(rays, 9, 0.1, 9.0, single_jitter=single_jitter, generator=drawn)
    for number, (count, found) in enumerate(zip((7, 4, 0), (*rounds, final), strict=True)):
        assert found.s_edges.dtype == torch.float64
        assert torch.equal(found.s_edges, expected.s_edges)
        if number < 2:
            columns = 1 if single_jitter else count + 1
            jitter = torch.rand(5, columns, generator=drawn, dtype=torch.float64)
            powered = weights[number].pow(exponent)
            edges = sample_pdf(found.s_edges, powered, count, jitter=jitter)
            expected = RaySamples(s_edges=edges, t_edges=t_from_s(edges, 0.1, 9.0))


def test_proposal_positions_carry_no_gradient_to_the_rays() -> None:
    rays = _rays(2)
    rays.origins.requires_grad_()
    seen = []

    def fog(points: torch.Tensor) -> torch.Tensor:
        seen.append(points.requires_grad)
        return torch.ones(points.shape[:-1])

    sample_proposals(rays, [fog, fog], (16, 8), 4, 0.05, 100.0)
    assert seen == [False, False]


@pytest.mark.parametrize("num_rounds", [1, 2, 4])
def test_any_number_of_rounds_with_own_or_shared_densities(num_rounds: int) -> None:
    def fog(points: torch.Tensor) -> torch.Tensor:
        return points.norm(dim=-1)

    def same_fog(points: torch.Tensor) -> torch.Tensor:
        return points.square().sum(dim=-1).sqrt()

    counts = (64, 32, 16, 8)[:num_rounds]
    shared, rounds, weights = sample_proposals(_rays(3), [fog] * num_rounds, counts, 5, 0.1, 9.0)
    own, _, _ = sample_proposals(
        _rays(3), [fog, same_fog, fog, same_fog][:num_rounds], counts, 5, 0.1, 9.0
    )
    assert tuple(samples.num_samples for samples in rounds) == counts
    assert tuple(found.shape[1] for found in weights) == counts
    assert shared.num_samples == 5
    assert torch.allclose(shared.t_edges, own.t_edges, rtol=1e-4)


@pytest.mark.parametrize("counts", [(), (8,), (8, 8, 8)])
def test_rounds_without_a_density_are_refused(counts: tuple[int, ...]) -> None:
    densities = [] if not counts else [lambda points: points[..., 0]] * 2
    with pytest.raises(NerfError, match=f"for {len(counts)} rounds") as caught:
        sample_proposals(_rays(1), densities, counts, 4, 0.1, 1.0)
    assert caught.value.code == "bad_config"
    assert caught.value.hint == "Give a density function and a sample count for every round."


@pytest.mark.parametrize("spacing", SPACINGS)
def test_all_rounds_use_the_chosen_spacing(spacing: str) -> None:
    final, rounds, _ = sample_proposals(
        _rays(2), [lambda points: points.norm(dim=-1)] * 2, (16, 8), 4, 0.5, 9.0, spacing=spacing
    )
    for samples in (*rounds, final):
        assert torch.equal(samples.t_edges, t_from_s(samples.s_edges, 0.5, 9.0, spacing))


@pytest.mark.parametrize("seed", [None, 0])
@pytest.mark.parametrize("single_jitter", [True, False])
def test_fine_samples_cut_the_coarse_ones_further(seed: int | None, single_jitter: bool) -> None:
    rays = _rays(20)
    generator = torch.Generator().manual_seed(4)
    coarse = sample_along(rays, 16, 2.0, 6.0, spacing="uniform", generator=generator)
    weights = torch.rand(20, 16, generator=generator).pow(6)
    fine = sample_fine(
        rays,
        coarse,
        weights,
        24,
        2.0,
        6.0,
        spacing="uniform",
        single_jitter=single_jitter,
        generator=None if seed is None else torch.Generator().manual_seed(seed),
    )
    assert fine.num_samples == 16 + 24
    assert bool((fine.t_edges[:, 1:] >= fine.t_edges[:, :-1]).all())
    assert torch.equal(fine.t_edges[:, [0, -1]], coarse.t_edges[:, [0, -1]])
    offsets = torch.full((20, 24), 0.5)
    if seed is not None:
        drawn = torch.Generator().manual_seed(seed)
        offsets = torch.rand(20, 1 if single_jitter else 24, generator=drawn).expand(20, 24)
    for ray in range(20):
        edges = coarse.s_edges[ray].tolist()
        mass = [weight + 0.01 for weight in weights[ray].tolist()]
        expected = list(edges)
        for k in range(24):
            left = (k + float(offsets[ray, k])) / 24 * sum(mass)
            i = 0
            while i < 15 and left >= mass[i]:
                left -= mass[i]
                i += 1
            expected.append(edges[i] + left / mass[i] * (edges[i + 1] - edges[i]))
        assert fine.s_edges[ray].tolist() == pytest.approx(sorted(expected), abs=1e-5)


def test_fine_samples_alone_follow_the_histogram() -> None:
    rays = _rays(1)
    coarse = sample_along(rays, 4, 0.0, 8.0, spacing="uniform")
    weights = torch.tensor([[0.0, 1.0, 0.0, 0.0]], requires_grad=True)
    fine = sample_fine(
        rays, coarse, weights, 10, 0.0, 8.0, include_coarse=False, padding=0.0, spacing="uniform"
    )
    assert fine.num_samples == 10
    assert not fine.t_edges.requires_grad
    expected = [2.0 + 2.0 * (k + 0.5) / 11 for k in range(11)]
    assert fine.t_edges[0].tolist() == pytest.approx(expected, abs=1e-5)
