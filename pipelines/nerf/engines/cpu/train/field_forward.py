"""The field for training, forward: from rays and intervals to colours and weights, fused by blocks.

Symbols: R rays, S samples, TILE samples that pass the layers together, N tiles, L * F features, G
geometry features, A appearance numbers. A block is BLOCK_RAYS rays; its samples lie ray after ray
in its tiles, and only its last tile has columns to spare. Twin of `fields.NerfactoField`,
`intervals.weights_from_density` and `rendering.composite` together.

Kept for the backward pass per sample: its place, the grid's features, density and colour. What the
layers say in between is computed again there, which is cheaper than to write and read it.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from pipelines.nerf.engines.cpu.parts.color_net import direction_harmonics
from pipelines.nerf.engines.cpu.parts.dense_layers import LANES, TILE, PackedLayer, apply_layer
from pipelines.nerf.engines.cpu.parts.hash_lanes import GridArrays
from pipelines.nerf.engines.cpu.parts.intervals import INSIDE, find_weights, place_ray
from pipelines.nerf.engines.cpu.parts.lanes import exp_all
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged
from pipelines.nerf.space.harmonics import NUM_SPHERICAL_HARMONICS

BLOCK_RAYS = LANES
"""Rays whose shares of the colour network's first layer fill one vector."""

ZERO, ONE = np.float32(0.0), np.float32(1.0)


class FieldNet(NamedTuple):
    """The field as arrays.

    density_hidden: L * F -> H. density_output: H -> 1 + G, the logit first. The colour network's
    first layer in two parts: from_ray takes harmonics and code (16 + A) and holds the bias,
    from_outputs all outputs of the density network with weight 0 for the logit. color_hidden,
    color_output: the layers behind it.
    """

    grid: GridArrays
    density_hidden: PackedLayer
    density_output: PackedLayer
    from_ray: PackedLayer
    from_outputs: PackedLayer
    color_hidden: PackedLayer
    color_output: PackedLayer


class Settings(NamedTuple):
    """density_scale: density at logit 0. contraction: code. last_sample: it is the background."""

    density_scale: Any
    contraction: Any
    last_sample: Any


class RayBatch(NamedTuple):
    """origins, directions [R, 3], t_edges [R, S + 1], codes [R, A], background [R, 3]: float32."""

    origins: Any
    directions: Any
    t_edges: Any
    codes: Any
    background: Any


class Kept(NamedTuple):
    """What backward reads; N tiles of all blocks.

    counts [N] samples of each tile. points [N, 4, TILE] as `intervals.place_ray`, 0 where no sample
    is. features [N, L * F, TILE] (rows padded to 4) and their slopes [N, 3 L * F, TILE], or
    [N, 0, TILE] where no gradient flows to the points. density [R, S], colors [R * S, 3].
    """

    counts: Any
    points: Any
    features: Any
    slopes: Any
    density: Any
    colors: Any


class LayerRows(NamedTuple):
    """What each layer gives, or the gradient of that, for one tile; rows padded to 4, [.., TILE].

    per_ray, ray_inputs: the rays' share of the first colour layer and what it is made from, a ray
    in each column.
    """

    density_hidden: Any
    outputs: Any
    first: Any
    second: Any
    logits: Any
    ray_inputs: Any
    per_ray: Any


class Activations(NamedTuple):
    """Scratch of a share, forward.

    growth [TILE]: exp of the density's logits. ray_rows [2, S or more]: for a ray's weights.
    """

    layers: LayerRows
    growth: Any
    ray_rows: Any


