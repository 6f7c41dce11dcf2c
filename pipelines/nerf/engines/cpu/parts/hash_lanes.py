"""The hash grid for tiles of samples with two features per entry, 16 samples at once.

Twin of `encodings.hash_encode` and of its gradient towards the table. Symbols: a level has
`resolution` cells per side; `x, y, z` are a sample's cell, `f` its place inside, in [0, 1]. Samples
lie in columns: points [3, N], features [L * 2, N]. The gradient adds up the samples of a run that
share a cell, as neighbours on a ray do on coarse levels, before it touches the table.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from llvmlite import ir  # type: ignore[import-untyped]
from numba import types
from numba.extending import intrinsic
from torch import Tensor

from pipelines.nerf.engines.cpu.parts.lanes import FLOATS, INT32, INT64, INTS, LANES, Lanes
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged
from pipelines.nerf.space.hash_levels import HASH_PRIMES

NUM_FEATURES = 2
CORNERS = 8
ENTRY_BYTES = 4 * NUM_FEATURES
PAIR = ir.VectorType(ir.FloatType(), NUM_FEATURES)


class GridArrays(NamedTuple):
    """A hash grid for kernels: table [E, 2] float32, and the levels as `hash_levels` lays them."""

    table: Any
    resolutions: Any
    dense: Any
    offsets: Any


def pack_grid(table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor) -> GridArrays:
    """The grid as arrays, which share the memory of contiguous tensors on the CPU."""
    tensors = (table, resolutions, dense, offsets)
    return GridArrays(*(tensor.detach().cpu().contiguous().numpy() for tensor in tensors))


@merged
def one_level(grid, level):
    """The grid as if it had this level alone."""
    return GridArrays(
        grid.table,
        grid.resolutions[level : level + 1],
        grid.dense[level : level + 1],
        grid.offsets[level : level + 2],
    )


def _int32(value: int) -> int:
    """The int32 with the low bits of an unsigned number."""
    return value - 2**32 if value >= 2**31 else value


def locate_cells(
    lanes: Lanes, points: Any, row_bytes: Any, resolution: Any
) -> tuple[list[Any], ...]:
    """Cells (int32) and places inside them of 16 points; the guards of the plain twin."""
    build = lanes.builder
    scale = lanes.splat(build.sitofp(resolution, ir.FloatType()))
    last = lanes.splat(build.sub(resolution, ir.Constant(INT32, 1)))
    cells, fractions = [], []
    address = points
    for _ in range(3):
        place = lanes.lower_to(
            lanes.raise_to(lanes.load(address), lanes.floats(0.0)), lanes.floats(1.0)
        )
        place = lanes.mul(place, scale)
        # A NaN has no cell, but must not read beyond the table: cell 0; its place stays a NaN.
        cell = build.fptosi(lanes.without_nan(place), INTS)
        cell = build.select(build.icmp_signed("<", cell, last), cell, last)
        cells.append(cell)
        fractions.append(build.fsub(place, build.sitofp(cell, FLOATS)))
        address = build.add(address, row_bytes)
    return cells, fractions


def corner_entries(lanes: Lanes, cells: list[Any], step: Any, dense: bool) -> list[Any]:
    """Entries, within the level, of the eight corners, x fastest; int32.

    step: cells per side + 1 of a dense level, the mask of a hashed one.
    """
    build = lanes.builder
    one = lanes.ints(1)
    x0, (y, z) = cells[0], cells[1:]
    step = lanes.splat(step)
    if dense:
        step_y, step_z = step, build.mul(step, step)
    else:
        step_y, step_z = (lanes.ints(_int32(prime)) for prime in HASH_PRIMES[1:])
    x1 = build.add(x0, one)
    y0, z0 = build.mul(y, step_y), build.mul(z, step_z)
    y1, z1 = build.add(y0, step_y), build.add(z0, step_z)
    entries = []
    for other_z in (z0, z1):
        for other_y in (y0, y1):
            if dense:
                row = build.add(other_y, other_z)
                entries += [build.add(x, row) for x in (x0, x1)]
            else:
                row = build.xor(other_y, other_z)
                entries += [build.and_(build.xor(x, row), step) for x in (x0, x1)]
    return entries


def _corner_weights(lanes: Lanes, fractions: list[Any]) -> list[Any]:
    """Trilinear weights of the eight corners, x fastest."""
    one = lanes.floats(1.0)
    (x0, x1), (y0, y1), (z0, z1) = ((lanes.builder.fsub(one, f), f) for f in fractions)
    rows = [lanes.mul(y, z) for z in (z0, z1) for y in (y0, y1)]
    return [lanes.mul(x, row) for row in rows for x in (x0, x1)]


def _entry_address(lanes: Lanes, table: Any, entry: Any) -> Any:
    build = lanes.builder
    return build.add(table, build.mul(build.zext(entry, INT64), ir.Constant(INT64, ENTRY_BYTES)))


def gather_pairs(lanes: Lanes, table: Any, entries: Any) -> tuple[Any, Any]:
    """Both features of 16 entries."""
    build = lanes.builder
    half = LANES // 2
    undefined = ir.Constant(ir.VectorType(INT64, half), ir.Undefined)
    halves = []
    for first in (0, half):
        pairs = undefined
        for lane in range(half):
            entry = build.extract_element(entries, ir.Constant(INT32, first + lane))
            pair = lanes.load(_entry_address(lanes, table, entry), INT64)
            pairs = build.insert_element(pairs, pair, ir.Constant(INT32, lane))
        halves.append(build.bitcast(pairs, FLOATS))
    low = ir.Constant(INTS, list(range(0, 2 * LANES, 2)))
    high = ir.Constant(INTS, list(range(1, 2 * LANES, 2)))
    return build.shuffle_vector(*halves, low), build.shuffle_vector(*halves, high)


def _generate_encode(dense: bool) -> Callable[..., Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        points, row_bytes, table, resolution, step, out, out_row_bytes = arguments
        lanes = Lanes(builder)
        cells, fractions = locate_cells(lanes, points, row_bytes, builder.trunc(resolution, INT32))
        entries = corner_entries(lanes, cells, builder.trunc(step, INT32), dense)
        sums: list[Any] = []
        for entry, weight in zip(entries, _corner_weights(lanes, fractions), strict=True):
            terms = [lanes.mul(weight, value) for value in gather_pairs(lanes, table, entry)]
            sums = [lanes.add(s, t) for s, t in zip(sums, terms, strict=True)] if sums else terms
        lanes.store(sums[0], out)
        lanes.store(sums[1], builder.add(out, out_row_bytes))
        return context.get_dummy_value()

    return generate


@intrinsic
def _encode_dense(typing_context, points, row_bytes, table, resolution, step, out, out_row_bytes):
    """Features of 16 points on a dense level; all are integers, addresses in bytes."""
    return types.void(*[types.intp] * 7), _generate_encode(True)


@intrinsic
def _encode_hashed(typing_context, points, row_bytes, table, resolution, step, out, out_row_bytes):
    """Features of 16 points on a hashed level; all are integers, addresses in bytes."""
    return types.void(*[types.intp] * 7), _generate_encode(False)


@merged
def level_step(grid, level):
    """What `corner_entries` steps by: cells per side + 1 where dense, else the hash's mask."""
    if grid.dense[level]:
        return grid.resolutions[level] + 1
    return grid.offsets[level + 1] - grid.offsets[level] - 1


