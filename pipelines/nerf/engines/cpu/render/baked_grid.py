"""A density network's logits on a dense grid, and the way to read them: for the first round.

The first proposal round asks the same smooth function at hundreds of places per ray. Its finest
level has few cells, so a grid of as many vertices knows it almost as well, and one trilinear lookup
takes the place of five levels and two layers. Symbols: n vertices per side, in unit space; entry
x + n (y + n z).
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import zlib
from typing import Any

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.parts.dense_layers import TILE
from pipelines.nerf.engines.cpu.parts.density_net import DensityNet, density_logits
from pipelines.nerf.engines.cpu.parts.hash_lanes import locate_cells
from pipelines.nerf.engines.cpu.parts.lanes import FLOATS, INT32, INT64, LANES, Lanes
from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads

FloatArray = NDArray[np.float32]

ONE = np.float32(1.0)
NO_GRID: FloatArray = np.zeros((0, 0), np.float32)
"""In place of a grid where the network itself is asked."""


@compiled
def _bake(share, shares, net, grid):
    """Logits at every n-th plane of vertices."""
    side = len(grid)
    features = np.zeros((len(net.grid.resolutions) * net.grid.table.shape[1], TILE), np.float32)
    hidden = np.zeros((net.hidden.bias.size, TILE), np.float32)
    outputs = np.zeros((net.output.bias.size, TILE), np.float32)
    points = np.zeros((3, TILE), np.float32)
    scale = ONE / np.float32(side - 1)
    for z in range(share, side, shares):
        for begin in range(0, side * side, TILE):
            count = min(TILE, side * side - begin)
            for c in range(count):
                y, x = divmod(begin + c, side)
                points[0, c], points[1, c] = np.float32(x) * scale, np.float32(y) * scale
                points[2, c] = np.float32(z) * scale
            density_logits(net, points, count, features, hidden, outputs)
            for c in range(count):
                grid[z, begin + c] = outputs[0, c]


def bake_logits(net: DensityNet, cells: int) -> FloatArray:
    """Logits of density at the vertices of a grid of unit space, [n, n * n] for n = cells + 1.

    At most as many cells as the network's finest level has: between its vertices the features are
    nearly linear, and so, better than the density, is its logarithm.
    """
    side = min(cells, int(net.grid.resolutions[-1])) + 1
    grid = np.zeros((side, side * side), np.float32)
    run_threads(_bake, net, grid)
    return grid


class BakedGrid:
    """Keeps the grid of the network that was asked for last; bakes another where that changed."""

    def __init__(self) -> None:
        self._key: tuple[int, int] | None = None
        self._grid = NO_GRID

    def of(self, net: DensityNet, cells: int) -> FloatArray:
        """`bake_logits`, or what it gave before for the same numbers."""
        key = (cells, _digest(net))
        if key != self._key:
            self._key, self._grid = key, bake_logits(net, cells)
        return self._grid


def _digest(net: DensityNet) -> int:
    """Tells whether a network has changed: a checksum of its numbers."""
    arrays = (net.grid.table, *net.hidden, *net.output)
    digest = 0
    for array in arrays:
        digest = zlib.crc32(np.ascontiguousarray(array).data, digest)
    return digest


def _generate_lookup(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    points, row_bytes, grid, resolution, out = arguments
    lanes = Lanes(builder)
    resolution = builder.trunc(resolution, INT32)
    cells, (fx, fy, fz) = locate_cells(lanes, points, row_bytes, resolution)
    step = lanes.splat(builder.add(resolution, ir.Constant(INT32, 1)))
    x, y, z = cells
    low = builder.add(x, builder.mul(step, builder.add(y, builder.mul(step, z))))
    plane = builder.mul(step, step)
    rows = [low, builder.add(low, step)]
    rows += [builder.add(row, plane) for row in rows]

    def between(near: Any, far: Any, share: Any) -> Any:
        return lanes.add(lanes.mul(builder.fsub(far, near), share), near)

    edges = [between(*_load_neighbours(lanes, grid, row), fx) for row in rows]
    faces = [between(edges[0], edges[1], fy), between(edges[2], edges[3], fy)]
    lanes.store(between(faces[0], faces[1], fz), out)
    return context.get_dummy_value()


def _load_neighbours(lanes: Lanes, grid: Any, entries: Any) -> tuple[Any, Any]:
    """The values of 16 entries and of those next to them."""
    build = lanes.builder
    half = LANES // 2
    halves = []
    for first in (0, half):
        pairs = ir.Constant(ir.VectorType(INT64, half), ir.Undefined)
        for lane in range(half):
            entry = build.extract_element(entries, ir.Constant(INT32, first + lane))
            offset = build.mul(build.zext(entry, INT64), ir.Constant(INT64, 4))
            pair = lanes.load(build.add(grid, offset), INT64)
            pairs = build.insert_element(pairs, pair, ir.Constant(INT32, lane))
        halves.append(build.bitcast(pairs, FLOATS))
    kind = ir.VectorType(INT32, LANES)
    low = ir.Constant(kind, list(range(0, 2 * LANES, 2)))
    high = ir.Constant(kind, list(range(1, 2 * LANES, 2)))
    return build.shuffle_vector(*halves, low), build.shuffle_vector(*halves, high)


@intrinsic
def _lookup(typing_context, points, row_bytes, grid, resolution, out):
    """Trilinear values at 16 points; all are integers, addresses in bytes."""
    return types.void(*[types.intp] * 5), _generate_lookup


@compiled
def look_up(grid, points, count, out):
    """out[:count] = the grid between its vertices at points[:3, :count] in [0, 1], held inside.

    points: [3 or more, N], out: [N], float32, contiguous, N a multiple of 16.
    """
    row_bytes = points.shape[1] * 4
    points_at, out_at = np.intp(points.ctypes.data), np.intp(out.ctypes.data)
    for at in range(0, count * 4, LANES * 4):
        _lookup(  # type: ignore[call-arg]  # numba passes the typing context
            points_at + at, row_bytes, np.intp(grid.ctypes.data), grid.shape[0] - 1, out_at + at
        )
