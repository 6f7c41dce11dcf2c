"""Small dense layers on the CPU: a column of samples times a packed weight matrix.

Activations lie as [features, TILE] float32, one column per sample, so that the vector units work on
16 samples at once. LLVM does not find that by itself in loops of unknown length, so the innermost
block (4 outputs x 16 samples) is written as LLVM vector code; it is portable, and becomes AVX2,
AVX-512 or NEON for the machine at hand. Weights are packed in blocks of 4 outputs.

For training: a layer's gradient towards its inputs is `apply_layer` with the transposed weights
(`pack_transposed`); the one towards its weights is a sum of products over samples, `add_products`.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray
from torch import nn

from pipelines.nerf.engines.cpu.parts.runtime import compiled

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
    bias = None if layer.bias is None else layer.bias.detach().cpu().float().numpy()
    return pack_arrays(weight, bias)


def pack_arrays(weight: NDArray[np.float32], bias: NDArray[np.float32] | None) -> PackedLayer:
    """A copy of weight [O, I] and bias [O] (zeros for None) in the order of `apply_layer`."""
    num_outputs, num_inputs = weight.shape
    padded = round_up(num_outputs, BLOCK)
    weights = np.zeros((padded, num_inputs), np.float32)
    weights[:num_outputs] = weight
    padded_bias = np.zeros(padded, np.float32)
    if bias is not None:
        padded_bias[:num_outputs] = bias
    blocks = weights.reshape(padded // BLOCK, BLOCK, num_inputs).transpose(0, 2, 1)
    return PackedLayer(np.ascontiguousarray(blocks), padded_bias)


def pack_transposed(weight: NDArray[np.float32]) -> PackedLayer:
    """The layer that takes gradients of the outputs of weight [O, I] to gradients of its inputs.

    Takes O rows padded to a multiple of 4, so that it reads what `apply_layer` writes.
    """
    num_outputs, num_inputs = weight.shape
    padded = np.zeros((num_inputs, round_up(num_outputs, BLOCK)), np.float32)
    padded[:, :num_outputs] = weight.T
    return pack_arrays(padded, None)


def round_up(number: int, unit: int) -> int:
    """The smallest multiple of `unit` that is at least `number`."""
    return -(-number // unit) * unit


def products_shape(num_outputs: int, num_inputs: int) -> tuple[int, int, int]:
    """The shape of the sums of `add_products` for so many rows of either side."""
    return round_up(num_outputs, BLOCK) // BLOCK, round_up(num_inputs, BLOCK) // BLOCK, BLOCK**2


def unpack_products(sums: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sums of `add_products` [O / 4, I / 4, 16] as a matrix [O, I] (both padded to 4)."""
    rows, columns, _ = sums.shape
    blocks = sums.reshape(rows, columns, BLOCK, BLOCK).transpose(0, 2, 1, 3)
    return np.ascontiguousarray(blocks).reshape(rows * BLOCK, columns * BLOCK)


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


@intrinsic
def _product_block(typing_context, left, right, num_steps, row_bytes, sums):
    """sums[4 i + j] += sum over samples of left[i] right[j]; 4 rows each, 16 num_steps samples.

    All arguments are integers, addresses in bytes; rows are row_bytes apart.
    """
    signature = types.void(*[types.intp] * 5)
    return signature, _generate_product_block


def _generate_product_block(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    left, right, num_steps, row_bytes, sums = arguments
    number, integer = ir.FloatType(), left.type
    vector = ir.VectorType(number, LANES)
    zero, flags = ir.Constant(integer, 0), ("contract", "nsz", "reassoc")

    def load(address: Any) -> Any:
        return builder.load(builder.inttoptr(address, vector.as_pointer()), align=4)

    def rows_at(address: Any) -> list[Any]:
        addresses = [address]
        for _ in range(BLOCK - 1):
            addresses.append(builder.add(addresses[-1], row_bytes))
        return [load(row) for row in addresses]

    entry = builder.block
    loop = builder.append_basic_block("samples")
    done = builder.append_basic_block("summed")
    builder.branch(loop)
    builder.position_at_end(loop)
    index = builder.phi(integer)
    left_at, right_at = builder.phi(integer), builder.phi(integer)
    totals = [builder.phi(vector) for _ in range(BLOCK**2)]
    left_rows, right_rows = rows_at(left_at), rows_at(right_at)
    added = [
        builder.fadd(
            total,
            builder.fmul(left_rows[i // BLOCK], right_rows[i % BLOCK], flags=flags),
            flags=flags,
        )
        for i, total in enumerate(totals)
    ]
    following = builder.add(index, ir.Constant(integer, 1))
    step = ir.Constant(integer, 4 * LANES)
    nothing = ir.Constant(vector, [0.0] * LANES)
    for phi, first, then in (
        (index, zero, following),
        (left_at, left, builder.add(left_at, step)),
        (right_at, right, builder.add(right_at, step)),
        *((total, nothing, value) for total, value in zip(totals, added, strict=True)),
    ):
        phi.add_incoming(first, entry)
        phi.add_incoming(then, loop)
    builder.cbranch(builder.icmp_signed("<", following, num_steps), loop, done)

    builder.position_at_end(done)
    result = builder.fadd(load(sums), _sums_of_lanes(builder, added))
    builder.store(result, builder.inttoptr(sums, vector.as_pointer()), align=4)
    return context.get_dummy_value()


def _sums_of_lanes(builder: Any, vectors: list[Any]) -> Any:
    """One vector whose i-th lane is the sum of all lanes of the i-th of 16 vectors.

    In each round two vectors become one that holds their groups of lanes, folded in half.
    """
    group = LANES
    while len(vectors) > 1:
        half = group // 2
        starts = range(0, 2 * LANES, group)  # of the groups of both vectors together
        low = [start + lane for start in starts for lane in range(half)]
        high = [lane + half for lane in low]
        kind = ir.VectorType(ir.IntType(32), LANES)
        vectors = [
            builder.fadd(
                builder.shuffle_vector(a, b, ir.Constant(kind, low)),
                builder.shuffle_vector(a, b, ir.Constant(kind, high)),
            )
            for a, b in zip(vectors[::2], vectors[1::2], strict=True)
        ]
        group = half
    return vectors[0]


@compiled
def add_products(left, right, count, sums):
    """sums += left right^T over the first `count` samples: a layer's weight gradient.

    left: [O, TILE] gradients of outputs, right: [I, TILE] inputs, float32, rows contiguous and
    padded to multiples of 4. sums: as `products_shape`. Up to 15 columns behind `count` are read:
    one side must be 0 there, the other finite.
    """
    row_bytes = TILE * 4
    steps = (count + LANES - 1) // LANES
    left_at, right_at = np.intp(left.ctypes.data), np.intp(right.ctypes.data)
    sums_at = np.intp(sums.ctypes.data)
    rows, columns, _ = sums.shape
    for row in range(rows):
        for column in range(columns):
            _product_block(  # type: ignore[call-arg]  # numba passes the typing context
                left_at + row * BLOCK * row_bytes,
                right_at + column * BLOCK * row_bytes,
                steps,
                row_bytes,
                sums_at + (row * columns + column) * BLOCK * BLOCK * 4,
            )
