"""Compositing and depth against loops and limits."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.along_ray.rendering import (
    accumulation,
    composite,
    composite_normals,
    expected_depth,
    median_depth,
)
from pipelines.nerf.errors import NerfError

WEIGHTS = torch.tensor([[0.1, 0.3, 0.2, 0.1], [0.0, 0.0, 1.0, 0.0], [0.1, 0.1, 0.1, 0.1]])
EDGES = torch.tensor([[1.0, 2.0, 3.0, 5.0, 9.0]]).expand(3, 5).contiguous()
COLORS = torch.rand(3, 4, 3, generator=torch.Generator().manual_seed(0))


def test_accumulation_is_what_did_not_pass() -> None:
    assert torch.allclose(accumulation(WEIGHTS), torch.tensor([0.7, 1.0, 0.4]))


@pytest.mark.parametrize("background", ["last_sample", "black", "white"])
def test_composite_equals_the_loop(background: str) -> None:
    shown = composite(COLORS, WEIGHTS, background)
    for ray in range(3):
        behind = {
            "last_sample": COLORS[ray, -1],
            "black": torch.zeros(3),
            "white": torch.ones(3),
        }[background]
        total, left = torch.zeros(3), 1.0
        for i in range(4):
            total = total + WEIGHTS[ray, i] * COLORS[ray, i]
            left -= float(WEIGHTS[ray, i])
        assert torch.allclose(shown[ray], total + left * behind, atol=1e-6)


def test_random_background_fills_only_what_is_missing() -> None:
    generator = torch.Generator().manual_seed(1)
    shown = composite(COLORS, WEIGHTS, "random", generator=generator)
    black = composite(COLORS, WEIGHTS, "black")
    assert torch.allclose(shown[1], black[1])
    assert bool((shown[0] > black[0]).all())
    assert torch.equal(composite(COLORS, WEIGHTS, "random"), black)


def test_median_depth_is_the_first_interval_that_reaches_half() -> None:
    # Row 0: 0.1, 0.4, 0.6 -> third interval; row 2 never reaches half -> last interval.
    assert torch.allclose(median_depth(WEIGHTS, EDGES), torch.tensor([4.0, 4.0, 7.0]))


def test_expected_depth_is_the_weighted_mean() -> None:
    middles = torch.tensor([1.5, 2.5, 4.0, 7.0])
    expected = (WEIGHTS * middles).sum(-1) / WEIGHTS.sum(-1)
    assert torch.allclose(expected_depth(WEIGHTS, EDGES), expected)


def test_expected_depth_of_an_empty_ray_stays_in_range() -> None:
    assert torch.allclose(expected_depth(torch.zeros(1, 4), EDGES[:1]), torch.tensor([1.5]))


def test_rendered_normals_have_unit_length() -> None:
    normals = torch.nn.functional.normalize(COLORS - 0.5, dim=-1)
    assert torch.allclose(composite_normals(normals, WEIGHTS).norm(dim=-1), torch.ones(3))


def _scene(rays: int, samples: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    """Densities [R, S], edges [R, S + 1] and colours [R, S, 3] in float64."""
    generator = torch.Generator().manual_seed(rays * samples)
    density = 3.0 * torch.rand(rays, samples, generator=generator, dtype=torch.float64)
    steps = torch.rand(rays, samples + 1, generator=generator, dtype=torch.float64) + 0.01
    colors = torch.rand(rays, samples, 3, generator=generator, dtype=torch.float64)
    return density, torch.cumsum(steps, dim=-1), colors


def test_accumulation_and_what_passes_add_up_to_one() -> None:
    density, edges, _ = _scene(6, 9)
    found = accumulation(weights_from_density(density, edges))
    for ray in range(6):
        passed = 1.0
        for i in range(9):
            passed *= math.exp(-float(density[ray, i] * (edges[ray, i + 1] - edges[ray, i])))
        assert float(found[ray]) + passed == pytest.approx(1.0, abs=1e-12)


def test_a_constant_colour_is_seen_as_it_is_before_itself() -> None:
    density, edges, _ = _scene(6, 9)
    color = torch.tensor([0.2, 0.9, 0.4], dtype=torch.float64)
    shown = composite(color.expand(6, 9, 3), weights_from_density(density, edges), "last_sample")
    assert torch.allclose(shown, color.expand(6, 3), atol=1e-12)


def test_an_opaque_slab_hides_everything_behind_it() -> None:
    _, edges, colors = _scene(4, 7)
    density = torch.zeros(4, 7, dtype=torch.float64)
    density[:, 3] = 1e6
    density[:, 5] = 1e6
    weights = weights_from_density(density, edges)
    middle = 0.5 * (edges[:, 3] + edges[:, 4])
    for background in ("last_sample", "black", "white"):
        assert torch.allclose(composite(colors, weights, background), colors[:, 3])
    assert torch.allclose(accumulation(weights), torch.ones(4, dtype=torch.float64))
    assert torch.allclose(median_depth(weights, edges), middle)
    assert torch.allclose(expected_depth(weights, edges), middle)


def test_empty_space_shows_the_background_alone() -> None:
    _, _, colors = _scene(4, 7)
    weights = torch.zeros(4, 7, dtype=torch.float64)
    assert torch.equal(composite(colors, weights, "last_sample"), colors[:, -1])
    assert torch.equal(composite(colors, weights, "black"), torch.zeros_like(colors[:, 0]))
    assert torch.equal(composite(colors, weights, "white"), torch.ones_like(colors[:, 0]))
    noise = composite(colors, weights, "random", generator=torch.Generator().manual_seed(5))
    same = torch.rand(4, 3, generator=torch.Generator().manual_seed(5), dtype=torch.float64)
    assert torch.equal(noise, same)


def test_backgrounds_of_a_small_ray_by_hand() -> None:
    colors = torch.tensor([[[1.0, 0.0, 0.5], [0.0, 0.8, 0.2]]])
    weights = torch.tensor([[0.25, 0.5]])
    by_hand = {
        "black": [0.25, 0.4, 0.225],
        "white": [0.5, 0.65, 0.475],
        "last_sample": [0.25, 0.6, 0.275],
    }
    for background, expected in by_hand.items():
        assert composite(colors, weights, background)[0].tolist() == pytest.approx(expected)


def test_every_ray_gets_its_own_random_background() -> None:
    colors, weights = torch.zeros(1000, 2, 3), torch.zeros(1000, 2)
    shown = composite(colors, weights, "random", generator=torch.Generator().manual_seed(0))
    # Uniform in [0, 1): mean 1/2, variance 1/12, channels and rays independent.
    assert abs(float(shown.mean()) - 0.5) < 0.02
    assert abs(float(shown.var()) - 1.0 / 12.0) < 0.005
    assert float(torch.corrcoef(shown.T).triu(1).abs().max()) < 0.1


def test_an_unknown_background_is_refused_with_the_known_ones() -> None:
    with pytest.raises(NerfError, match="last_sample, black, white, random") as caught:
        composite(COLORS, WEIGHTS, "blue")
    assert caught.value.code == "bad_config"


@pytest.mark.parametrize("background", ["last_sample", "black", "white"])
def test_gradients_of_the_colour_are_right_down_to_the_density(background: str) -> None:
    density, edges, colors = _scene(3, 5)

    def shown(density: torch.Tensor, colors: torch.Tensor) -> torch.Tensor:
        return composite(colors, weights_from_density(density, edges), background)

    assert torch.autograd.gradcheck(shown, (density.requires_grad_(), colors.requires_grad_()))


def test_gradients_of_depth_and_normals_are_right() -> None:
    density, edges, colors = _scene(3, 5)
    weights = weights_from_density(density, edges).requires_grad_()
    normals = torch.nn.functional.normalize(colors - 0.5, dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: expected_depth(w, edges), weights)
    assert torch.autograd.gradcheck(composite_normals, (normals, weights))


def test_expected_depth_of_an_almost_empty_ray_is_kept_in_range() -> None:
    weights = torch.full((1, 4), 1e-12)
    middles = [1.5, 2.5, 4.0, 7.0]
    assert float(expected_depth(weights, EDGES[:1])) == pytest.approx(middles[0])


def test_rendered_normals_point_where_the_weighted_sum_points() -> None:
    normals = torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]])
    found = composite_normals(normals, torch.tensor([[0.3, 0.4]]))
    assert found[0].tolist() == pytest.approx([0.6, 0.8, 0.0])


def test_the_normal_of_an_empty_ray_is_zero_and_harmless() -> None:
    weights = torch.zeros(1, 2, requires_grad=True)
    found = composite_normals(torch.tensor([[[1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]]), weights)
    found.sum().backward()
    assert torch.equal(found, torch.zeros(1, 3))
    assert weights.grad is not None
    assert torch.equal(weights.grad, torch.zeros(1, 2))
