"""A whole proposal round for training: positions, density network and weights, nothing in between.

Twin of `weights_from_density(network(positions), t_edges)` with its gradients towards the table and
the four arrays of the layers. Positions carry none, as `samplers.sample_proposals` has it. Symbols:
R rays, S samples, E entries, I features, H hidden units.

Nothing per sample is kept for backward: it runs the forward pass of its rays again, which costs
less than writing and reading back what it could have kept, and leaves out rays whose weights have
no gradient. Each share holds a gradient of its own; they are summed in the order of the shares, so
that results repeat for a fixed number of threads. The table's gradient goes where `gradients` says.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from pipelines.nerf.along_ray.intervals import weights_from_density
from pipelines.nerf.engines.cpu.parts.dense_layers import (
    pack_layer,
    pack_transposed,
    products_shape,
    unpack_products,
)
from pipelines.nerf.engines.cpu.parts.hash_lanes import NUM_FEATURES, pack_grid
from pipelines.nerf.engines.cpu.parts.intervals import CONTRACTION_CODES
from pipelines.nerf.engines.cpu.parts.runtime import num_threads, run_threads
from pipelines.nerf.engines.cpu.train.gradients import (
    accumulates_in_place,
    returned_gradient,
    table_gradient,
)
from pipelines.nerf.engines.cpu.train.proposal_round import (
    Gradients,
    RoundNet,
    add_tables,
    run_rounds,
)
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.networks.fields import DensityField

BLOCK_SAMPLES = 1024
"""Samples that a thread works on at once: what lies between fits into its cache."""


class _ProposalWeights(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, rays: tuple[Tensor, ...], network: DensityField, *parameters: Tensor
    ) -> Tensor:
        ctx.rays, ctx.network = rays, network
        ctx.save_for_backward(*parameters)
        return _run_forward(_pack(network), rays)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        table, *layers = ctx.saved_tensors  # torch checks here that nobody has changed them
        wanted = ctx.needs_input_grad[2]
        buffer = table_gradient(table, wanted and accumulates_in_place(ctx.network.grid))
        found = _run_backward(_pack(ctx.network), ctx.rays, grad_outputs[0], buffer)
        shaped = (grad.reshape(layer.shape) for grad, layer in zip(found, layers, strict=True))
        return None, None, returned_gradient(table, buffer), *shaped


def _run_forward(net: RoundNet, rays: tuple[Tensor, ...]) -> Tensor:
    t_edges = rays[2]
    weights = torch.empty(len(t_edges), t_edges.shape[1] - 1)
    if weights.numel():
        arrays = (tensor.numpy() for tensor in rays)
        none = _no_gradients(net, weights.new_zeros(1, NUM_FEATURES), 1)
        per_block = _rays_per_block(weights)
        run_threads(run_rounds, net, *arrays, per_block, weights.numpy(), False, none)
    return weights


def _run_backward(
    net: RoundNet, rays: tuple[Tensor, ...], grad_weights: Tensor, table: Tensor
) -> tuple[Tensor, ...]:
    """Adds to table [E, 2]; returns the gradients of W1, b1, W2, b2."""
    shares = num_threads()
    num_inputs, width = net.hidden.weights.shape[1], net.hidden.bias.size
    bias_column = net.to_features.bias.size
    gradients = _no_gradients(net, table, shares)
    if grad_weights.numel():
        arrays = (tensor.numpy() for tensor in rays)
        given = grad_weights.contiguous().numpy()
        per_block = _rays_per_block(grad_weights)
        run_threads(run_rounds, net, *arrays, per_block, given, True, gradients, shares=shares)
        if shares > 1:
            run_threads(add_tables, gradients.more_tables, gradients.table)
    hidden = unpack_products(gradients.hidden.sum(axis=0))[: net.num_hidden]
    output = unpack_products(gradients.output.sum(axis=0))[:1]
    parts = (
        hidden[:, :num_inputs],
        hidden[:, bias_column],
        output[:, : net.num_hidden],
        output[:, width],
    )
    return tuple(torch.from_numpy(np.ascontiguousarray(part)) for part in parts)


def _no_gradients(net: RoundNet, table: Tensor, shares: int) -> Gradients:
    """Zeros for every share but the first one's table."""
    width, inputs = net.hidden.bias.size, net.to_features.bias.size
    return Gradients(
        table.numpy(),
        np.zeros((shares - 1, *table.shape), np.float32),
        np.zeros((shares, *products_shape(width, inputs + 1)), np.float32),
        np.zeros((shares, *products_shape(1, width + 1)), np.float32),
    )


def _rays_per_block(weights: Tensor) -> int:
    return max(1, BLOCK_SAMPLES // weights.shape[1])


def _pack(network: DensityField) -> RoundNet:
    """The network as arrays: the table is shared, the small layers are copied."""
    hidden, output = network.mlp.layers
    assert isinstance(hidden, nn.Linear)
    assert isinstance(output, nn.Linear)
    return RoundNet(
        pack_grid(network.grid.table, *network.grid.active()),
        pack_layer(hidden),
        pack_layer(output),
        pack_transposed(output.weight.detach().numpy()),
        pack_transposed(hidden.weight.detach().numpy()),
        hidden.out_features,
        np.float32(network.average_init_density),
        CONTRACTION_CODES[network.contraction],
    )


def is_compiled(network: nn.Module) -> bool:
    """Whether there is a kernel for this network; `proposal_weights` takes the plain way if not.

    It is for two layers with biases behind a float32 grid with two features per entry on the CPU.
    """
    if type(network) is not DensityField or type(network.grid) is not HashGrid:
        return False
    layers, table = network.mlp.layers, network.grid.table
    return (
        len(layers) == 2
        and network.contraction in CONTRACTION_CODES
        and all(isinstance(layer, nn.Linear) and layer.bias is not None for layer in layers)
        and all(p.dtype == torch.float32 and p.device.type == "cpu" for p in network.parameters())
        and table.shape[1] == NUM_FEATURES
        and table.is_contiguous()
    )


def proposal_weights(
    origins: Tensor, directions: Tensor, t_edges: Tensor, network: DensityField
) -> Tensor:
    """Weights of a proposal round: samples midway between edges, density, chance to end there.

    origins, directions: [R, 3], scene space, unit directions. t_edges: [R, S + 1], increasing,
    scene units; all are taken as constants, float32 on the CPU. Returns [R, S] in [0, 1] float32;
    differentiable once, in the network's parameters, and without memory of the samples under
    `torch.no_grad()`. Source: Mip-NeRF 360, arXiv:2111.12077, section 3.
    """
    rays = tuple(tensor.detach().contiguous() for tensor in (origins, directions, t_edges))
    if not (is_compiled(network) and all(item.dtype == torch.float32 for item in rays)):
        middles = 0.5 * (rays[2][:, :-1] + rays[2][:, 1:])
        positions = rays[0][:, None] + rays[1][:, None] * middles[..., None]
        return weights_from_density(network(positions), rays[2])
    hidden, output = network.mlp.layers
    parameters = (network.grid.table, hidden.weight, hidden.bias, output.weight, output.bias)
    if not (torch.is_grad_enabled() and any(p.requires_grad for p in parameters)):
        return _run_forward(_pack(network), rays)
    weights: Tensor = _ProposalWeights.apply(rays, network, *parameters)  # type: ignore[no-untyped-call]
    return weights
