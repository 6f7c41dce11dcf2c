"""Triton twin of `fields.MLP`: two or three small layers in one kernel, forward and backward.

Symbols: P points, I inputs (IN in kernels), H width of the hidden layers, O outputs (OUT), each at
most 64; B points of a tile. Between its layers a tile stays in registers, so that of each point
only inputs and outputs travel through memory: 2 (I + O) bytes forward where separate layers move
2 (I + 4 H + O) for one hidden layer. Products are float16 with float32 sums; weights in memory,
biases, ReLU and gradients of weights are float32. The backward pass computes the hidden layers
again instead of reading them. Each program sums the weights' gradient over its tiles and writes it
once; the sums of all programs are added in a fixed order, so results repeat.

What it is worth is counted in `tests/benchmarks/gpu_counts.py`. Matrix products are never the
limit: the paper's step has 15 Gflop, 0.02 ms of an H200.
"""

# Kernels carry no annotations: triton infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor, nn

from pipelines.nerf.errors import NerfError

MAX_WIDTH = 64
LEAST_DOT = 16
"""Smallest side of a matrix unit's product; narrower layers are padded with zeros."""
FORWARD_TILE, FORWARD_WARPS = 128, 4
BACKWARD_TILE, BACKWARD_WARPS = 32, 8
"""The largest that keep all sums in registers: ptxas spills from 64 points on, for sm_80 and sm_90.
Turing (sm_75) has too little shared memory for three layers backward, see `has_room`."""
BACKWARD_PROGRAMS = 512
"""About four on each of an H200's 132 processors; each writes one sum of weight gradients."""


@triton.jit
def _rows_of(values, row, num_rows, WIDTH: tl.constexpr, PADDED: tl.constexpr):
    """[B, PADDED] float32 of values [P, WIDTH], zeros beyond either."""
    column = tl.arange(0, PADDED)
    kept = (row < num_rows)[:, None] & (column < WIDTH)[None, :]
    return tl.load(values + row[:, None] * WIDTH + column[None, :], mask=kept, other=0.0).to(
        tl.float32
    )


@triton.jit
def _weights_of(
    weights,
    OUT: tl.constexpr,
    OUT_PADDED: tl.constexpr,
    IN: tl.constexpr,
    IN_PADDED: tl.constexpr,
    IS_HALF: tl.constexpr,
):
    """[OUT_PADDED, IN_PADDED] of weights [OUT, IN], zeros beyond."""
    row, column = tl.arange(0, OUT_PADDED), tl.arange(0, IN_PADDED)
    kept = (row < OUT)[:, None] & (column < IN)[None, :]
    read = tl.load(weights + row[:, None] * IN + column[None, :], mask=kept, other=0.0)
    return read.to(tl.float16) if IS_HALF else read


@triton.jit
def _bias_of(bias, OUT: tl.constexpr, OUT_PADDED: tl.constexpr):
    row = tl.arange(0, OUT_PADDED)
    return tl.load(bias + row, mask=row < OUT, other=0.0)


@triton.jit
def _product(left, right, IS_HALF: tl.constexpr):
    """A matrix product with float32 sums; in float16, or exact for tests."""
    if IS_HALF:
        return tl.dot(left.to(tl.float16), right.to(tl.float16))
    else:
        return tl.dot(left, right, input_precision="ieee")


