"""Compositing and depth against loops and limits."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.rendering import (
    accumulation,
    composite,
    composite_normals,
    expected_depth,
    median_depth,
)

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
