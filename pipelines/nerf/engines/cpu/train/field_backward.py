"""The field for training, backward: from gradients of colours and weights to those of all else.

Symbols as in `field_forward`. Gradients of the layers' weights are summed per part (every
PARTS-th block of rays) and then over the parts in their order, so that results repeat whatever the
number of threads. Gradients of the features are kept per sample for the table: there each level
belongs to one thread.
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
from pipelines.nerf.engines.cpu.parts.intervals import HALF, INSIDE
from pipelines.nerf.engines.cpu.parts.lanes import exp_all
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged
from pipelines.nerf.engines.cpu.train.field_forward import (
    BLOCK_RAYS,
    ONE,
    ZERO,
    LayerRows,
    hidden_layers,
    make_layer_rows,
    ray_shares,
    tiles_of_block,
    whole_lanes,
)
from pipelines.nerf.engines.cpu.train.field_rays import harmonics_backward, place_backward
from pipelines.nerf.networks.fields import GRADIENT_CLAMP
from pipelines.nerf.space.harmonics import NUM_SPHERICAL_HARMONICS

PARTS = 16
LEAST_SLOPE, MOST_SLOPE = (np.float32(math.exp(s * GRADIENT_CLAMP)) for s in (-1.0, 1.0))


class BackwardNet(NamedTuple):
    """The layers of `FieldNet` the other way round: gradients of outputs to those of inputs."""

    density_hidden: PackedLayer
    density_output: PackedLayer
    from_ray: PackedLayer
    from_outputs: PackedLayer
    color_hidden: PackedLayer
    color_output: PackedLayer


class Sums(NamedTuple):
    """Gradients of the weights, as `add_products` sums them, and of the biases [O].

    With PARTS in front as a whole, without for one part.
    """

    density_hidden: Any
    density_hidden_bias: Any
    density_output: Any
    density_output_bias: Any
    from_ray: Any
    from_ray_bias: Any
    from_outputs: Any
    color_hidden: Any
    color_hidden_bias: Any
    color_output: Any
    color_output_bias: Any


class Upstream(NamedTuple):
    """Gradients that arrive: of rgb [R, 3] and of the weights [R, S]."""

    rgb: Any
    weights: Any


class Gradients(NamedTuple):
    """Gradients that leave, apart from `Sums`.

    features [N, L * F, TILE]; codes [R, A]; origins, directions [R, 3], or [0, 3] where nobody
    wants them.
    """

    features: Any
    codes: Any
    origins: Any
    directions: Any


class Flow(NamedTuple):
    """Scratch of a share: gradients between the layers, and of a block's densities and colours.

    points [3, TILE]. density [samples of a block], colors [.., 3]: of the colour logits. passing
    [S or more]: what of a ray's light passes each interval and all before it.
    """

    layers: LayerRows
    points: Any
    density: Any
    colors: Any
    passing: Any


@merged
def _make_flow(net, num_samples):
    return Flow(
        make_layer_rows(net),
        np.zeros((3, TILE), np.float32),
        np.zeros(BLOCK_RAYS * num_samples, np.float32),
        np.zeros((BLOCK_RAYS * num_samples, 3), np.float32),
        np.zeros(whole_lanes(num_samples), np.float32),
    )


@merged
def _part_of(sums, part):
    return Sums(
        sums.density_hidden[part],
        sums.density_hidden_bias[part],
        sums.density_output[part],
        sums.density_output_bias[part],
        sums.from_ray[part],
        sums.from_ray_bias[part],
        sums.from_outputs[part],
        sums.color_hidden[part],
        sums.color_hidden_bias[part],
        sums.color_output[part],
        sums.color_output_bias[part],
    )


@compiled
def _gate(gradient, activation, count):
    """Backward of ReLU: nothing passes where the activation is 0."""
    for row in range(gradient.shape[0]):
        for c in range(count):
            gradient[row, c] = ZERO if activation[row, c] <= ZERO else gradient[row, c]


@compiled
def _add_rows(gradient, count, sums):
    """sums[row] += sum over the first `count` columns."""
    for row in range(sums.size):
        total = ZERO
        for c in range(count):
            total += gradient[row, c]
        sums[row] += total


@merged
def _ray_backward(rays, settings, kept, upstream, weights, ray, flow, start):
    """From one ray's colour and weights to its densities and colour logits.

    With x_i = sigma_i d_i, transmittance T_i and G_i = dL/dw_i in all:
    dL/dx_i = G_i T_i exp(-x_i) - sum_{j > i} G_j w_j.
    Fills flow.density and flow.colors from `start` on.
    """
    num_samples = weights.shape[1]
    sample_0 = ray * num_samples
    edges = rays.t_edges[ray]
    red, green, blue = upstream.rgb[ray, 0], upstream.rgb[ray, 1], upstream.rgb[ray, 2]
    behind = rays.background[ray]
    if settings.last_sample:
        behind = kept.colors[sample_0 + num_samples - 1]
    base = red * behind[0] + green * behind[1] + blue * behind[2]
    passed, total = 0.0, 0.0
    for i in range(num_samples):
        passed += kept.density[ray, i] * (edges[i + 1] - edges[i])
        flow.passing[i] = -np.float32(passed)
        total += weights[ray, i]
    exp_all(flow.passing, num_samples, flow.passing)
    after = 0.0
    for i in range(num_samples - 1, -1, -1):
        color, weight = kept.colors[sample_0 + i], weights[ray, i]
        shown = weight
        if settings.last_sample and i == num_samples - 1:
            shown += ONE - np.float32(total)
        grads = flow.colors[start + i]
        grads[0] = shown * red * color[0] * (ONE - color[0])
        grads[1] = shown * green * color[1] * (ONE - color[1])
        grads[2] = shown * blue * color[2] * (ONE - color[2])
        width = edges[i + 1] - edges[i]
        lit = red * color[0] + green * color[1] + blue * color[2] - base
        lit += upstream.weights[ray, i]
        flow.density[start + i] = (lit * flow.passing[i] - np.float32(after)) * width
        after += lit * weight


@merged
def _load_tile(settings, kept, flow, number, first, done, count):
    """Gradients of the colour logits and of the density logit of a tile, 0 behind `count`."""
    stop = whole_lanes(count)
    low, high = settings.density_scale * LEAST_SLOPE, settings.density_scale * MOST_SLOPE
    density = kept.density.reshape(-1)
    for c in range(count):
        for channel in range(3):
            flow.layers.logits[channel, c] = flow.colors[done + c, channel]
        inside = kept.points[number, INSIDE, c] > ZERO
        # exp of the clamped logit is the density within bounds: both increase together.
        slope = min(max(density[first + c], low), high)
        flow.density[done + c] *= slope if inside else ZERO
    for c in range(count, stop):
        for channel in range(3):
            flow.layers.logits[channel, c] = ZERO


@merged
def _layers_backward(back, features, layers, flow, sums, done, count, num_samples, grad_features):
    """From the logits of a tile to its features; adds to `sums` and the rays' shares."""
    grads = flow.layers
    stop = whole_lanes(count)
    add_products(grads.logits, layers.second, count, sums.color_output)
    _add_rows(grads.logits, count, sums.color_output_bias)
    apply_layer(grads.logits, back.color_output, count, False, False, grads.second)
    _gate(grads.second, layers.second, stop)
    add_products(grads.second, layers.first, count, sums.color_hidden)
    _add_rows(grads.second, count, sums.color_hidden_bias)
    apply_layer(grads.second, back.color_hidden, count, False, False, grads.first)
    _gate(grads.first, layers.first, stop)
    add_products(grads.first, layers.outputs, count, sums.from_outputs)
    column = 0
    while column < count:
        ray = (done + column) // num_samples
        end = min((ray + 1) * num_samples - done, count)
        for row in range(grads.first.shape[0]):
            total = ZERO
            for c in range(column, end):
                total += grads.first[row, c]
            grads.per_ray[row, ray] += total
        column = end
    apply_layer(grads.first, back.from_outputs, count, False, False, grads.outputs)
    # The colour network does not see the logit: row 0 holds zeros up to here.
    for c in range(count):
        grads.outputs[0, c] = flow.density[done + c]
    add_products(grads.outputs, layers.density_hidden, count, sums.density_output)
    _add_rows(grads.outputs, count, sums.density_output_bias)
    apply_layer(grads.outputs, back.density_output, count, False, False, grads.density_hidden)
    _gate(grads.density_hidden, layers.density_hidden, stop)
    add_products(grads.density_hidden, features, count, sums.density_hidden)
    _add_rows(grads.density_hidden, count, sums.density_hidden_bias)
    apply_layer(grads.density_hidden, back.density_hidden, count, False, False, grad_features)