@triton.jit
def _forward_kernel(
    values, w1, b1, w2, b2, w3, b3, outputs, num_points,
    IN: tl.constexpr, IN_PADDED: tl.constexpr, H: tl.constexpr, H_PADDED: tl.constexpr,
    OUT: tl.constexpr, OUT_PADDED: tl.constexpr,
    IS_DEEP: tl.constexpr, IS_HALF: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """outputs [P, O] of values [P, I]; w2 and b2 belong to the second hidden layer of three."""
    row = tl.program_id(0).to(tl.int64) * B + tl.arange(0, B)
    x = _rows_of(values, row, num_points, IN, IN_PADDED)
    first = _weights_of(w1, H, H_PADDED, IN, IN_PADDED, IS_HALF)
    h = _product(x, tl.trans(first), IS_HALF) + _bias_of(b1, H, H_PADDED)[None, :]
    h = tl.maximum(h, 0.0)
    if IS_DEEP:
        second = _weights_of(w2, H, H_PADDED, H, H_PADDED, IS_HALF)
        h = _product(h, tl.trans(second), IS_HALF) + _bias_of(b2, H, H_PADDED)[None, :]
        h = tl.maximum(h, 0.0)
    last = _weights_of(w3, OUT, OUT_PADDED, H, H_PADDED, IS_HALF)
    found = _product(h, tl.trans(last), IS_HALF) + _bias_of(b3, OUT, OUT_PADDED)[None, :]
    column = tl.arange(0, OUT_PADDED)
    kept = (row < num_points)[:, None] & (column < OUT)[None, :]
    tl.store(outputs + row[:, None] * OUT + column[None, :], found, mask=kept)


@triton.jit
def _add_out(
    sums, gradient, OUT: tl.constexpr, OUT_PADDED: tl.constexpr, IN: tl.constexpr,
    IN_PADDED: tl.constexpr,
):  # fmt: skip
    """Write a padded [OUT_PADDED, IN_PADDED] gradient as [OUT, IN]."""
    row, column = tl.arange(0, OUT_PADDED), tl.arange(0, IN_PADDED)
    kept = (row < OUT)[:, None] & (column < IN)[None, :]
    tl.store(sums + row[:, None] * IN + column[None, :], gradient, mask=kept)


@triton.jit
def _backward_kernel(
    values, w1, b1, w2, b2, w3, b3, incoming, value_gradient, sums, num_points,
    IN: tl.constexpr, IN_PADDED: tl.constexpr, H: tl.constexpr, H_PADDED: tl.constexpr,
    OUT: tl.constexpr, OUT_PADDED: tl.constexpr,
    IS_DEEP: tl.constexpr, IS_HALF: tl.constexpr, WANTS_VALUES: tl.constexpr,
    NUM_SUMS: tl.constexpr, TILES: tl.constexpr, B: tl.constexpr,
):  # fmt: skip
    """value_gradient [P, I], and into sums [programs, NUM_SUMS] w1, b1, (w2, b2,) w3, b3."""
    program = tl.program_id(0)
    first = _weights_of(w1, H, H_PADDED, IN, IN_PADDED, IS_HALF)
    first_bias = _bias_of(b1, H, H_PADDED)[None, :]
    last = _weights_of(w3, OUT, OUT_PADDED, H, H_PADDED, IS_HALF)
    first_sum = tl.zeros([H_PADDED, IN_PADDED], tl.float32)
    first_bias_sum = tl.zeros([H_PADDED], tl.float32)
    last_sum = tl.zeros([OUT_PADDED, H_PADDED], tl.float32)
    last_bias_sum = tl.zeros([OUT_PADDED], tl.float32)
    if IS_DEEP:
        second = _weights_of(w2, H, H_PADDED, H, H_PADDED, IS_HALF)
        second_bias = _bias_of(b2, H, H_PADDED)[None, :]
        second_sum = tl.zeros([H_PADDED, H_PADDED], tl.float32)
        second_bias_sum = tl.zeros([H_PADDED], tl.float32)
    for tile in range(TILES):
        row = (program.to(tl.int64) * TILES + tile) * B + tl.arange(0, B)
        x = _rows_of(values, row, num_points, IN, IN_PADDED)
        g = _rows_of(incoming, row, num_points, OUT, OUT_PADDED)
        h = tl.maximum(_product(x, tl.trans(first), IS_HALF) + first_bias, 0.0)
        if IS_DEEP:
            top = tl.maximum(_product(h, tl.trans(second), IS_HALF) + second_bias, 0.0)
        else:
            top = h
        last_sum += _product(tl.trans(g), top, IS_HALF)
        last_bias_sum += tl.sum(g, axis=0)
        g = tl.where(top > 0.0, _product(g, last, IS_HALF), 0.0)
        if IS_DEEP:
            second_sum += _product(tl.trans(g), h, IS_HALF)
            second_bias_sum += tl.sum(g, axis=0)
            g = tl.where(h > 0.0, _product(g, second, IS_HALF), 0.0)
        first_sum += _product(tl.trans(g), x, IS_HALF)
        first_bias_sum += tl.sum(g, axis=0)
        if WANTS_VALUES:
            column = tl.arange(0, IN_PADDED)
            kept = (row < num_points)[:, None] & (column < IN)[None, :]
            target = value_gradient + row[:, None] * IN + column[None, :]
            tl.store(target, _product(g, first, IS_HALF), mask=kept)
    start = sums + program * NUM_SUMS
    hidden, output = tl.arange(0, H_PADDED), tl.arange(0, OUT_PADDED)
    _add_out(start, first_sum, H, H_PADDED, IN, IN_PADDED)
    tl.store(start + H * IN + hidden, first_bias_sum, mask=hidden < H)
    start += H * IN + H
    if IS_DEEP:
        _add_out(start, second_sum, H, H_PADDED, H, H_PADDED)
        tl.store(start + H * H + hidden, second_bias_sum, mask=hidden < H)
        start += H * H + H
    _add_out(start, last_sum, OUT, OUT_PADDED, H, H_PADDED)
    tl.store(start + OUT * H + output, last_bias_sum, mask=output < OUT)


def _sizes(widths: Sequence[int]) -> dict[str, int]:
    """I, H and O as they are and padded for the matrix units."""
    sizes = {}
    for name, width in zip(("IN", "H", "OUT"), (widths[0], widths[1], widths[-1]), strict=True):
        sizes[name] = width
        sizes[f"{name}_PADDED"] = max(LEAST_DOT, triton.next_power_of_2(width))
    return sizes


class _FusedMLP(torch.autograd.Function):
    """values [P, I], is_half, then weight and bias of each layer."""

    @staticmethod
    def forward(ctx: Any, values: Tensor, is_half: bool, *parameters: Tensor) -> Tensor:
        widths = [values.shape[1], *(weight.shape[0] for weight in parameters[::2])]
        outputs = torch.empty(len(values), widths[-1], dtype=torch.float32, device=values.device)
        ctx.save_for_backward(values, *parameters)
        ctx.is_half, ctx.widths = is_half, widths
        if len(values):
            _forward_kernel[(triton.cdiv(len(values), FORWARD_TILE),)](
                values,
                *_six(parameters),
                outputs,
                len(values),
                **_sizes(widths),
                IS_DEEP=len(parameters) == 6,
                IS_HALF=is_half,
                B=FORWARD_TILE,
                num_warps=FORWARD_WARPS,
            )
        return outputs

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        values, *parameters = ctx.saved_tensors
        counts = [parameter.numel() for parameter in parameters]
        num_tiles = triton.cdiv(len(values), BACKWARD_TILE)
        # A power of two, so that other numbers of points seldom need another kernel.
        tiles = triton.next_power_of_2(max(1, triton.cdiv(num_tiles, BACKWARD_PROGRAMS)))
        num_programs = triton.cdiv(num_tiles, tiles)
        sums = torch.empty(num_programs, sum(counts), dtype=torch.float32, device=values.device)
        value_gradient = torch.empty(values.shape, dtype=torch.float32, device=values.device)
        if num_programs:
            _backward_kernel[(num_programs,)](
                values,
                *_six(parameters),
                gradients[0].contiguous(),
                value_gradient,
                sums,
                len(values),
                **_sizes(ctx.widths),
                IS_DEEP=len(parameters) == 6,
                IS_HALF=ctx.is_half,
                WANTS_VALUES=ctx.needs_input_grad[0],
                NUM_SUMS=sum(counts),
                TILES=tiles,
                B=BACKWARD_TILE,
                num_warps=BACKWARD_WARPS,
            )
        parts = sums.sum(dim=0).split(counts)
        learned = (part.view_as(own) for part, own in zip(parts, parameters, strict=True))
        wanted = value_gradient.to(values.dtype) if ctx.needs_input_grad[0] else None
        return wanted, None, *learned


def _six(parameters: Sequence[Tensor]) -> tuple[Tensor, ...]:
    """The kernels' six arrays; without a second hidden layer the first stands in, unread."""
    return tuple(parameters) if len(parameters) == 6 else (*parameters[:2], *parameters)


def supports(layers: Iterable[nn.Module]) -> bool:
    """Two or three linear layers with biases, at most 64 wide, hidden ones alike, in float32."""
    everything = list(layers)
    linears = [layer for layer in everything if isinstance(layer, nn.Linear)]
    widths = [layer.out_features for layer in linears]
    return (
        len(everything) == len(linears)
        and len(linears) in (2, 3)
        and max(linears[0].in_features, *widths) <= MAX_WIDTH
        and len(set(widths[:-1])) == 1
        and all(layer.bias is not None for layer in linears)
        and all(layer.weight.dtype == torch.float32 for layer in linears)
    )


def has_room(device: torch.device) -> bool:
    """Whether the device has the shared memory and matrix units that the kernels want: from sm_80
    (Ampere) on."""
    return device.type == "cuda" and torch.cuda.get_device_capability(device) >= (8, 0)


def fused_mlp(values: Tensor, layers: Iterable[nn.Module], *, half: bool = True) -> Tensor:
    """What `fields.MLP` of these layers gives, by Triton; once differentiable.

    values: [..., I] float32 or float16, on the device of the layers. layers: `MLP.layers`.
    half: products of float16 with float32 sums; otherwise float32 throughout, slowly.
    Returns [..., O] float32. Raises NerfError `bad_config` for layers that are not `supports`.
    """
    everything = list(layers)
    linears = [layer for layer in everything if isinstance(layer, nn.Linear)]
    widths = [layer.out_features for layer in linears]
    if not supports(everything) or values.shape[-1] != linears[0].in_features:
        inputs = [layer.in_features for layer in linears[:1]]
        raise NerfError(
            "bad_config",
            f"The fused network takes two or three layers of at most {MAX_WIDTH}, hidden ones of "
            f"one width; these are {inputs + widths}, for values {list(values.shape)}.",
            "Use the engine 'plain'.",
        )
    parameters = [part for layer in linears for part in (layer.weight, layer.bias)]
    flat = values.reshape(-1, values.shape[-1]).contiguous()
    outputs: Tensor = _FusedMLP.apply(flat, half, *parameters)
    return outputs.reshape(*values.shape[:-1], outputs.shape[-1])
