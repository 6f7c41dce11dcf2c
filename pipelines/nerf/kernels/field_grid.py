"""The field's hash grid for training: features with their slopes, and the way back to the table.

Symbols as in `field_forward`. All tiles go through one level before the next: neighbouring rays
share entries, and one level stays in the cache where all of them do not. A slope is the derivative
of a feature along an axis of the unit cube. It is taken while the corners are at hand, since to
fetch them again in the backward pass costs more than to keep three numbers per feature. Twin of
`encodings.hash_encode` and of its gradients, for two features per entry.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic

from pipelines.nerf.kernels.dense_layers import TILE
from pipelines.nerf.kernels.hash_lanes import (
    ENTRY_BYTES,
    NUM_FEATURES,
    PLACE_ROWS,
    corner_entries,
    encode_columns,
    gather_pairs,
    locate_cells,
    scatter_columns,
)
from pipelines.nerf.kernels.lanes import INT32, LANES, Lanes
from pipelines.nerf.kernels.runtime import compiled, merged

ROW_BYTES = TILE * 4


def _with_slopes(lanes: Lanes, corners: list[Any], fractions: list[Any]) -> list[Any]:
    """The trilinear value and its three slopes per cell; corners: 8 values, x fastest."""
    x, y, z = fractions

    def rises(values: list[Any]) -> list[Any]:
        pairs = zip(values[::2], values[1::2], strict=True)
        return [lanes.builder.fsub(high, low) for low, high in pairs]

    def between(low: Any, rise: Any, share: Any) -> Any:
        return lanes.add(lanes.mul(rise, share), low)

    rises_x = rises(corners)
    edges = [between(low, rise, x) for low, rise in zip(corners[::2], rises_x, strict=True)]
    rises_y = rises(edges)
    faces = [between(low, rise, y) for low, rise in zip(edges[::2], rises_y, strict=True)]
    (slope_z,) = rises(faces)
    along_x = [
        between(low, rise, y) for low, rise in zip(rises_x[::2], rises(rises_x), strict=True)
    ]
    slope_x = between(along_x[0], rises(along_x)[0], z)
    slope_y = between(rises_y[0], rises(rises_y)[0], z)
    return [between(faces[0], slope_z, z), slope_x, slope_y, slope_z]


def _generate_encode(dense: bool) -> Callable[..., Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        points, table, resolution, step, out, slopes = arguments
        lanes = Lanes(builder)
        cells_per_side = builder.trunc(resolution, INT32)
        row_bytes = ir.Constant(points.type, ROW_BYTES)
        cells, fractions = locate_cells(lanes, points, row_bytes, cells_per_side)
        entries = corner_entries(lanes, cells, builder.trunc(step, INT32), dense)
        corners = [gather_pairs(lanes, table, entry) for entry in entries]
        scale = lanes.splat(builder.sitofp(cells_per_side, ir.FloatType()))
        for feature in range(NUM_FEATURES):
            values = [corner[feature] for corner in corners]
            value, *per_cell = _with_slopes(lanes, values, fractions)
            lanes.store(value, lanes.at(out, feature * ROW_BYTES))
            for axis, slope in enumerate(per_cell):
                row = 3 * feature + axis
                lanes.store(lanes.mul(slope, scale), lanes.at(slopes, row * ROW_BYTES))
        return context.get_dummy_value()

    return generate


@intrinsic
def _encode_dense(typing_context, points, table, resolution, step, out, slopes):
    """Two features [2, .] and slopes [6, .] of 16 points on a dense level; integers, addresses."""
    return types.void(*[types.intp] * 6), _generate_encode(True)


@intrinsic
def _encode_hashed(typing_context, points, table, resolution, step, out, slopes):
    """Two features [2, .] and slopes [6, .] of 16 points on a hashed level; integers, addresses."""
    return types.void(*[types.intp] * 6), _generate_encode(False)


@merged
def _encode_tile(net, level, points, count, out, slopes):
    """Features [2, TILE] and slopes [6, TILE] of one level; 16 points at a time."""
    first, resolution = net.offsets[level], net.resolutions[level]
    table_at = np.intp(net.table.ctypes.data) + first * ENTRY_BYTES
    points_at = np.intp(points.ctypes.data)
    out_at, slopes_at = np.intp(out.ctypes.data), np.intp(slopes.ctypes.data)
    mask = net.offsets[level + 1] - first - 1
    for at in range(0, count * 4, LANES * 4):
        if net.dense[level]:
            _encode_dense(  # type: ignore[call-arg]  # numba passes the typing context
                points_at + at, table_at, resolution, resolution + 1, out_at + at, slopes_at + at
            )
        else:
            _encode_hashed(  # type: ignore[call-arg]
                points_at + at, table_at, resolution, mask, out_at + at, slopes_at + at
            )


@compiled
def encode_levels(share, shares, net, counts, points, features, slopes):
    """Features [N, L * 2, TILE] of points [N, 3, TILE], and their slopes [N, 3 * L * 2, TILE].

    counts: [N] samples of each tile; up to 15 columns behind them are read and written as well.
    slopes may be [N, 0, TILE]: then nobody wants them.
    """
    num_levels = len(net.resolutions)
    for turn in range(share, num_levels, shares):
        level = num_levels - 1 - turn  # finest first: they take longest
        row = NUM_FEATURES * level
        for tile in range(len(counts)):
            out = features[tile, row : row + NUM_FEATURES]
            if slopes.size > 0:
                along = slopes[tile, 3 * row : 3 * (row + NUM_FEATURES)]
                _encode_tile(net, level, points[tile], counts[tile], out, along)
            else:
                encode_columns(
                    points[tile],
                    0,
                    counts[tile],
                    net.table,
                    net.resolutions[level : level + 1],
                    net.dense[level : level + 1],
                    net.offsets[level : level + 2],
                    out,
                )


@compiled
def scatter_levels(share, shares, net, counts, points, grad_features, grad_table):
    """Add to grad_table [E, 2] what comes back for features [N, L * 2, TILE]; a level per turn."""
    places = np.zeros((PLACE_ROWS, TILE), np.float32)
    num_levels = len(net.resolutions)
    for turn in range(share, num_levels, shares):
        level = num_levels - 1 - turn
        row = NUM_FEATURES * level
        for tile in range(len(counts)):
            scatter_columns(
                points[tile],
                0,
                counts[tile],
                net.resolutions[level : level + 1],
                net.dense[level : level + 1],
                net.offsets[level : level + 2],
                grad_features[tile, row : row + NUM_FEATURES],
                places,
                grad_table,
            )
