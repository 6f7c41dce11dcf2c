"""Triton kernels of the hash grid: forward, and backward to the table and to the points.

Symbols as in `encodings`: L levels, F features per entry, P points, B points of one program. A
program takes B points and one level, with the level as the slow axis of the grid: all programs that
run at once read the same part of the table, 4 MiB at 2^19 entries of two float32, which stays in
the L2 cache. Two features are read and written by one instruction of 64 bits (32 bits in half
precision). Indices inside a level are int32, hashes uint32, and only the first entry of a level is
64 bits wide. What the compiler makes of them is tested in
`tests/unit/.../engines/gpu/test_compile.py`.

The gradient of the table is summed in float32 by atomic additions, two features by one of them from
sm_90 (Hopper) on. Their order is not fixed: two runs agree to rounding, not to the bit. The
gradient of the points has no atomics: one program goes through all levels. Sums are taken in
another order than in the plain definition. `hash_grid` launches them.
"""

# Kernels carry no annotations: triton infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

import triton
import triton.language as tl

PRIME_Y = tl.constexpr(2654435761)
PRIME_Z = tl.constexpr(805459861)


@triton.jit
def _cell_of(points, point, axis: tl.constexpr, inside, resolution):
    """(cell, place in it) along one axis; the same guards as the plain twin."""
    coordinate = tl.load(points + point * 3 + axis, mask=inside, other=0.0)
    # Comparisons, so that a NaN stays one and is seen in the loss.
    kept = tl.where(coordinate < 0.0, 0.0, tl.where(coordinate > 1.0, 1.0, coordinate))
    position = kept * resolution.to(kept.dtype)
    # The second guard is on integers: the far face belongs to the last cell, and a NaN to some.
    cell = tl.minimum(tl.maximum(position.to(tl.int32), 0), resolution - 1)
    return cell, position - cell.to(kept.dtype)


@triton.jit
def _row_of(x, y, z, resolution, is_dense, mask):
    """Rows, counted from the first of the level, of vertices [B]; int32.

    Both are computed and one is chosen: a branch for each corner would keep the reads of the eight
    corners from being under way together.
    """
    stride = resolution + 1
    linear = x + stride * (y + stride * z)
    hashed = x.to(tl.uint32) ^ (y.to(tl.uint32) * PRIME_Y) ^ (z.to(tl.uint32) * PRIME_Z)
    return tl.where(is_dense, linear, (hashed & mask.to(tl.uint32)).to(tl.int32))


@triton.jit
def _level_of(level, resolutions, dense, offsets):
    """(resolution int32, is_dense, first row int64, mask of a hashed level int32)."""
    first = tl.load(offsets + level)
    entries = tl.load(offsets + level + 1) - first
    resolution = tl.load(resolutions + level).to(tl.int32)
    return resolution, tl.load(dense + level) != 0, first, (entries - 1).to(tl.int32)


@triton.jit
def _points_of_program(num_points, B: tl.constexpr):
    """(its points [B] int64, which of them there are)."""
    point = tl.program_id(0) * B + tl.arange(0, B)
    return point.to(tl.int64), point < num_points


@triton.jit
def _places_of(points, point, inside, level, resolutions, dense, offsets):
    """Cells x, y, z and places in them u, v, w of points [B], and the level as `_level_of`."""
    resolution, is_dense, first, mask = _level_of(level, resolutions, dense, offsets)
    x, u = _cell_of(points, point, 0, inside, resolution)
    y, v = _cell_of(points, point, 1, inside, resolution)
    z, w = _cell_of(points, point, 2, inside, resolution)
    return x, y, z, u, v, w, resolution, is_dense, first, mask


