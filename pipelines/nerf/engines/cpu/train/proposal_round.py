"""The kernel of a proposal round for training: positions, density network, weights, and back.

Symbols: R rays, S samples, L levels, I = 2 L features, H hidden units; x = sigma d is the optical
thickness of a sample, T the transmittance before it, w = T (1 - exp(-x)). A block of rays goes
through all steps in one thread's scratch; the samples of its rays lie one behind the other, in
tiles of TILE columns. Launching it is left to `train_proposal`.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pipelines.nerf.engines.cpu.parts.dense_layers import (
    TILE,
    PackedLayer,
    add_products,
    apply_layer,
)
from pipelines.nerf.engines.cpu.parts.hash_lanes import (
    PLACE_ROWS,
    GridArrays,
    encode_columns,
    scatter_columns,
)
from pipelines.nerf.engines.cpu.parts.intervals import INSIDE, place_ray
from pipelines.nerf.engines.cpu.parts.lanes import exp_all, expm1_all
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged
from pipelines.nerf.networks.fields import GRADIENT_CLAMP

ONE, ZERO = np.float32(1.0), np.float32(0.0)
LEAST_SLOPE, MOST_SLOPE = (np.float32(math.exp(s * GRADIENT_CLAMP)) for s in (-1.0, 1.0))


class RoundNet(NamedTuple):
    """A density network as arrays. to_hidden, to_features: its layers for gradients, transposed."""

    grid: GridArrays
    hidden: PackedLayer
    output: PackedLayer
    to_hidden: PackedLayer
    to_features: PackedLayer
    num_hidden: Any
    density_scale: Any
    contraction: Any


class Gradients(NamedTuple):
    """What shares add up: share 0 adds to `table`, share k to more_tables[k - 1].

    hidden, output: [shares, ...] as `add_products`; a further input of ones stands for the bias.
    """

    table: Any
    more_tables: Any
    hidden: Any
    output: Any


class Scratch(NamedTuple):
    """What one thread needs for a block of N samples; a tile's rows are TILE columns long."""

    columns: Any  # [NUM_COLUMN_ROWS, N]: the place as `place_ray`, then the rows named below
    features: Any  # [N / TILE, I padded to 4 + 4, TILE]: a row of ones after the padding
    hidden: Any  # [N / TILE, H padded to 4 + 4, TILE]: likewise
    outputs: Any  # [4, TILE]
    grad_outputs: Any  # [4, TILE]
    grad_hidden: Any  # [H padded, TILE]
    grad_features: Any  # [I padded, TILE]
    places: Any  # [PLACE_ROWS, TILE]


WIDTH = INSIDE + 1  # length of the interval
GROWTH, THICKNESS, PASSED, STOPPED = 5, 6, 7, 8  # exp(logit), -x, T, exp(-x) - 1
WORK, SLOPE = 9, 10  # log T, then exp(-x); dL / dlogit
NUM_COLUMN_ROWS = 11


@merged
def _make_scratch(net, num_samples, rays_per_block):
    num_columns = (rays_per_block * num_samples + TILE - 1) // TILE * TILE
    tiles = num_columns // TILE
    inputs, width = net.to_features.bias.size, net.hidden.bias.size
    features = np.zeros((tiles, inputs + 4, TILE), np.float32)
    hidden = np.zeros((tiles, width + 4, TILE), np.float32)
    features[:, inputs] = ONE
    hidden[:, width] = ONE
    columns = np.zeros((NUM_COLUMN_ROWS, num_columns), np.float32)
    rows = np.zeros((8 + width + inputs + PLACE_ROWS, TILE), np.float32)
    grad_hidden, grad_features = rows[8 : 8 + width], rows[8 + width : 8 + width + inputs]
    places = rows[8 + width + inputs :]
    return Scratch(
        columns, features, hidden, rows[:4], rows[4:8], grad_hidden, grad_features, places
    )


@merged
def _place_block(origins, directions, t_edges, rays, num_rays, net, columns):
    """Unit points and widths of the samples of the first of `rays`, one ray behind the other."""
    num_samples = t_edges.shape[1] - 1
    for k in range(num_rays):
        ray, first = rays[k], k * num_samples
        edges = t_edges[ray]
        place_ray(
            origins[ray], directions[ray], edges, num_samples, net.contraction, first, columns
        )
        for i in range(num_samples):
            columns[WIDTH, first + i] = edges[i + 1] - edges[i]