@merged
def _rays_backward(rays, back, layers, flow, sums, gradients, begin, end):
    """From the rays' share of the first colour layer to codes and directions."""
    grads = flow.layers
    count = end - begin
    add_products(grads.per_ray, layers.ray_inputs, count, sums.from_ray)
    _add_rows(grads.per_ray, count, sums.from_ray_bias)
    apply_layer(grads.per_ray, back.from_ray, count, False, False, grads.ray_inputs)
    for ray in range(begin, end):
        for a in range(gradients.codes.shape[1]):
            gradients.codes[ray, a] = grads.ray_inputs[NUM_SPHERICAL_HARMONICS + a, ray - begin]
    if len(gradients.directions) > 0:
        for ray in range(begin, end):
            harmonics_backward(
                rays.directions[ray],
                grads.ray_inputs[:, ray - begin],
                gradients.directions[ray],
            )


@compiled
def _add_scaled_row(slopes, gradient, count, out):
    """out += slopes * gradient, [TILE] each."""
    for c in range(count):
        out[c] += slopes[c] * gradient[c]


@merged
def _points_backward(settings, rays, kept, gradients, flow, number, first, count):
    """From a tile's features to the rays that its points lie on."""
    num_samples = rays.t_edges.shape[1] - 1
    slopes, features = kept.slopes[number], gradients.features[number]
    flow.points[:] = ZERO
    for row in range(len(slopes)):
        _add_scaled_row(slopes[row], features[row // 3], count, flow.points[row % 3])
    for axis in range(3):
        for c in range(count):
            # What lies outside was moved to the nearest face and does not follow its point.
            inside = ZERO <= kept.points[number, axis, c] <= ONE
            flow.points[axis, c] = flow.points[axis, c] if inside else ZERO
    for c in range(count):
        ray, sample = divmod(first + c, num_samples)
        place_backward(
            rays.origins[ray],
            rays.directions[ray],
            HALF * (rays.t_edges[ray, sample] + rays.t_edges[ray, sample + 1]),
            settings.contraction,
            flow.points[:, c],
            gradients.origins[ray],
            gradients.directions[ray],
        )


@compiled
def backward_blocks(
    share, shares, net, back, settings, rays, kept, weights, upstream, all_sums, gradients
):
    """Fill `gradients` and, per part, `all_sums`; all of them start as zeros."""
    num_rays, num_samples = weights.shape
    tiles = tiles_of_block(num_samples)
    layers, flow = make_layer_rows(net), _make_flow(net, num_samples)
    for part in range(share, PARTS, shares):
        sums = _part_of(all_sums, part)
        for block in range(part, (num_rays + BLOCK_RAYS - 1) // BLOCK_RAYS, PARTS):
            first_ray = block * BLOCK_RAYS
            end_ray = min(first_ray + BLOCK_RAYS, num_rays)
            total = (end_ray - first_ray) * num_samples
            ray_shares(net, rays, first_ray, end_ray, layers)
            flow.layers.per_ray[:] = ZERO
            for ray in range(first_ray, end_ray):
                start = (ray - first_ray) * num_samples
                _ray_backward(rays, settings, kept, upstream, weights, ray, flow, start)
            for tile in range((total + TILE - 1) // TILE):
                number, done = block * tiles + tile, tile * TILE
                count, features = min(TILE, total - done), kept.features[number]
                hidden_layers(net, features, done, count, num_samples, layers)
                first = first_ray * num_samples + done
                _load_tile(settings, kept, flow, number, first, done, count)
                _layers_backward(
                    back,
                    features,
                    layers,
                    flow,
                    sums,
                    done,
                    count,
                    num_samples,
                    gradients.features[number],
                )
                if len(gradients.origins) > 0:
                    _points_backward(settings, rays, kept, gradients, flow, number, first, count)
            _rays_backward(rays, back, layers, flow, sums, gradients, first_ray, end_ray)