@merged
def _padded_rows(rows):
    """Zeros [rows padded to 4, TILE]."""
    return np.zeros(((rows + 3) // 4 * 4, TILE), np.float32)


@merged
def make_layer_rows(net):
    """Zeros for one tile."""
    return LayerRows(
        _padded_rows(net.density_hidden.bias.size),
        _padded_rows(net.density_output.bias.size),
        _padded_rows(net.from_ray.bias.size),
        _padded_rows(net.color_hidden.bias.size),
        _padded_rows(net.color_output.bias.size),
        _padded_rows(net.from_ray.weights.shape[1]),
        _padded_rows(net.from_ray.bias.size),
    )


@merged
def whole_lanes(count):
    """The numbers that vectors of 16 touch of so many."""
    return (count + LANES - 1) // LANES * LANES


@merged
def _make_activations(net, num_samples):
    return Activations(
        make_layer_rows(net),
        np.zeros(TILE, np.float32),
        np.zeros((2, whole_lanes(num_samples)), np.float32),
    )


@compiled
def tiles_of_block(num_samples):
    """Tiles that hold the samples of a whole block."""
    return (BLOCK_RAYS * num_samples + TILE - 1) // TILE


@merged
def ray_shares(net, rays, begin, end, layers):
    """layers.per_ray[:, :end - begin] = the rays' share of the colour network's first layer."""
    num_codes = rays.codes.shape[1]
    for ray in range(begin, end):
        direction_harmonics(rays.directions[ray], layers.ray_inputs, ray - begin)
        for a in range(num_codes):
            layers.ray_inputs[NUM_SPHERICAL_HARMONICS + a, ray - begin] = rays.codes[ray, a]
    apply_layer(layers.ray_inputs, net.from_ray, end - begin, False, False, layers.per_ray)


@merged
def hidden_layers(net, features, first_sample, count, num_samples, layers):
    """All but the last colour layer for a tile; sample `first_sample` of the block comes first.

    features: [L * F, TILE]. Fills density_hidden, outputs, first and second of `layers`.
    """
    apply_layer(features, net.density_hidden, count, True, False, layers.density_hidden)
    apply_layer(layers.density_hidden, net.density_output, count, False, False, layers.outputs)
    first = layers.first
    stop = whole_lanes(count)
    column = 0
    while column < count:
        ray = (first_sample + column) // num_samples
        end = min((ray + 1) * num_samples - first_sample, count)
        for row in range(first.shape[0]):
            value = layers.per_ray[row, ray]
            for c in range(column, end):
                first[row, c] = value
        column = end
    for row in range(first.shape[0]):
        for c in range(count, stop):
            first[row, c] = ZERO
    apply_layer(layers.outputs, net.from_outputs, count, True, True, first)
    apply_layer(first, net.color_hidden, count, True, False, layers.second)


@compiled
def place_samples(share, shares, rays, settings, counts, points):
    """Places [N, 4, TILE] of the middles of all intervals, as `place_ray`."""
    num_samples = rays.t_edges.shape[1] - 1
    tiles = tiles_of_block(num_samples)
    for number in range(share, len(counts), shares):
        block, tile = divmod(number, tiles)
        first = block * BLOCK_RAYS * num_samples + tile * TILE
        column = 0
        while column < counts[number]:
            ray, sample = divmod(first + column, num_samples)
            count = min(num_samples - sample, counts[number] - column)
            place_ray(
                rays.origins[ray],
                rays.directions[ray],
                rays.t_edges[ray, sample:],
                count,
                settings.contraction,
                column,
                points[number],
            )
            column += count


@merged
def _store_tile(net, settings, kept, scratch, first, number, count):
    """Density and colour of a tile whose hidden layers are known."""
    logits = scratch.layers.logits
    apply_layer(scratch.layers.second, net.color_output, count, False, False, logits)
    for channel in range(3):
        for c in range(count):
            logits[channel, c] = -logits[channel, c]
        exp_all(logits[channel], count, logits[channel])
        for c in range(count):
            kept.colors[first + c, channel] = ONE / (ONE + logits[channel, c])
    exp_all(scratch.layers.outputs[0], count, scratch.growth)
    density = kept.density.reshape(-1)
    for c in range(count):
        found = settings.density_scale * scratch.growth[c]
        density[first + c] = found if kept.points[number, INSIDE, c] > ZERO else ZERO


@merged
def _composite(rays, settings, kept, scratch, ray, rgb, weights):
    """Weights and colour of one ray."""
    num_samples = weights.shape[1]
    total = find_weights(
        kept.density[ray], rays.t_edges[ray], num_samples, scratch.ray_rows, weights[ray]
    )
    missing = ONE - np.float32(total)
    start = ray * num_samples
    for channel in range(3):
        color = ZERO
        for sample in range(num_samples):
            color += weights[ray, sample] * kept.colors[start + sample, channel]
        behind = rays.background[ray, channel]
        if settings.last_sample:
            behind = kept.colors[start + num_samples - 1, channel]
        rgb[ray, channel] = color + missing * behind


@compiled
def forward_blocks(share, shares, net, settings, rays, kept, rgb, weights):
    """Density, colour, rgb [R, 3] and weights [R, S] of every n-th block; features are known."""
    num_rays, num_samples = weights.shape
    tiles = tiles_of_block(num_samples)
    scratch = _make_activations(net, num_samples)
    for block in range(share, (num_rays + BLOCK_RAYS - 1) // BLOCK_RAYS, shares):
        first_ray = block * BLOCK_RAYS
        end_ray = min(first_ray + BLOCK_RAYS, num_rays)
        total = (end_ray - first_ray) * num_samples
        ray_shares(net, rays, first_ray, end_ray, scratch.layers)
        for tile in range((total + TILE - 1) // TILE):
            number, done = block * tiles + tile, tile * TILE
            count, first = min(TILE, total - done), first_ray * num_samples + done
            features = kept.features[number]
            hidden_layers(net, features, done, count, num_samples, scratch.layers)
            _store_tile(net, settings, kept, scratch, first, number, count)
        for ray in range(first_ray, end_ray):
            _composite(rays, settings, kept, scratch, ray, rgb, weights)
