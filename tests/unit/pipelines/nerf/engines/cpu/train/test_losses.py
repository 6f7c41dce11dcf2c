"""The fused interlevel loss and resampling against their plain twins, in float64."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import torch
from torch import Tensor

from pipelines.nerf.along_ray.intervals import sample_pdf
from pipelines.nerf.along_ray.losses import interlevel_loss
from pipelines.nerf.engines.cpu.train.losses import interlevel_loss_fast, sample_pdf_fast


@pytest.fixture(params=[1, 2], ids=["one thread", "two threads"])
def threads(request: pytest.FixtureRequest) -> Iterator[int]:
    before = torch.get_num_threads()
    torch.set_num_threads(request.param)
    yield request.param
    torch.set_num_threads(before)


def histogram(num_rays: int, count: int, seed: int) -> tuple[Tensor, Tensor]:
    generator = torch.Generator().manual_seed(seed)
    edges = torch.rand(num_rays, count + 1, generator=generator).sort(dim=-1).values
    logits = 4.0 * torch.randn(num_rays, count, generator=generator)
    return edges, logits.softmax(dim=-1)


@pytest.mark.parametrize(("num_rays", "count"), [(33, 48), (1, 1), (5, 7)])
def test_interlevel_loss_and_gradient_equal_the_plain_ones(
    num_rays: int, count: int, threads: int
) -> None:
    edges, weights = histogram(num_rays, count, 0)
    proposals = [histogram(num_rays, bins, bins) for bins in (24, 96, 1)]
    # Shared edges are where "overlap" has to mean the same on both sides.
    proposals.append((edges.clone(), weights.flip(-1)))
    leaves = [found.clone().requires_grad_() for _, found in proposals]
    pairs = [(item[0], leaf) for item, leaf in zip(proposals, leaves, strict=True)]
    fast = interlevel_loss_fast(edges, weights, pairs)
    found = torch.autograd.grad(3.0 * fast, leaves)

    doubles = [leaf.detach().double().requires_grad_() for leaf in leaves]
    pairs = [(item[0].double(), leaf) for item, leaf in zip(proposals, doubles, strict=True)]
    truth = interlevel_loss(edges.double(), weights.double(), pairs)
    expected = torch.autograd.grad(3.0 * truth, doubles)
    assert fast.item() == pytest.approx(truth.item(), rel=1e-5, abs=1e-9)
    for a, b in zip(found, expected, strict=True):
        assert (a - b).abs().max() <= 1e-5 * b.abs().max() + 1e-9


def test_a_proposal_that_covers_the_weights_costs_nothing() -> None:
    edges, weights = histogram(10, 20, 0)
    cover = (2.0 * weights).requires_grad_()
    loss = interlevel_loss_fast(edges, weights, [(edges, cover)])
    (gradient,) = torch.autograd.grad(loss, cover)
    assert loss == 0.0
    assert not gradient.any()


def test_a_loss_that_is_not_a_number_shows() -> None:
    edges, weights = histogram(4, 6, 0)
    weights[2, 3] = float("nan")
    assert torch.isnan(interlevel_loss_fast(edges, weights, [histogram(4, 5, 1)]))


@pytest.mark.parametrize("padding", [0.01, 1e-5, 0.0])
@pytest.mark.parametrize("num_jitter", [0, 1, 18])
@pytest.mark.parametrize(("num_rays", "count"), [(29, 40), (1, 2)])
def test_new_edges_equal_the_plain_ones(
    num_rays: int, count: int, num_jitter: int, padding: float, threads: int
) -> None:
    edges, weights = histogram(num_rays, count, 2)
    jitter = torch.rand(num_rays, num_jitter) if num_jitter else None
    fast = sample_pdf_fast(edges, weights, 17, jitter=jitter, padding=padding)
    double = None if jitter is None else jitter.double()
    plain = sample_pdf(edges.double(), weights.double(), 17, jitter=double, padding=padding)
    assert (fast - plain).abs().max() < 1e-6
    assert (fast.diff(dim=-1) >= 0.0).all()


def test_a_single_interval_is_cut_evenly() -> None:
    drawn = sample_pdf_fast(torch.tensor([[0.2, 0.6]]), torch.tensor([[0.5]]), 3)
    expected = 0.2 + 0.4 * (torch.arange(4) + 0.5) / 4
    assert (drawn - expected).abs().max() < 1e-6


def test_a_histogram_without_mass_is_drawn_from_evenly() -> None:
    edges = torch.linspace(0.0, 1.0, 11).expand(3, -1)
    drawn = sample_pdf_fast(edges, torch.zeros(3, 10), 4)
    expected = (torch.arange(5) + 0.5) / 5
    assert (drawn - expected).abs().max() < 1e-6


def test_empty_batches_stay_empty() -> None:
    assert sample_pdf_fast(torch.zeros(0, 5), torch.zeros(0, 4), 6).shape == (0, 7)
