"""Losses against double loops, and their gradients."""

from __future__ import annotations

import torch

from pipelines.nerf.losses import distortion_loss, interlevel_loss, outer_measure


def _histogram(rays: int, num: int, seed: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(seed)
    steps = torch.rand(rays, num + 1, generator=generator, dtype=torch.float64) + 0.01
    edges = torch.cumsum(steps, -1)
    edges = (edges - edges[:, :1]) / (edges[:, -1:] - edges[:, :1])
    weights = torch.rand(rays, num, generator=generator, dtype=torch.float64)
    return edges, weights / weights.sum(-1, keepdim=True)


def _overlap_loop(edges: torch.Tensor, other: torch.Tensor, weights: torch.Tensor) -> torch.Tensor:
    covers = torch.zeros(edges.shape[0], edges.shape[1] - 1, dtype=torch.float64)
    for ray in range(edges.shape[0]):
        for i in range(edges.shape[1] - 1):
            for j in range(other.shape[1] - 1):
                starts_before_end = other[ray, j] < edges[ray, i + 1]
                ends_after_start = other[ray, j + 1] > edges[ray, i]
                if starts_before_end and ends_after_start:
                    covers[ray, i] += weights[ray, j]
    return covers


def test_outer_measure_adds_all_overlapping_bins() -> None:
    edges, _ = _histogram(5, 7, seed=0)
    # The outer edges are inside those of the proposal: no tie, where the definition is open.
    edges = 0.01 + 0.98 * edges
    other, weights = _histogram(5, 11, seed=1)
    assert torch.allclose(
        outer_measure(edges, other, weights), _overlap_loop(edges, other, weights)
    )


def test_interlevel_loss_equals_the_double_loop() -> None:
    edges, weights = _histogram(5, 7, seed=0)
    edges = 0.01 + 0.98 * edges
    proposals = [_histogram(5, 11, seed=1), _histogram(5, 6, seed=2)]
    expected = 0.0
    for other, found in proposals:
        cover = _overlap_loop(edges, other, 0.3 * found)
        expected += float(((weights - cover).clamp_min(0) ** 2 / (weights + 1e-7)).mean())
    scaled = [(other, 0.3 * found) for other, found in proposals]
    assert expected > 1e-3
    assert abs(float(interlevel_loss(edges, weights, scaled)) - expected) < 1e-12


def test_interlevel_loss_is_zero_where_the_proposal_covers() -> None:
    edges, weights = _histogram(5, 7, seed=0)
    assert float(interlevel_loss(edges, weights, [(edges, weights)])) < 1e-12


def test_interlevel_loss_moves_the_proposal_alone() -> None:
    edges, weights = _histogram(3, 5, seed=0)
    other, found = _histogram(3, 4, seed=1)
    weights.requires_grad_()
    found = (0.2 * found).requires_grad_()
    interlevel_loss(edges, weights, [(other, found)]).backward()
    assert weights.grad is None
    assert found.grad is not None
    assert float(found.grad.abs().sum()) > 0.0


def test_interlevel_gradient_is_right() -> None:
    edges, weights = _histogram(3, 5, seed=0)
    other, found = _histogram(3, 4, seed=1)
    start = (0.2 * found).requires_grad_()
    assert torch.autograd.gradcheck(lambda w: interlevel_loss(edges, weights, [(other, w)]), start)


def test_distortion_loss_equals_the_double_sum() -> None:
    edges, weights = _histogram(4, 9, seed=3)
    expected = 0.0
    for ray in range(4):
        middles = 0.5 * (edges[ray, 1:] + edges[ray, :-1])
        for i in range(9):
            expected += float(weights[ray, i] ** 2 * (edges[ray, i + 1] - edges[ray, i])) / 3.0
            for j in range(9):
                gap = abs(float(middles[i] - middles[j]))
                expected += float(weights[ray, i] * weights[ray, j]) * gap
    assert abs(float(distortion_loss(edges, weights)) - expected / 4) < 1e-12


def test_distortion_loss_of_one_narrow_interval_is_small() -> None:
    edges = torch.tensor([[0.0, 0.499, 0.501, 1.0]])
    spread = distortion_loss(edges, torch.tensor([[0.5, 0.0, 0.5]]))
    narrow = distortion_loss(edges, torch.tensor([[0.0, 1.0, 0.0]]))
    assert float(narrow) < 1e-3 < float(spread)


def test_distortion_gradient_is_right() -> None:
    edges, weights = _histogram(3, 6, seed=4)
    start = weights.requires_grad_()
    assert torch.autograd.gradcheck(lambda w: distortion_loss(edges, w), start)
