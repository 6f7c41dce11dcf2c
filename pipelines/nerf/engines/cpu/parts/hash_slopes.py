"""The hash grid with its slopes, 16 samples at once, for two features per entry.

A slope is the derivative of a feature along an axis of the unit cube: what the gradient towards the
points is made of. Twin of `encodings.hash_encode` with that gradient; symbols as in `hash_lanes`.
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

from pipelines.nerf.engines.cpu.parts.dense_layers import TILE
from pipelines.nerf.engines.cpu.parts.hash_lanes import (
    ENTRY_BYTES,
    NUM_FEATURES,
    corner_entries,
    gather_pairs,
    level_step,
    locate_cells,
)
from pipelines.nerf.engines.cpu.parts.lanes import INT32, LANES, Lanes
from pipelines.nerf.engines.cpu.parts.runtime import merged

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
def encode_slopes(grid, level, points, count, out, slopes):
    """Features [2, TILE] of one level at points [3 or more, TILE], and their slopes [6, TILE].

    The slopes along x, y and z of the first feature, then those of the second. All float32 and
    contiguous; up to 15 columns behind `count` are read and written as well.
    """
    resolution, step = grid.resolutions[level], level_step(grid, level)
    table_at = np.intp(grid.table.ctypes.data) + grid.offsets[level] * ENTRY_BYTES
    points_at = np.intp(points.ctypes.data)
    out_at, slopes_at = np.intp(out.ctypes.data), np.intp(slopes.ctypes.data)
    for at in range(0, count * 4, LANES * 4):
        if grid.dense[level]:
            _encode_dense(  # type: ignore[call-arg]  # numba passes the typing context
                points_at + at, table_at, resolution, step, out_at + at, slopes_at + at
            )
        else:
            _encode_hashed(  # type: ignore[call-arg]
                points_at + at, table_at, resolution, step, out_at + at, slopes_at + at
            )
