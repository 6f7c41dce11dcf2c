"""Checks of the fused MLP against `fields.MLP`; run by `test_kernels`.

They run on a GPU, or, with TRITON_INTERPRET=1 set before triton is imported, on the CPU.
"""

from __future__ import annotations

import os

import pytest
import torch
from torch import Tensor

from pipelines.nerf.engines.gpu.parts import mlp as fused
from pipelines.nerf.engines.gpu.parts.mlp import BACKWARD_TILE, FORWARD_TILE, fused_mlp, supports
from pipelines.nerf.errors import NerfError
from pipelines.nerf.networks.fields import MLP

DEVICE = torch.device("cpu" if os.environ.get("TRITON_INTERPRET") == "1" else "cuda")

NETWORKS = [(10, 16, 1), (32, 64, 16), (63, 64, 64, 3), (5, 24, 24, 2)]


def drawn(widths: tuple[int, ...], num_points: int) -> tuple[MLP, Tensor, Tensor]:
    """A network, inputs, and a gradient of its outputs."""
    torch.manual_seed(num_points)
    network = MLP(*widths).to(DEVICE)
    values = torch.randn(num_points, widths[0], device=DEVICE)
    return network, values, torch.randn(num_points, widths[-1], device=DEVICE)


def gradients(network: MLP, values: Tensor, outputs: Tensor, incoming: Tensor) -> list[Tensor]:
    """With respect to the inputs and all parameters."""
    wanted = [values, *network.parameters()]
    return list(torch.autograd.grad(outputs, wanted, incoming))


@pytest.mark.parametrize("widths", NETWORKS)
@pytest.mark.parametrize("num_points", [1, FORWARD_TILE + 3])
def test_outputs_and_gradients_are_those_of_the_plain_network(
    widths: tuple[int, ...], num_points: int
) -> None:
    network, values, incoming = drawn(widths, num_points)
    values.requires_grad_()
    found = fused_mlp(values, network.layers, half=False)
    expected = network(values)
    torch.testing.assert_close(found, expected, rtol=1e-5, atol=1e-5)
    pairs = zip(
        gradients(network, values, found, incoming),
        gradients(network, values, expected, incoming),
        strict=True,
    )
    for ours, theirs in pairs:
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


@pytest.mark.parametrize("widths", NETWORKS)
def test_half_precision_is_that_of_rounded_factors(widths: tuple[int, ...]) -> None:
    network, values, incoming = drawn(widths, 70)
    values.requires_grad_()
    found = fused_mlp(values, network.layers)
    expected = network(values)
    # Two or three roundings of 2^-11 of terms of the order 1, then sums of 64.
    torch.testing.assert_close(found, expected, rtol=5e-3, atol=5e-3)
    for ours, theirs in zip(
        gradients(network, values, found, incoming),
        gradients(network, values, expected, incoming),
        strict=True,
    ):
        # Some hidden values change sign by rounding, and with it whether they learn at all.
        assert float((ours - theirs).norm()) < 0.06 * float(theirs.norm())


def test_gradients_of_many_tiles_and_programs_are_summed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(fused, "BACKWARD_PROGRAMS", 2)
    network, values, incoming = drawn((10, 16, 1), 5 * BACKWARD_TILE + 7)
    values.requires_grad_()
    found = gradients(network, values, fused_mlp(values, network.layers, half=False), incoming)
    expected = gradients(network, values, network(values), incoming)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs, rtol=1e-4, atol=1e-4)


def test_leading_dimensions_are_kept_and_no_points_learn_nothing() -> None:
    network, values, _ = drawn((10, 16, 1), 12)
    layers = network.layers
    found = fused_mlp(values.reshape(3, 4, 10), layers, half=False)
    assert torch.equal(found.reshape(12, 1), fused_mlp(values, layers, half=False))
    empty = fused_mlp(values[:0], layers)
    assert empty.shape == (0, 1)
    for gradient in torch.autograd.grad(empty.sum(), list(network.parameters())):
        assert not gradient.any()


def test_networks_it_does_not_know_are_refused_by_their_widths() -> None:
    assert supports(MLP(10, 16, 1).layers)
    for widths in [(65, 64, 1), (10, 16, 8, 1), (10, 1), (10, 16, 16, 16, 1)]:
        network, values, _ = drawn(widths, 2)
        assert not supports(network.layers)
        with pytest.raises(NerfError, match=str(widths[0])) as raised:
            fused_mlp(values, network.layers)
        assert raised.value.code == "bad_config"
