"""Small dense layers on the CPU: a column of samples times a packed weight matrix.

Activations lie as [features, TILE] float32, one column per sample, so that the vector units work on
16 samples at once. LLVM does not find that by itself in loops of unknown length, so the innermost
block (4 outputs x 16 samples) is written as LLVM vector code; it is portable, and becomes AVX2,
AVX-512 or NEON for the machine at hand. Weights are packed in blocks of 4 outputs.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from torch import nn

from pipelines.nerf.kernels.runtime import compiled

LANES = 16
BLOCK = 4
TILE = 128
"""Samples that go through the layers together; a multiple of LANES."""


class PackedLayer(NamedTuple):
    """A linear layer for `apply_layer`.

    weights: [O / 4, I, 4] float32, outputs padded with zeros to a multiple of 4. bias: [O].
    """

    weights: Any
    bias: Any


def pack_layer(layer: nn.Linear, columns: slice = slice(None)) -> PackedLayer:
    """Weights of a layer, or of some of its inputs (`columns`), in the order of `apply_layer`."""
    weight = layer.weight.detach().cpu().float().numpy()[:, columns]
    num_outputs, num_inputs = weight.shape
    padded = -(-num_outputs // BLOCK) * BLOCK
    weights = np.zeros((padded, num_inputs), np.float32)
    weights[:num_outputs] = weight
    bias = np.zeros(padded, np.float32)
    if layer.bias is not None:
        bias[:num_outputs] = layer.bias.detach().cpu().float().numpy()
    blocks = weights.reshape(padded // BLOCK, BLOCK, num_inputs).transpose(0, 2, 1)
    return PackedLayer(np.ascontiguousarray(blocks), bias)


@intrinsic
def _block(typing_context, x, weights, bias, num_inputs, out, row_bytes, relu, accumulate):
    """4 outputs of 16 samples; all arguments are integers, addresses in bytes.

    x, out: first of the 16 samples in the first row; rows are row_bytes apart. With `accumulate`
    the sum starts from what `out` holds instead of from the bias. With `relu` it ends in max(., 0).
    """
    signature = types.void(*[types.intp] * 8)
    return signature, _generate_block


def _generate_block(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    x, weights, bias, num_inputs, out, row_bytes, relu, accumulate = arguments
    number, integer = ir.FloatType(), x.type
    vector = ir.VectorType(number, LANES)
    lanes = ir.Constant(ir.VectorType(ir.IntType(32), LANES), [0] * LANES)
    undefined, zero = ir.Constant(vector, ir.Undefined), ir.Constant(integer, 0)

    def load(address: Any, kind: Any) -> Any:
        return builder.load(builder.inttoptr(address, kind.as_pointer()), align=4)

    def splat(value: Any) -> Any:
        single = builder.insert_element(undefined, value, ir.Constant(ir.IntType(32), 0))
        return builder.shuffle_vector(single, undefined, lanes)

    def offset(base: Any, num_bytes: int) -> Any:
        return builder.add(base, ir.Constant(integer, num_bytes))

    rows = [out]
    for _ in range(BLOCK - 1):
        rows.append(builder.add(rows[-1], row_bytes))
    keep = builder.icmp_signed("!=", accumulate, zero)
    starts = [
        builder.select(keep, load(row, vector), splat(load(offset(bias, 4 * lane), number)))
        for lane, row in enumerate(rows)
    ]

    entry = builder.block
    loop = builder.append_basic_block("inputs")
    done = builder.append_basic_block("done")
    builder.branch(loop)
    builder.position_at_end(loop)
    index = builder.phi(integer)
    x_at, w_at = builder.phi(integer), builder.phi(integer)
    sums = [builder.phi(vector) for _ in rows]
    values = load(x_at, vector)
    flags = ("contract", "nsz", "reassoc")
    added = [
        builder.fadd(
            total,
            builder.fmul(splat(load(offset(w_at, 4 * lane), number)), values, flags=flags),
            flags=flags,
        )
        for lane, total in enumerate(sums)
    ]
    following = offset(index, 1)
    for phi, first, then in (
        (index, zero, following),
        (x_at, x, builder.add(x_at, row_bytes)),
        (w_at, weights, offset(w_at, 4 * BLOCK)),
        *zip(sums, starts, added, strict=True),
    ):
        phi.add_incoming(first, entry)
        phi.add_incoming(then, loop)
    builder.cbranch(builder.icmp_signed("<", following, num_inputs), loop, done)

    builder.position_at_end(done)
    rectify = builder.icmp_signed("!=", relu, zero)
    nothing = ir.Constant(vector, [0.0] * LANES)
    for row, total in zip(rows, added, strict=True):
        # Compared this way round a NaN stays a NaN, as in torch.
        positive = builder.select(builder.fcmp_ordered("<", total, nothing), nothing, total)
        result = builder.select(rectify, positive, total)
        builder.store(result, builder.inttoptr(row, vector.as_pointer()), align=4)
    return context.get_dummy_value()


@compiled
def apply_layer(x, layer, count, relu, accumulate, out):
    """out = layer(x) for the first `count` samples.

    x: [I, TILE], out: [O, TILE], contiguous float32; O padded to a multiple of 4. Up to 15 columns
    behind `count` are overwritten with numbers that mean nothing.
    """
    num_blocks, num_inputs, _ = layer.weights.shape
    row_bytes = TILE * 4
    x_at, out_at = np.intp(x.ctypes.data), np.intp(out.ctypes.data)
    w_at, b_at = np.intp(layer.weights.ctypes.data), np.intp(layer.bias.ctypes.data)
    for first in range(0, count, LANES):
        for block in range(num_blocks):
            _block(  # type: ignore[call-arg]  # numba passes the typing context
                x_at + first * 4,
                w_at + block * num_inputs * BLOCK * 4,
                b_at + block * BLOCK * 4,
                num_inputs,
                out_at + block * BLOCK * row_bytes + first * 4,
                row_bytes,
                np.intp(relu),
                np.intp(accumulate),
            )