@compiled
def encode_columns(points, begin, count, grid, out):
    """Features of points[:, begin : begin + count] into out[:, :count].

    points: [3 or more, N], unit space. grid: `GridArrays`. out: [L * 2 or more, TILE]. All float32
    and contiguous; up to 15 columns behind `count` are read and written as well.
    """
    row_bytes, out_row_bytes = points.shape[1] * 4, out.shape[1] * 4
    points_at = np.intp(points.ctypes.data) + begin * 4
    table_at, out_at = np.intp(grid.table.ctypes.data), np.intp(out.ctypes.data)
    for level in range(len(grid.resolutions)):
        first, resolution = table_at + grid.offsets[level] * ENTRY_BYTES, grid.resolutions[level]
        target = out_at + NUM_FEATURES * level * out_row_bytes
        step = level_step(grid, level)
        if grid.dense[level]:
            for at in range(0, count * 4, LANES * 4):
                _encode_dense(  # type: ignore[call-arg]  # numba passes the typing context
                    points_at + at, row_bytes, first, resolution, step, target + at, out_row_bytes
                )
        else:
            for at in range(0, count * 4, LANES * 4):
                _encode_hashed(  # type: ignore[call-arg]
                    points_at + at, row_bytes, first, resolution, step, target + at, out_row_bytes
                )