@triton.jit
def _corner_of(x, y, z, u, v, w, resolution, is_dense, mask, CORNER: tl.constexpr):
    """(row, weight along x, y and z) of one of the eight corners of cells, x fastest."""
    row = _row_of(
        x + (CORNER & 1),
        y + ((CORNER >> 1) & 1),
        z + ((CORNER >> 2) & 1),
        resolution,
        is_dense,
        mask,
    )
    along_x = u if CORNER & 1 else 1.0 - u
    along_y = v if CORNER & 2 else 1.0 - v
    along_z = w if CORNER & 4 else 1.0 - w
    return row, along_x, along_y, along_z


@triton.jit
def _pair_at(pairs, index, inside, IS_HALF: tl.constexpr):
    """Two neighbouring features [B] each, as float32, by one load; pairs: int64 or int32."""
    bits = tl.load(pairs + index, mask=inside, other=0)
    if IS_HALF:
        low = (bits & 0xFFFF).to(tl.int16).to(tl.float16, bitcast=True).to(tl.float32)
        high = ((bits >> 16) & 0xFFFF).to(tl.int16).to(tl.float16, bitcast=True).to(tl.float32)
    else:
        low = (bits & 0xFFFFFFFF).to(tl.uint32).to(tl.float32, bitcast=True)
        high = ((bits >> 32) & 0xFFFFFFFF).to(tl.uint32).to(tl.float32, bitcast=True)
    return low, high


