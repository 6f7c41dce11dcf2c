"""Nerfacto's whole forward pass for rendering, fused per block of rays: twin of `Nerfacto` in eval.

Symbols: R rays, S samples, B rays of a block, TILE samples that pass the layers together. Each
thread takes every n-th block and keeps all that lies between ray and colour in a few hundred
kilobytes of scratch. With both thresholds 0 the values are those of the plain model to rounding;
above 0, work that can hardly be seen is left out:

- `early_stop`: samples behind a transmittance below it are not looked at;
- `weight_threshold`: samples of at most this weight get no colour of their own; the colours of the
  others are scaled up to stand for them.

Each colour channel then changes by at most early_stop + S * weight_threshold, since all colours
lie in [0, 1] and that much weight is given to other samples of the same ray.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from pipelines.nerf.intervals import HISTOGRAM_PADDING, spacing_piecewise
from pipelines.nerf.kernels.dense_layers import TILE, apply_layer
from pipelines.nerf.kernels.field import ColorNet, color_logits, direction_harmonics, pack_color
from pipelines.nerf.kernels.intervals import (
    CONTRACTION_CODES,
    depths,
    find_weights,
    place,
    resample,
    spread_edges,
)
from pipelines.nerf.kernels.proposal import DensityNet, density_logits, pack_density
from pipelines.nerf.kernels.runtime import compiled, run_threads
from pipelines.nerf.models.base import Appearance, Model
from pipelines.nerf.models.nerfacto import Nerfacto

BLOCK_RAYS = 16
WAVE = TILE // BLOCK_RAYS
BACKGROUNDS = {"last_sample": 0, "black": 1, "random": 1, "white": 2}
LAST_SAMPLE, WHITE = 0, 2

FloatArray = NDArray[np.float32]


class Settings(NamedTuple):
    """Numbers that steer the kernel. Spacing ends are `spacing_piecewise` of near and far."""

    num_samples: Any  # [rounds + 1] int64, the field's samples last
    s_near: Any
    s_far: Any
    density_scale: Any
    contraction: Any
    background: Any
    early_stop: Any
    weight_threshold: Any


class PackedModel(NamedTuple):
    """All that the kernel reads: one network per proposal round, the field, the settings."""

    proposals: tuple[DensityNet, ...]
    density: DensityNet
    color: ColorNet
    settings: Settings


class Scratch(NamedTuple):
    """What one thread needs; [.., TILE] are columns of samples, [B, S + 1] are rows of rays."""

    points: Any
    features: Any
    hidden: Any
    second: Any
    outputs: Any
    harmonics: Any
    per_ray: Any
    density: Any
    geometry: Any
    weights: Any
    s_edges: Any
    new_edges: Any
    t_edges: Any
    column_ray: Any
    column_sample: Any
    column_inside: Any
    passed: Any


@compiled
def _make_scratch(model):
    rows = max(model.color.output.bias.size, model.density.output.bias.size)
    features = len(model.density.resolutions) * model.density.table.shape[1]
    width = max(model.density.hidden.bias.size, model.color.hidden.bias.size)
    width = max(width, model.color.from_direction.bias.size)
    for net in model.proposals:
        rows = max(rows, net.output.bias.size)
        features = max(features, len(net.resolutions) * net.table.shape[1])
        width = max(width, net.hidden.bias.size)
    num_samples = model.settings.num_samples
    most, last = num_samples.max(), num_samples[-1]
    geometry = model.color.from_geometry.weights.shape[1]
    features = max(features, geometry)
    kind = np.float32
    return Scratch(
        np.zeros((TILE, 3), kind),
        np.zeros((features, TILE), kind),
        np.zeros((width, TILE), kind),
        np.zeros((width, TILE), kind),
        np.zeros((rows, TILE), kind),
        np.zeros((16, TILE), kind),
        np.zeros((width, TILE), kind),
        np.zeros((BLOCK_RAYS, most), kind),
        np.zeros((BLOCK_RAYS, last, geometry), kind),
        np.zeros((BLOCK_RAYS, most), kind),
        np.zeros((BLOCK_RAYS, most + 1), kind),
        np.zeros((BLOCK_RAYS, most + 1), kind),
        np.zeros((BLOCK_RAYS, most + 1), kind),
        np.zeros(TILE, np.int64),
        np.zeros(TILE, np.int64),
        np.zeros(TILE, np.bool_),
        np.zeros(BLOCK_RAYS, np.float64),
    )


@compiled
def _add_column(scratch, column, ray, sample, origins, directions, contraction):
    """Let a column of the tile stand for a sample of a ray."""
    edges = scratch.t_edges
    t = np.float32(0.5) * (edges[ray, sample] + edges[ray, sample + 1])
    scratch.column_ray[column] = ray
    scratch.column_sample[column] = sample
    scratch.column_inside[column] = place(
        origins[ray], directions[ray], t, contraction, scratch.points[column]
    )


@compiled
def _fill_density(net, settings, scratch, count):
    """Densities of the samples in the first `count` columns."""
    density_logits(net, scratch.points, count, scratch.features, scratch.hidden, scratch.outputs)
    for column in range(count):
        density = np.float32(0.0)
        if scratch.column_inside[column]:
            density = settings.density_scale * np.float32(math.exp(scratch.outputs[0, column]))
        scratch.density[scratch.column_ray[column], scratch.column_sample[column]] = density


@compiled
def _propose(net, settings, scratch, origins, directions, count, num_new):
    """One proposal round of a block of rays: s_edges and t_edges become those of the next round."""
    num_rays = len(origins)
    column = 0
    for ray in range(num_rays):
        for sample in range(count):
            _add_column(scratch, column, ray, sample, origins, directions, settings.contraction)
            column += 1
            if column == TILE or (ray == num_rays - 1 and sample == count - 1):
                _fill_density(net, settings, scratch, column)
                column = 0
    for ray in range(num_rays):
        weights, edges = scratch.weights[ray], scratch.s_edges[ray]
        new_edges = scratch.new_edges[ray]
        total = find_weights(scratch.density[ray], scratch.t_edges[ray], count, weights)
        resample(edges, weights, total, count, num_new, HISTOGRAM_PADDING, new_edges)
        edges[: num_new + 1] = new_edges[: num_new + 1]
        spread_edges(edges, num_new, settings.s_near, settings.s_far, scratch.t_edges[ray])


@compiled
def _find_density(model, scratch, origins, directions, count):
    """Density and geometry of the field, front to back, until each ray has met enough."""
    settings = model.settings
    num_geometry = scratch.geometry.shape[2]
    # A ray is given up once its optical depth passes this; never where early_stop is 0.
    limit = -math.log(settings.early_stop) if settings.early_stop > 0.0 else math.inf
    scratch.passed[:] = 0.0
    scratch.density[:, :count] = 0.0
    for begin in range(0, count, WAVE):
        end = min(begin + WAVE, count)
        column = 0
        for ray in range(len(origins)):
            if scratch.passed[ray] <= limit:
                for sample in range(begin, end):
                    _add_column(
                        scratch, column, ray, sample, origins, directions, settings.contraction
                    )
                    column += 1
        if column == 0:
            break
        _fill_density(model.density, settings, scratch, column)
        for c in range(column):
            ray, sample = scratch.column_ray[c], scratch.column_sample[c]
            edges = scratch.t_edges[ray]
            thickness = scratch.density[ray, sample] * (edges[sample + 1] - edges[sample])
            scratch.passed[ray] += thickness
            for g in range(num_geometry):
                scratch.geometry[ray, sample, g] = scratch.outputs[1 + g, c]


@compiled
def _fill_colors(model, scratch, count, rgb, weights):
    """Add the weighted colours of the first `count` columns to their rays."""
    width = model.color.from_geometry.bias.size
    for row in range(width):
        for c in range(count):
            scratch.hidden[row, c] = scratch.per_ray[row, scratch.column_ray[c]]
    color_logits(
        model.color, scratch.features, count, scratch.hidden, scratch.second, scratch.outputs
    )
    one = np.float32(1.0)
    for c in range(count):
        ray = scratch.column_ray[c]
        weight = weights[ray, scratch.column_sample[c]]
        for channel in range(3):
            color = one / (one + np.float32(math.exp(-scratch.outputs[channel, c])))
            rgb[ray, channel] += weight * color


@compiled
def _shade(model, scratch, directions, count, rgb, accumulation, median, expected):
    """Colour, accumulation and depth of a block whose densities are known."""
    settings = model.settings
    num_rays, num_geometry = len(directions), scratch.geometry.shape[2]
    weights = scratch.weights
    for ray in range(num_rays):
        direction_harmonics(directions[ray], scratch.harmonics, ray)
    apply_layer(
        scratch.harmonics, model.color.from_direction, num_rays, False, False, scratch.per_ray
    )
    column = 0
    for ray in range(num_rays):
        total = find_weights(scratch.density[ray], scratch.t_edges[ray], count, weights[ray])
        accumulation[ray] = total
        median[ray], expected[ray] = depths(weights[ray], scratch.t_edges[ray], count)
        missing = np.float32(1.0 - np.float32(total))
        rgb[ray, :] = np.float32(0.0)
        if settings.background == LAST_SAMPLE:
            # What passes all samples takes the colour of the last one. Behind an early stop that
            # one is unknown, but then so little passes that the others stand for it.
            total += missing
            if missing > settings.early_stop or settings.early_stop == 0.0:
                weights[ray, count - 1] += missing
        kept = 0.0
        for sample in range(count):
            if weights[ray, sample] > settings.weight_threshold:
                kept += weights[ray, sample]
        scale = np.float32(total / kept) if kept > 0.0 else np.float32(0.0)
        for sample in range(count):
            if weights[ray, sample] > settings.weight_threshold:
                weights[ray, sample] *= scale
                scratch.column_ray[column] = ray
                scratch.column_sample[column] = sample
                for g in range(num_geometry):
                    scratch.features[g, column] = scratch.geometry[ray, sample, g]
                column += 1
                if column == TILE:
                    _fill_colors(model, scratch, column, rgb, weights)
                    column = 0
    if column > 0:
        _fill_colors(model, scratch, column, rgb, weights)
    if settings.background == WHITE:
        for ray in range(num_rays):
            for channel in range(3):
                rgb[ray, channel] += np.float32(1.0) - accumulation[ray]


@compiled
def _render_block(model, scratch, origins, directions, rgb, accumulation, median, expected):
    settings = model.settings
    num_samples = settings.num_samples
    first = num_samples[0]
    for ray in range(len(origins)):
        edges = scratch.s_edges[ray]
        for i in range(first + 1):
            edges[i] = np.float32(i / first)
        spread_edges(edges, first, settings.s_near, settings.s_far, scratch.t_edges[ray])
    for round_index in range(len(model.proposals)):
        _propose(
            model.proposals[round_index],
            settings,
            scratch,
            origins,
            directions,
            num_samples[round_index],
            num_samples[round_index + 1],
        )
    count = num_samples[-1]
    _find_density(model, scratch, origins, directions, count)
    _shade(model, scratch, directions, count, rgb, accumulation, median, expected)


@compiled
def _render(share, shares, model, origins, directions, rgb, accumulation, median, expected):
    """One share: every n-th block, since neighbouring blocks cost about the same."""
    num_rays = len(origins)
    scratch = _make_scratch(model)
    for begin in range(share * BLOCK_RAYS, num_rays, shares * BLOCK_RAYS):
        end = min(begin + BLOCK_RAYS, num_rays)
        _render_block(
            model,
            scratch,
            origins[begin:end],
            directions[begin:end],
            rgb[begin:end],
            accumulation[begin:end],
            median[begin:end],
            expected[begin:end],
        )


def supports(model: Model) -> bool:
    """Whether the kernel knows the method and the parts it is made of."""
    if not isinstance(model, Nerfacto):
        return False
    config = model.config
    return (
        config.position_encoding == "hash"
        and config.direction_encoding == "spherical_harmonics"
        and config.spacing == "piecewise"
        and config.contraction in CONTRACTION_CODES
    )


def pack_model(
    model: Model,
    *,
    appearance: Appearance = None,
    early_stop: float = 0.0,
    weight_threshold: float = 0.0,
) -> PackedModel:
    """The model as arrays. Tables are shared with a float32 model on the CPU, layers are copied.

    appearance: a code [A], whose training image's code to use, or None for the mean code.
    Raises ValueError for a model that the kernel does not know (`supports`).
    """
    if not (isinstance(model, Nerfacto) and supports(model)):
        raise ValueError(f"the kernel does not render this {type(model).__name__}")
    config, field = model.config, model.field
    with torch.no_grad():
        code = field.mean_code()
        if isinstance(appearance, Tensor):
            code = None if code is None else appearance
        elif appearance is not None and field.appearance is not None:
            code = field.appearance.weight[appearance]
    ends = spacing_piecewise(torch.tensor([config.near, config.far], dtype=torch.float64))
    s_near, s_far = ends.tolist()
    return PackedModel(
        tuple(pack_density(net.grid, net.mlp.layers) for net in model.round_networks()),  # type: ignore[union-attr,arg-type]
        pack_density(field.grid, field.density_mlp.layers),
        pack_color(field.color_mlp.layers, config.geo_feature_dim, code),
        Settings(
            np.array([*config.num_proposal_samples, config.num_nerf_samples], np.int64),
            np.float32(s_near),
            np.float32(s_far),
            np.float32(config.average_init_density),
            CONTRACTION_CODES[config.contraction],
            BACKGROUNDS[config.background],
            float(early_stop),
            float(weight_threshold),
        ),
    )


def render_rays(
    model: PackedModel, origins: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
    """What rays show.

    origins, directions: [R, 3] float32, scene space, unit directions.
    Returns rgb [R, 3] in [0, 1], accumulation [R], median and expected depth [R] along the ray in
    scene units.
    """
    num_rays = len(origins)
    rgb = np.zeros((num_rays, 3), np.float32)
    accumulation, median, expected = (np.zeros(num_rays, np.float32) for _ in range(3))
    run_threads(
        _render,
        model,
        np.ascontiguousarray(origins, np.float32),
        np.ascontiguousarray(directions, np.float32),
        rgb,
        accumulation,
        median,
        expected,
    )
    return rgb, accumulation, median, expected
