"""Vectors scaled to length one, at the edges of what float32 holds."""

from __future__ import annotations

import torch

from pipelines.nerf.space.vectors import unit_vectors


def test_unit_vectors_have_length_one_at_any_scale() -> None:
    generator = torch.Generator().manual_seed(0)
    vectors = torch.randn(60, 3, generator=generator) * torch.logspace(-37, 37, 60)[:, None]
    assert torch.allclose(unit_vectors(vectors).norm(dim=-1), torch.ones(60), atol=1e-6)
    exact = vectors.double()
    expected = exact / exact.square().sum(-1, keepdim=True).sqrt()
    assert torch.allclose(unit_vectors(vectors).double(), expected, atol=1e-6)


def test_a_zero_vector_stays_and_passes_no_gradient() -> None:
    vectors = torch.tensor([[0.0, 0.0, 0.0], [3.0, 0.0, 4.0]], requires_grad=True)
    found = unit_vectors(vectors)
    assert torch.allclose(found, torch.tensor([[0.0, 0.0, 0.0], [0.6, 0.0, 0.8]]))
    (gradient,) = torch.autograd.grad(found.sum(), vectors)
    assert torch.equal(gradient[0], torch.zeros(3))
    # d(v / |v|) = (1 - n n^T) / |v|, summed over the outputs.
    n = torch.tensor([0.6, 0.0, 0.8])
    assert torch.allclose(gradient[1], (torch.eye(3) - n[:, None] * n).sum(0) / 5.0, atol=1e-6)


def test_unit_vectors_have_the_right_derivatives() -> None:
    generator = torch.Generator().manual_seed(0)
    vectors = torch.randn(5, 3, generator=generator, dtype=torch.float64, requires_grad=True)
    assert torch.autograd.gradcheck(unit_vectors, (vectors,))
    assert torch.autograd.gradgradcheck(unit_vectors, (vectors,))