@triton.jit
def forward_kernel(
    points,
    table,
    resolutions,
    dense,
    offsets,
    encoded,
    num_points,
    num_levels,
    F: tl.constexpr,
    IS_PAIRED: tl.constexpr,
    IS_HALF: tl.constexpr,
    B: tl.constexpr,
):
    """encoded [P, L * F] from points [P, 3] and table [E, F] (paired: [E, F / 2] integers)."""
    point, inside = _points_of_program(num_points, B)
    level = tl.program_id(1)
    x, y, z, u, v, w, resolution, is_dense, first, mask = _places_of(
        points, point, inside, level, resolutions, dense, offsets
    )
    target = encoded + point * (num_levels * F) + level * F
    if IS_PAIRED:
        for half in tl.static_range(F // 2):
            low_sum = tl.zeros_like(u)
            high_sum = tl.zeros_like(u)
            for corner in tl.static_range(8):
                row, a, b, c = _corner_of(x, y, z, u, v, w, resolution, is_dense, mask, corner)
                weight = a * b * c
                start = table + first * (F // 2)
                low, high = _pair_at(start, row * (F // 2) + half, inside, IS_HALF)
                low_sum += weight * low
                high_sum += weight * high
            both = (target + 2 * half)[:, None] + tl.arange(0, 2)[None, :]
            tl.store(both, tl.join(low_sum, high_sum), mask=inside[:, None])
    else:
        for feature in tl.static_range(F):
            total = tl.zeros_like(u)
            for corner in tl.static_range(8):
                row, a, b, c = _corner_of(x, y, z, u, v, w, resolution, is_dense, mask, corner)
                weight = a * b * c
                entry = tl.load(table + first * F + row * F + feature, mask=inside, other=0.0)
                total += weight * entry.to(u.dtype)
            tl.store(target + feature, total, mask=inside)


@triton.jit
def table_gradient_kernel(
    points,
    gradient,
    resolutions,
    dense,
    offsets,
    table_gradient,
    num_points,
    num_levels,
    F: tl.constexpr,
    IS_PAIRED: tl.constexpr,
    IS_HALF_GRADIENT: tl.constexpr,
    B: tl.constexpr,
):
    """Adds to table_gradient [E, F] from gradient [P, L * F] (paired: [P, L * F / 2] integers)."""
    point, inside = _points_of_program(num_points, B)
    level = tl.program_id(1)
    x, y, z, u, v, w, resolution, is_dense, first, mask = _places_of(
        points, point, inside, level, resolutions, dense, offsets
    )
    start = table_gradient + first * F
    for part in tl.static_range(F // 2 if IS_PAIRED else F):
        # A sample behind a wall gets a gradient of exactly 0: nothing to add.
        if IS_PAIRED:
            source = point * (num_levels * (F // 2)) + level * (F // 2) + part
            low, high = _pair_at(gradient, source, inside, IS_HALF_GRADIENT)
            incoming = tl.join(low, high)
            is_felt = inside & ((low != 0.0) | (high != 0.0))
        else:
            source = point * (num_levels * F) + level * F + part
            incoming = tl.load(gradient + source, mask=inside, other=0.0).to(u.dtype)
            is_felt = inside & (incoming != 0.0)
        for corner in tl.static_range(8):
            row, a, b, c = _corner_of(x, y, z, u, v, w, resolution, is_dense, mask, corner)
            weight = a * b * c
            if IS_PAIRED:
                both = (start + row * F + 2 * part)[:, None] + tl.arange(0, 2)[None, :]
                share = weight[:, None] * incoming
                tl.atomic_add(both, share, mask=is_felt[:, None], sem="relaxed")
            else:
                entry = start + row * F + part
                tl.atomic_add(entry, weight * incoming, mask=is_felt, sem="relaxed")


@triton.jit
def point_gradient_kernel(
    points,
    table,
    gradient,
    resolutions,
    dense,
    offsets,
    point_gradient,
    num_points,
    L: tl.constexpr,
    F: tl.constexpr,
    IS_PAIRED: tl.constexpr,
    IS_HALF: tl.constexpr,
    IS_HALF_GRADIENT: tl.constexpr,
    B: tl.constexpr,
):
    """point_gradient [P, 3] from gradient [P, L * F] and the entries around each point."""
    point, inside = _points_of_program(num_points, B)
    sum_x = tl.zeros([B], points.dtype.element_ty)
    sum_y = tl.zeros([B], points.dtype.element_ty)
    sum_z = tl.zeros([B], points.dtype.element_ty)
    for level in range(L):
        x, y, z, u, v, w, resolution, is_dense, first, mask = _places_of(
            points, point, inside, level, resolutions, dense, offsets
        )
        scale = resolution.to(u.dtype)
        for part in tl.static_range(F // 2 if IS_PAIRED else F):
            if IS_PAIRED:
                source = point * (L * (F // 2)) + level * (F // 2) + part
                incoming_low, incoming_high = _pair_at(gradient, source, inside, IS_HALF_GRADIENT)
            else:
                source = point * (L * F) + level * F + part
                incoming = tl.load(gradient + source, mask=inside, other=0.0).to(u.dtype)
            for corner in tl.static_range(8):
                row, a, b, c = _corner_of(x, y, z, u, v, w, resolution, is_dense, mask, corner)
                if IS_PAIRED:
                    start = table + first * (F // 2)
                    low, high = _pair_at(start, row * (F // 2) + part, inside, IS_HALF)
                    agreed = (incoming_low * low + incoming_high * high) * scale
                else:
                    entry = tl.load(table + first * F + row * F + part, mask=inside, other=0.0)
                    agreed = incoming * entry.to(u.dtype) * scale
                sum_x += (agreed if corner & 1 else -agreed) * b * c
                sum_y += (agreed if corner & 2 else -agreed) * a * c
                sum_z += (agreed if corner & 4 else -agreed) * a * b
    _store_kept(points, point_gradient, point, 0, inside, sum_x)
    _store_kept(points, point_gradient, point, 1, inside, sum_y)
    _store_kept(points, point_gradient, point, 2, inside, sum_z)


@triton.jit
def _store_kept(points, point_gradient, point, axis: tl.constexpr, inside, total):
    """The plain twin clamps its coordinates: beyond a face nothing moves."""
    coordinate = tl.load(points + point * 3 + axis, mask=inside, other=0.0)
    is_free = (coordinate >= 0.0) & (coordinate <= 1.0)
    tl.store(point_gradient + point * 3 + axis, tl.where(is_free, total, 0.0), mask=inside)
