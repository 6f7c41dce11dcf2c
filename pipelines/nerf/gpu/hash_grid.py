"""Triton twin of `encodings.hash_encode`: forward, and backward to the table and to the points.

Symbols as in `encodings`: L levels, F features per entry, P points, B points of one program. A
program takes B points and one level, with the level as the slow axis of the grid: all programs that
run at once read the same part of the table, 4 MiB at 2^19 entries of two float32, which stays in
the L2 cache. Two features are read by one load of 64 bits (32 bits in half precision). Indices
inside a level are int32, hashes uint32, and only the first entry of a level is 64 bits wide.

The gradient of the table is summed in float32 by atomic additions, whose order is not fixed: two
runs agree to rounding, not to the bit. The gradient of the points has no atomics: one program goes
through all levels. Sums are taken in another order than in the plain definition.

Nothing here runs at import. Without a GPU the kernels run in Triton's interpreter, where
TRITON_INTERPRET=1 was set before triton was imported; that is how they are tested.
"""

# Kernels carry no annotations: triton infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"

from __future__ import annotations

from typing import Any

import torch
import triton
import triton.language as tl
from torch import Tensor

from pipelines.nerf.errors import NerfError

POINTS_PER_PROGRAM = 256
NUM_WARPS = 4
MAX_FEATURES = 8
PRIME_Y = tl.constexpr(2654435761)
PRIME_Z = tl.constexpr(805459861)