def _generate_locate(dense: bool) -> Callable[..., Any]:
    def generate(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
        points, row_bytes, resolution, step, out, out_row_bytes = arguments
        lanes = Lanes(builder)
        cells, fractions = locate_cells(lanes, points, row_bytes, builder.trunc(resolution, INT32))
        entries = corner_entries(lanes, cells, builder.trunc(step, INT32), dense)
        # Two numbers tell cells apart, as there are at most 2^16 per side.
        plane = builder.or_(cells[0], builder.shl(cells[1], lanes.ints(16)))
        for row in (*fractions, plane, cells[2], *entries):
            lanes.store(row, out)
            out = builder.add(out, out_row_bytes)
        return context.get_dummy_value()

    return generate


PLACE_ROWS = 3 + 2 + CORNERS
"""Rows of the scratch of `scatter_columns`: fractions, the cell in two numbers, entries."""


@intrinsic
def _locate_dense(typing_context, points, row_bytes, resolution, step, out, out_row_bytes):
    """PLACE_ROWS rows of 16 columns for a dense level; integers, addresses in bytes."""
    return types.void(*[types.intp] * 6), _generate_locate(True)


@intrinsic
def _locate_hashed(typing_context, points, row_bytes, resolution, step, out, out_row_bytes):
    """PLACE_ROWS rows of 16 columns for a hashed level; integers, addresses in bytes."""
    return types.void(*[types.intp] * 6), _generate_locate(False)


@intrinsic
def _scatter_runs(typing_context, places, row_bytes, grad_out, grad_row_bytes, count, grad_table):
    """Add the gradient of `count` > 0 columns to a level; integers, addresses in bytes.

    places: as `_locate_dense`. grad_out: the level's two rows of the features' gradient.
    """
    return types.void(*[types.intp] * 6), _generate_scatter


def _write_run(lanes: Lanes, places: Any, row_bytes: Any, grad_table: Any, total: Any) -> None:
    """Add the sums of a run, lanes (corner, feature), to the entries that `places` names."""
    build = lanes.builder
    address = build.add(places, build.mul(row_bytes, ir.Constant(INT64, 5)))
    for corner in range(CORNERS):
        target = _entry_address(lanes, grad_table, lanes.load(address, INT32))
        pick = ir.Constant(ir.VectorType(INT32, 2), [2 * corner, 2 * corner + 1])
        part = build.shuffle_vector(total, ir.Constant(FLOATS, ir.Undefined), pick)
        lanes.store(build.fadd(lanes.load(target, PAIR), part), target)
        address = build.add(address, row_bytes)


def _spread_column(
    lanes: Lanes, places: Any, row_bytes: Any, grad: Any, grad_row_bytes: Any
) -> Any:
    """Corner weight times feature gradient of one column, lanes (corner, feature)."""
    build = lanes.builder
    number = ir.FloatType()
    weight = None
    address = places
    for axis in range(3):
        bits = [lane // NUM_FEATURES >> axis & 1 for lane in range(LANES)]
        sign = ir.Constant(FLOATS, [1.0 if bit else -1.0 for bit in bits])
        start = ir.Constant(FLOATS, [0.0 if bit else 1.0 for bit in bits])
        part = lanes.add(lanes.mul(lanes.splat(lanes.load(address, number)), sign), start)
        weight = part if weight is None else lanes.mul(weight, part)
        address = build.add(address, row_bytes)
    first = lanes.splat(lanes.load(grad, number))
    second = lanes.splat(lanes.load(build.add(grad, grad_row_bytes), number))
    pick = ir.Constant(INTS, [lane if lane % 2 == 0 else LANES + lane for lane in range(LANES)])
    return lanes.mul(weight, build.shuffle_vector(first, second, pick))


def _generate_scatter(context: Any, builder: Any, signature: Any, arguments: Any) -> Any:
    places, row_bytes, grad_out, grad_row_bytes, count, grad_table = arguments
    lanes = Lanes(builder)
    zero, nothing = ir.Constant(INT64, 0), lanes.floats(0.0)
    key_bytes = builder.mul(row_bytes, ir.Constant(INT64, 3))
    key_at = builder.add(places, key_bytes)
    first_keys = [lanes.load(key_at, INT32), lanes.load(builder.add(key_at, row_bytes), INT32)]
    end = builder.mul(count, ir.Constant(INT64, 4))

    entry = builder.block
    loop, write = builder.append_basic_block("column"), builder.append_basic_block("write")
    gather, done = builder.append_basic_block("gather"), builder.append_basic_block("done")
    builder.branch(loop)

    builder.position_at_end(loop)
    at, total = builder.phi(INT64), builder.phi(FLOATS)
    before = [builder.phi(INT32), builder.phi(INT32)]
    here = builder.add(places, at)
    key_at = builder.add(here, key_bytes)
    keys = [lanes.load(key_at, INT32), lanes.load(builder.add(key_at, row_bytes), INT32)]
    differs = builder.or_(*(builder.xor(a, b) for a, b in zip(keys, before, strict=True)))
    builder.cbranch(builder.icmp_signed("!=", differs, ir.Constant(INT32, 0)), write, gather)

    builder.position_at_end(write)
    _write_run(lanes, lanes.at(here, -4), row_bytes, grad_table, total)
    builder.branch(gather)

    builder.position_at_end(gather)
    so_far = builder.phi(FLOATS)
    so_far.add_incoming(total, loop)
    so_far.add_incoming(nothing, write)
    column = _spread_column(lanes, here, row_bytes, builder.add(grad_out, at), grad_row_bytes)
    summed = lanes.add(so_far, column)
    following = lanes.at(at, 4)
    pairs = (
        (at, zero, following),
        (total, nothing, summed),
        *zip(before, first_keys, keys, strict=True),
    )
    for phi, first, then in pairs:
        phi.add_incoming(first, entry)
        phi.add_incoming(then, gather)
    builder.cbranch(builder.icmp_signed("<", following, end), loop, done)

    builder.position_at_end(done)
    _write_run(lanes, here, row_bytes, grad_table, summed)
    return context.get_dummy_value()


@compiled
def scatter_columns(points, begin, count, grid, grad_out, places, grad_table):
    """Add to grad_table [E, 2] the gradient of `encode_columns` for grad_out [L * 2, TILE].

    places: [PLACE_ROWS, TILE] float32 scratch. All float32 and contiguous. The grid's own table is
    not read.
    """
    if count == 0:
        return
    row_bytes, place_row_bytes = points.shape[1] * 4, places.shape[1] * 4
    grad_row_bytes = grad_out.shape[1] * 4
    points_at = np.intp(points.ctypes.data) + begin * 4
    places_at, grad_at = np.intp(places.ctypes.data), np.intp(grad_out.ctypes.data)
    table_at = np.intp(grad_table.ctypes.data)
    for level in range(len(grid.resolutions)):
        resolution, step = grid.resolutions[level], level_step(grid, level)
        if grid.dense[level]:
            for at in range(0, count * 4, LANES * 4):
                _locate_dense(  # type: ignore[call-arg]
                    points_at + at, row_bytes, resolution, step, places_at + at, place_row_bytes
                )
        else:
            for at in range(0, count * 4, LANES * 4):
                _locate_hashed(  # type: ignore[call-arg]
                    points_at + at, row_bytes, resolution, step, places_at + at, place_row_bytes
                )
        _scatter_runs(  # type: ignore[call-arg]
            places_at,
            place_row_bytes,
            grad_at + NUM_FEATURES * level * grad_row_bytes,
            grad_row_bytes,
            count,
            table_at + grid.offsets[level] * ENTRY_BYTES,
        )
