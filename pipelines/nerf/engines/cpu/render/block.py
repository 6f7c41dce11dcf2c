"""The rendering kernel: what a block of rays shows, from uniform samples to colours.

Symbols: B rays of a block, S samples of a round, TILE samples that pass the layers together. The
networks of all rounds go through the same code, the field's last. Each thread works on one block
at a time and keeps all that lies between ray and colour in a few hundred kilobytes of scratch. A
ray's values do not depend on what else is in its block. Launching is left to `render_rays`.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from pipelines.nerf.along_ray.intervals import HISTOGRAM_PADDING
from pipelines.nerf.engines.cpu.parts.color_net import ColorNet, color_logits, direction_harmonics
from pipelines.nerf.engines.cpu.parts.dense_layers import LANES, TILE, apply_layer
from pipelines.nerf.engines.cpu.parts.density_net import DensityNet, density_logits
from pipelines.nerf.engines.cpu.parts.intervals import (
    INSIDE,
    depths,
    find_weights,
    place_ray,
    resample,
    spread_edges,
)
from pipelines.nerf.engines.cpu.parts.lanes import exp_all
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged
from pipelines.nerf.engines.cpu.render.baked_grid import look_up

BLOCK_RAYS = 16
WAVE = TILE // BLOCK_RAYS
"""Samples of a ray that are looked at before it is asked whether the ray has met enough."""
LAST_SAMPLE, WHITE = 0, 2
BACKGROUNDS = {"last_sample": LAST_SAMPLE, "black": 1, "random": 1, "white": WHITE}
ZERO, ONE = np.float32(0.0), np.float32(1.0)
LEAST_WEIGHT = np.float32(1e-30)
"""Less is nothing: the mean of what weighs so little would be 0 times infinity."""
MIDDLE = np.full(1, 0.5, np.float32)
"""Where in their equal shares the draws lie."""


class Settings(NamedTuple):
    """Numbers that steer the kernel. Spacing ends are `spacing_piecewise` of near and far."""

    num_samples: Any  # [rounds + 1] int64, the field's samples last
    s_near: Any
    s_far: Any
    density_scale: Any
    contraction: Any
    background: Any
    skip_below: Any
    early_stop: Any
    color_weight: Any


class PackedModel(NamedTuple):
    """All that the kernel reads. networks: one per round of samples."""

    networks: tuple[DensityNet, ...]  # the field's last
    grid: Any  # logits for the first round as `render_grid.bake_logits`, or NO_GRID
    color: ColorNet
    settings: Settings


class Scratch(NamedTuple):
    """What one thread needs; [.., TILE] are columns of samples, [B, S + 1] are rows of rays."""

    columns: Any  # [3, TILE] unit points
    column_ray: Any
    column_sample: Any
    column_weight: Any
    features: Any
    hidden: Any
    second: Any
    outputs: Any
    harmonics: Any
    per_ray: Any
    points: Any  # [B, 4, S] as `place_ray`
    density: Any
    masses: Any  # weight in each interval by the round before
    geometry: Any
    weights: Any
    mixed: Any  # geometry of samples that share a colour
    rows: Any  # [2, S], of `find_weights`
    s_edges: Any
    new_edges: Any
    t_edges: Any
    cursor: Any  # the next sample of each ray
    passed: Any  # optical depth before it
    total: Any  # the sum of its weights
    ends: Any  # whether the last sample was looked at


@merged
def _make_scratch(model):
    rows, features = model.color.output.bias.size, model.color.from_geometry.weights.shape[1]
    width = max(model.color.hidden.bias.size, model.color.from_direction.bias.size)
    for net in model.networks:
        rows = max(rows, net.output.bias.size)
        features = max(features, len(net.grid.resolutions) * net.grid.table.shape[1])
        width = max(width, net.hidden.bias.size)
    num_samples = model.settings.num_samples
    most, last = num_samples[0], num_samples[-1]
    for count in num_samples:
        most = max(most, count)
    room = (most + LANES) // LANES * LANES  # for the edges as well
    geometry = model.color.from_geometry.weights.shape[1]
    kind = np.float32
    return Scratch(
        np.zeros((3, TILE), kind),
        np.zeros(TILE, np.int64),
        np.zeros(TILE, np.int64),
        np.zeros(TILE, kind),
        np.zeros((features, TILE), kind),
        np.zeros((width, TILE), kind),
        np.zeros((width, TILE), kind),
        np.zeros((rows, TILE), kind),
        np.zeros((16, TILE), kind),
        np.zeros((width, TILE), kind),
        np.zeros((BLOCK_RAYS, 4, room), kind),
        np.zeros((BLOCK_RAYS, room), kind),
        np.zeros((BLOCK_RAYS, room), kind),
        np.zeros((BLOCK_RAYS, last, geometry), kind),
        np.zeros((BLOCK_RAYS, room), kind),
        np.zeros(geometry, kind),
        np.zeros((2, room), kind),
        np.zeros((BLOCK_RAYS, room), kind),
        np.zeros((BLOCK_RAYS, room), kind),
        np.zeros((BLOCK_RAYS, room), kind),
        np.zeros(BLOCK_RAYS, np.int64),
        np.zeros(BLOCK_RAYS, np.float64),
        np.zeros(BLOCK_RAYS, np.float64),
        np.zeros(BLOCK_RAYS, np.bool_),
    )


@merged
def _ask(net, settings, scratch, num_rays, count, early_stop, num_geometry):
    """Density, and geometry where wanted, of samples front to back until rays have met enough.

    Samples whose interval held too little in the round before are left at 0.
    """
    # A ray is given up once its optical depth passes this; never where early_stop is 0.
    limit = -math.log(early_stop) if early_stop > 0.0 else math.inf
    least = np.float32(settings.skip_below if settings.skip_below > 0.0 else -1.0)
    scratch.passed[:] = 0.0
    scratch.cursor[:] = 0
    scratch.ends[:] = False
    scratch.density[:, :count] = ZERO
    points = scratch.points
    while True:
        column = 0
        for ray in range(num_rays):
            if scratch.passed[ray] <= limit:
                sample, end = scratch.cursor[ray], column + WAVE
                while sample < count and column < end:
                    if scratch.masses[ray, sample] > least:
                        for axis in range(3):
                            scratch.columns[axis, column] = points[ray, axis, sample]
                        scratch.column_ray[column] = ray
                        scratch.column_sample[column] = sample
                        column += 1
                    sample += 1
                scratch.cursor[ray] = sample
        if column == 0:
            break
        density_logits(
            net, scratch.columns, column, scratch.features, scratch.hidden, scratch.outputs
        )
        exp_all(scratch.outputs[0], column, scratch.hidden[0])
        for c in range(column):
            ray, sample = scratch.column_ray[c], scratch.column_sample[c]
            edges = scratch.t_edges[ray]
            density = settings.density_scale * scratch.hidden[0, c]
            density = density if points[ray, INSIDE, sample] > ZERO else ZERO
            scratch.density[ray, sample] = density
            scratch.passed[ray] += density * (edges[sample + 1] - edges[sample])
            for g in range(num_geometry):
                scratch.geometry[ray, sample, g] = scratch.outputs[1 + g, c]
            if sample == count - 1:
                scratch.ends[ray] = True


@merged
def _fill_colors(model, scratch, count, rgb):
    """Add the weighted colours of the first `count` columns, ray after ray, to their rays."""
    first = scratch.hidden
    begin = 0
    while begin < count:
        ray = scratch.column_ray[begin]
        end = begin + 1
        while end < count and scratch.column_ray[end] == ray:
            end += 1
        for row in range(model.color.from_geometry.bias.size):
            value = scratch.per_ray[row, ray]
            for c in range(begin, end):
                first[row, c] = value
        begin = end
    color_logits(model.color, scratch.features, count, first, scratch.second, scratch.outputs)
    for channel in range(3):
        for c in range(count):
            scratch.outputs[channel, c] = -scratch.outputs[channel, c]
        exp_all(scratch.outputs[channel], count, scratch.outputs[channel])
    for c in range(count):
        ray = scratch.column_ray[c]
        weight = scratch.column_weight[c]
        for channel in range(3):
            rgb[ray, channel] += weight / (ONE + scratch.outputs[channel, c])


@merged
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
    mixed = scratch.mixed
    for ray in range(num_rays):
        total = scratch.total[ray]
        accumulation[ray] = total
        median[ray], expected[ray] = depths(weights[ray], scratch.t_edges[ray], count)
        missing = np.float32(1.0 - np.float32(total))
        rgb[ray, :] = ZERO
        scale = ONE
        if settings.background == LAST_SAMPLE:
            # What passes all samples takes the colour of the last one. Where nobody looked at that
            # one, so little passes that the others stand for it.
            if scratch.ends[ray]:
                weights[ray, count - 1] += missing
            elif total > 0.0:
                scale = np.float32((total + missing) / total)
        together = ZERO
        for sample in range(count):
            weight = weights[ray, sample]
            if weight > LEAST_WEIGHT:
                for g in range(num_geometry):
                    value = weight * scratch.geometry[ray, sample, g]
                    mixed[g] = mixed[g] + value if together > ZERO else value
                together += weight
            at_end = sample == count - 1
            at_end_of_all = at_end and ray == num_rays - 1
            left_over = at_end and together > ZERO
            if together > settings.color_weight or left_over or at_end_of_all:
                share = ONE / together if together > ZERO else ZERO
                for g in range(num_geometry):
                    scratch.features[g, column] = share * mixed[g]
                scratch.column_ray[column] = ray
                scratch.column_weight[column] = scale * together
                together = ZERO
                column += 1
                if column == TILE or at_end_of_all:
                    _fill_colors(model, scratch, column, rgb)
                    column = 0
    if settings.background == WHITE:
        for ray in range(num_rays):
            for channel in range(3):
                rgb[ray, channel] += ONE - accumulation[ray]


@merged
def _next_edges(settings, scratch, num_rays, count, num_new, to_field):
    """From the weights of a round to the intervals of the next one and what they should hold."""
    for ray in range(num_rays):
        edges, new_edges = scratch.s_edges[ray], scratch.new_edges[ray]
        weights, masses, total = scratch.weights[ray], scratch.masses[ray], scratch.total[ray]
        resample(
            edges, weights, total, count, num_new, MIDDLE, HISTOGRAM_PADDING, new_edges, masses
        )
        for i in range(num_new + 1):
            edges[i] = new_edges[i]
        spread_edges(edges, num_new, settings.s_near, settings.s_far, scratch.t_edges[ray])
        if to_field and settings.background == LAST_SAMPLE:
            masses[num_new - 1] += np.float32(1.0 - total)  # the last sample stands for the rest


@merged
def _place_block(settings, scratch, origins, directions, count):
    for ray in range(len(origins)):
        place_ray(
            origins[ray],
            directions[ray],
            scratch.t_edges[ray],
            count,
            settings.contraction,
            0,
            scratch.points[ray],
        )


@merged
def _render_block(model, scratch, origins, directions, rgb, accumulation, median, expected):
    settings = model.settings
    num_samples, num_rays = settings.num_samples, len(origins)
    first = num_samples[0]
    for ray in range(num_rays):
        edges = scratch.s_edges[ray]
        for i in range(first + 1):
            edges[i] = np.float32(i / first)
        spread_edges(edges, first, settings.s_near, settings.s_far, scratch.t_edges[ray])
    scratch.masses[:] = ONE  # nothing is known of the first intervals
    num_rounds = len(model.networks)
    for index in range(num_rounds):
        count = num_samples[index]
        _place_block(settings, scratch, origins, directions, count)
        if index == 0 and model.grid.size > 0:
            for ray in range(num_rays):
                points, density = scratch.points[ray], scratch.density[ray]
                look_up(model.grid, points, count, density)
                exp_all(density, count, density)
                for i in range(count):
                    density[i] *= points[INSIDE, i] * settings.density_scale
        else:
            early_stop, num_geometry = 0.0, 0
            if index == num_rounds - 1:
                early_stop, num_geometry = settings.early_stop, scratch.geometry.shape[2]
            _ask(
                model.networks[index], settings, scratch, num_rays, count, early_stop, num_geometry
            )
        for ray in range(num_rays):
            scratch.total[ray] = find_weights(
                scratch.density[ray],
                scratch.t_edges[ray],
                count,
                scratch.rows,
                scratch.weights[ray],
            )
        if index < num_rounds - 1:
            to_field = index == num_rounds - 2
            _next_edges(settings, scratch, num_rays, count, num_samples[index + 1], to_field)
    count = num_samples[-1]
    _shade(model, scratch, directions, count, rgb, accumulation, median, expected)


@compiled
def render_blocks(share, shares, model, origins, directions, rgb, accumulation, median, expected):
    """One share: blocks that follow each other, since they read the same parts of the tables."""
    num_rays = len(origins)
    scratch = _make_scratch(model)
    num_blocks = (num_rays + BLOCK_RAYS - 1) // BLOCK_RAYS
    for block in range(num_blocks * share // shares, num_blocks * (share + 1) // shares):
        begin = block * BLOCK_RAYS
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