@triton.jit
def _cell_of(points, point, axis: tl.constexpr, inside, resolution):
    """(cell, place in it, coordinate) along one axis; the same guards as the plain twin."""
    coordinate = tl.load(points + point * 3 + axis, mask=inside, other=0.0)
    # Comparisons, so that a NaN stays one and is seen in the loss.
    kept = tl.where(coordinate < 0.0, 0.0, tl.where(coordinate > 1.0, 1.0, coordinate))
    position = kept * resolution.to(kept.dtype)
    # The second guard is on integers: the far face belongs to the last cell, and a NaN to some.
    cell = tl.minimum(tl.maximum(position.to(tl.int32), 0), resolution - 1)
    return cell, position - cell.to(kept.dtype), coordinate


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
def _forward_kernel(
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
    point = tl.program_id(0) * B + tl.arange(0, B)
    level = tl.program_id(1)
    inside = point < num_points
    point = point.to(tl.int64)
    resolution, is_dense, first, mask = _level_of(level, resolutions, dense, offsets)
    x, u, _ = _cell_of(points, point, 0, inside, resolution)
    y, v, _ = _cell_of(points, point, 1, inside, resolution)
    z, w, _ = _cell_of(points, point, 2, inside, resolution)
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
            tl.store(target + 2 * half, low_sum, mask=inside)
            tl.store(target + 2 * half + 1, high_sum, mask=inside)
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
def _table_gradient_kernel(
    points,
    gradient,
    resolutions,
    dense,
    offsets,
    table_gradient,
    num_points,
    num_levels,
    F: tl.constexpr,
    B: tl.constexpr,
):
    """Adds to table_gradient [E, F] from gradient [P, L * F], both of the points' type."""
    point = tl.program_id(0) * B + tl.arange(0, B)
    level = tl.program_id(1)
    inside = point < num_points
    point = point.to(tl.int64)
    resolution, is_dense, first, mask = _level_of(level, resolutions, dense, offsets)
    x, u, _ = _cell_of(points, point, 0, inside, resolution)
    y, v, _ = _cell_of(points, point, 1, inside, resolution)
    z, w, _ = _cell_of(points, point, 2, inside, resolution)
    source = gradient + point * (num_levels * F) + level * F
    start = table_gradient + first * F
    for feature in tl.static_range(F):
        incoming = tl.load(source + feature, mask=inside, other=0.0)
        # A sample behind a wall gets a gradient of exactly 0: nothing to add.
        is_felt = inside & (incoming != 0.0)
        for corner in tl.static_range(8):
            row, a, b, c = _corner_of(x, y, z, u, v, w, resolution, is_dense, mask, corner)
            weight = a * b * c
            tl.atomic_add(start + row * F + feature, weight * incoming, mask=is_felt, sem="relaxed")


@triton.jit
def _point_gradient_kernel(
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
    B: tl.constexpr,
):
    """point_gradient [P, 3] from gradient [P, L * F] and the entries around each point."""
    point = tl.program_id(0) * B + tl.arange(0, B)
    inside = point < num_points
    point = point.to(tl.int64)
    sum_x = tl.zeros([B], points.dtype.element_ty)
    sum_y = tl.zeros([B], points.dtype.element_ty)
    sum_z = tl.zeros([B], points.dtype.element_ty)
    for level in range(L):
        resolution, is_dense, first, mask = _level_of(level, resolutions, dense, offsets)
        x, u, _ = _cell_of(points, point, 0, inside, resolution)
        y, v, _ = _cell_of(points, point, 1, inside, resolution)
        z, w, _ = _cell_of(points, point, 2, inside, resolution)
        source = gradient + point * (L * F) + level * F
        scale = resolution.to(u.dtype)
        for part in tl.static_range(F // 2 if IS_PAIRED else F):
            if IS_PAIRED:
                incoming_low = tl.load(source + 2 * part, mask=inside, other=0.0)
                incoming_high = tl.load(source + 2 * part + 1, mask=inside, other=0.0)
            else:
                incoming = tl.load(source + part, mask=inside, other=0.0)
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


def _readable(table: Tensor) -> tuple[Tensor, bool, bool]:
    """(table as the kernels read it, IS_PAIRED, IS_HALF): pairs of features are one integer."""
    is_half = table.dtype == torch.float16
    is_paired = table.shape[1] % 2 == 0 and table.dtype in (torch.float16, torch.float32)
    if is_paired:
        table = table.view(torch.int32 if is_half else torch.int64)
    return table, is_paired, is_half


class _HashEncode(torch.autograd.Function):
    """points [P, 3], table [E, F], the table that is read, and the three arrays of the layout."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        lookup: Tensor,
        resolutions: Tensor,
        dense: Tensor,
        offsets: Tensor,
    ) -> Tensor:
        num_points, num_levels, num_features = len(points), len(resolutions), table.shape[1]
        encoded = points.new_empty(num_points, num_levels * num_features)
        ctx.save_for_backward(points, table, lookup, resolutions, dense, offsets)
        if num_points == 0:
            return encoded
        read, is_paired, is_half = _readable(lookup)
        _forward_kernel[(triton.cdiv(num_points, POINTS_PER_PROGRAM), num_levels)](
            points,
            read,
            resolutions,
            dense,
            offsets,
            encoded,
            num_points,
            num_levels,
            F=num_features,
            IS_PAIRED=is_paired,
            IS_HALF=is_half,
            B=POINTS_PER_PROGRAM,
            num_warps=NUM_WARPS,
        )
        return encoded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        points, table, lookup, resolutions, dense, offsets = ctx.saved_tensors
        gradient = gradients[0].to(points.dtype).contiguous()
        num_points, num_levels, num_features = len(points), len(resolutions), table.shape[1]
        num_programs = triton.cdiv(num_points, POINTS_PER_PROGRAM)
        point_gradient, table_gradient = None, None
        if ctx.needs_input_grad[0]:
            point_gradient = torch.empty_like(points)
            if num_points:
                read, is_paired, is_half = _readable(lookup)
                _point_gradient_kernel[(num_programs,)](
                    points,
                    read,
                    gradient,
                    resolutions,
                    dense,
                    offsets,
                    point_gradient,
                    num_points,
                    L=num_levels,
                    F=num_features,
                    IS_PAIRED=is_paired,
                    IS_HALF=is_half,
                    B=POINTS_PER_PROGRAM,
                    num_warps=NUM_WARPS,
                )
        if ctx.needs_input_grad[1]:
            table_gradient = torch.zeros_like(table)
            if num_points:
                _table_gradient_kernel[(num_programs, num_levels)](
                    points,
                    gradient,
                    resolutions,
                    dense,
                    offsets,
                    table_gradient,
                    num_points,
                    num_levels,
                    F=num_features,
                    B=POINTS_PER_PROGRAM,
                    num_warps=NUM_WARPS,
                )
        return point_gradient, table_gradient, None, None, None, None


def hash_encode_triton(
    points: Tensor,
    table: Tensor,
    resolutions: Tensor,
    dense: Tensor,
    offsets: Tensor,
    *,
    lookup: Tensor | None = None,
) -> Tensor:
    """`encodings.hash_encode` by Triton; once differentiable in `points` and `table`.

    points: [..., 3] in [0, 1]; what lies outside is moved to the nearest face.
    table: [E, F] float32 (float64 for tests), contiguous, F <= 8; its gradient has the same type.
    resolutions [L] int64, dense [L] bool, offsets [L + 1] int64: as `encodings.level_layout`, on
    the table's device; they are never read by the host.
    lookup: [E, F] float16, a copy of the table that is read in its place: half the traffic, and a
        relative error of 2^-11 per entry. The gradient goes to `table` all the same.
    Returns [..., L * F] of the table's type, coarsest level first.
    Raises NerfError `bad_config` where a shape or type is another.
    """
    read = table if lookup is None else lookup
    _check(points, table, read)
    flat = points.reshape(-1, 3).to(table.dtype).contiguous()
    encoded: Tensor = _HashEncode.apply(flat, table, read, resolutions, dense, offsets)
    return encoded.reshape(*points.shape[:-1], encoded.shape[-1])


def _check(points: Tensor, table: Tensor, lookup: Tensor) -> None:
    """Shapes, types and devices at the edge: a kernel would read beyond the arrays instead."""
    problem = ""
    if points.shape[-1:] != (3,):
        problem = f"points are {list(points.shape)}, not [..., 3]"
    elif table.dim() != 2 or not 1 <= table.shape[1] <= MAX_FEATURES:
        problem = f"the table is {list(table.shape)}, not [E, 1 to {MAX_FEATURES}]"
    elif table.dtype not in (torch.float32, torch.float64):
        problem = f"the table is {table.dtype}, not float32"
    elif lookup is not table and (lookup.shape != table.shape or lookup.dtype != torch.float16):
        problem = f"lookup is {list(lookup.shape)} {lookup.dtype}, not the table in float16"
    elif not (table.is_contiguous() and lookup.is_contiguous()):
        problem = "the table is not contiguous"
    elif not points.device == table.device == lookup.device:
        problem = f"points are on {points.device}, the table on {table.device}"
    if problem:
        raise NerfError(
            "bad_config", f"The hash grid cannot be read: {problem}.", "Use the engine 'plain'."
        )