@merged
def _find_density(net, scratch, num_columns):
    """exp(logit) of the first columns; features and hidden units stay in the scratch."""
    for tile in range((num_columns + TILE - 1) // TILE):
        begin = tile * TILE
        count = min(TILE, num_columns - begin)
        features, hidden = scratch.features[tile], scratch.hidden[tile]
        encode_columns(scratch.columns, begin, count, net.grid, features)
        apply_layer(features, net.hidden, count, True, False, hidden)
        apply_layer(hidden, net.output, count, False, False, scratch.outputs)
        exp_all(scratch.outputs[0], count, scratch.columns[GROWTH, begin:])


@merged
def _find_transmittance(net, columns, num_rays, num_samples):
    """-x, T and exp(-x) - 1 of the first rays of the block."""
    column = 0
    for _ in range(num_rays):
        depth = 0.0  # in float64, rounded once per sample, as torch adds up
        for _ in range(num_samples):
            density = net.density_scale * columns[GROWTH, column] * columns[INSIDE, column]
            thickness = density * columns[WIDTH, column]
            columns[THICKNESS, column] = -thickness
            columns[WORK, column] = -np.float32(depth)
            depth += thickness
            column += 1
    exp_all(columns[WORK], column, columns[PASSED])
    expm1_all(columns[THICKNESS], column, columns[STOPPED])


@merged
def _write_weights(columns, rays, num_rays, weights):
    column = 0
    for k in range(num_rays):
        for i in range(weights.shape[1]):
            weight = -columns[PASSED, column] * columns[STOPPED, column]
            # An infinite density in an interval of no width is 0 * inf; it holds nothing.
            weights[rays[k], i] = weight if weight == weight else ZERO
            column += 1


@merged
def _differentiate_weights(net, columns, rays, num_rays, grad_weights):
    """dL / dlogit from g = dL / dw: with e = exp(-x), dL / dx_i = g_i T_i e_i - sum_k>i g_k w_k.

    Where a weight is not a number it is a constant 0.
    """
    num_samples = grad_weights.shape[1]
    exp_all(columns[THICKNESS], num_rays * num_samples, columns[WORK])
    for k in range(num_rays):
        behind = 0.0
        for i in range(num_samples - 1, -1, -1):
            column = k * num_samples + i
            g = grad_weights[rays[k], i]
            passed = columns[PASSED, column]
            weight = -passed * columns[STOPPED, column]
            slope = ZERO
            if weight == weight:
                grad_thickness = g * passed * columns[WORK, column] - np.float32(behind)
                growth = min(max(columns[GROWTH, column], LEAST_SLOPE), MOST_SLOPE)
                factor = net.density_scale * growth * columns[INSIDE, column]
                slope = grad_thickness * columns[WIDTH, column] * factor
                behind += g * weight
            columns[SLOPE, column] = slope


@merged
def _differentiate_network(net, scratch, num_columns, grad_table, grad_hidden, grad_output):
    """Add the gradients of table and layers for the slopes of the first columns."""
    upstream, upstream_hidden = scratch.grad_outputs, scratch.grad_hidden
    for tile in range((num_columns + TILE - 1) // TILE):
        begin = tile * TILE
        count = min(TILE, num_columns - begin)
        features, hidden = scratch.features[tile], scratch.hidden[tile]
        for column in range(TILE):  # beyond `count` zeros, since sums take 16 columns at a time
            value = scratch.columns[SLOPE, begin + column]
            upstream[0, column] = value if column < count else ZERO
        add_products(upstream, hidden, count, grad_output)
        apply_layer(upstream, net.to_hidden, count, False, False, upstream_hidden)
        for row in range(len(upstream_hidden)):
            for column in range(TILE):
                alive = hidden[row, column] > ZERO and column < count
                upstream_hidden[row, column] = upstream_hidden[row, column] if alive else ZERO
        add_products(upstream_hidden, features, count, grad_hidden)
        apply_layer(upstream_hidden, net.to_features, count, False, False, scratch.grad_features)
        scatter_columns(
            scratch.columns,
            begin,
            count,
            net.grid,
            scratch.grad_features,
            scratch.places,
            grad_table,
        )


@compiled
def run_rounds(
    share, shares, net, origins, directions, t_edges, per_block, weights, learn, gradients
):
    """Every n-th group of rays: weights [R, S] or, to learn, the gradients for dL / dw in them.

    To learn, rays without a gradient are left out before blocks are made, so that blocks are full.
    """
    num_rays, num_samples = weights.shape
    scratch = _make_scratch(net, num_samples, per_block)
    grad_table = gradients.table
    if learn and share > 0:
        grad_table = gradients.more_tables[share - 1]
    slot = share if learn else 0
    grad_hidden, grad_output = gradients.hidden[slot], gradients.output[slot]
    rays = np.zeros(per_block, np.int64)
    filled = np.int64(0)
    stride = shares * per_block
    last = (num_rays - 1 - share * per_block) // stride * stride + share * per_block
    for begin in range(share * per_block, num_rays, stride):
        end = min(begin + per_block, num_rays)
        for ray in range(begin, end):
            needed = not learn
            if learn:
                for i in range(num_samples):
                    needed |= weights[ray, i] != ZERO
            if needed:
                rays[filled] = ray
                filled += 1
            if filled == per_block or (filled > 0 and begin == last and ray == end - 1):
                _place_block(origins, directions, t_edges, rays, filled, net, scratch.columns)
                _find_density(net, scratch, filled * num_samples)
                _find_transmittance(net, scratch.columns, filled, num_samples)
                if learn:
                    _differentiate_weights(net, scratch.columns, rays, filled, weights)
                    _differentiate_network(
                        net, scratch, filled * num_samples, grad_table, grad_hidden, grad_output
                    )
                else:
                    _write_weights(scratch.columns, rays, filled, weights)
                filled = np.int64(0)


@compiled
def add_tables(share, shares, more_tables, table):
    """table [E, 2] += more_tables [K, E, 2], in the order of K."""
    entries = len(table)
    begin, end = entries * share // shares, entries * (share + 1) // shares
    for k in range(len(more_tables)):
        more = more_tables[k]
        for entry in range(begin, end):
            table[entry, 0] += more[entry, 0]
            table[entry, 1] += more[entry, 1]
