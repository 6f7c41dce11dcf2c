"""Numba twin of `encodings.hash_encode`: forward, and backward to the table and to the points.

Symbols as in `encodings`: L levels, F features, P points. Sums are taken in another order than in
the plain definition, so values agree to float32 rounding. Backward gives a level to one thread, so
that no two threads write the same entry and results repeat.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.kernels.runtime import compiled, inlined, run_threads

PRIME_Y = np.int64(2654435761)
PRIME_Z = np.int64(805459861)
TILE = 256


@inlined
def cell_of(coordinate, resolution):
    """Cell and place inside it of one unit coordinate; the same guards as the plain twin."""
    position = min(max(coordinate, np.float32(0.0)), np.float32(1.0)) * np.float32(resolution)
    # The second guard is on integers, because a NaN passes the first one.
    cell = min(max(np.int64(position), np.int64(0)), resolution - 1)
    return cell, position - np.float32(cell)


@inlined
def corner_terms(x, y, z, resolution, is_dense):
    """Per axis, the low and high terms whose sum (dense) or xor (hashed) is the entry."""
    if is_dense:
        stride = resolution + 1
        return (
            x,
            x + 1,
            stride * y,
            stride * (y + 1),
            stride * stride * z,
            stride * stride * (z + 1),
        )
    return x, x + 1, PRIME_Y * y, PRIME_Y * (y + 1), PRIME_Z * z, PRIME_Z * (z + 1)


@inlined
def corner_entries(x, y, z, resolution, is_dense, first, last):
    """Rows of the table of the eight corners of a cell, x fastest."""
    x0, x1, y0, y1, z0, z1 = corner_terms(x, y, z, resolution, is_dense)
    if is_dense:
        a, b, c, d = y0 + z0 + first, y1 + z0 + first, y0 + z1 + first, y1 + z1 + first
        return x0 + a, x1 + a, x0 + b, x1 + b, x0 + c, x1 + c, x0 + d, x1 + d
    mask = last - first - 1
    a, b, c, d = y0 ^ z0, y1 ^ z0, y0 ^ z1, y1 ^ z1
    return (
        ((x0 ^ a) & mask) + first,
        ((x1 ^ a) & mask) + first,
        ((x0 ^ b) & mask) + first,
        ((x1 ^ b) & mask) + first,
        ((x0 ^ c) & mask) + first,
        ((x1 ^ c) & mask) + first,
        ((x0 ^ d) & mask) + first,
        ((x1 ^ d) & mask) + first,
    )


@inlined
def corner_weights(fx, fy, fz):
    """Trilinear weights of the eight corners, x fastest."""
    one = np.float32(1.0)
    gx, gy, gz = one - fx, one - fy, one - fz
    a, b, c, d = gy * gz, fy * gz, gy * fz, fy * fz
    return gx * a, fx * a, gx * b, fx * b, gx * c, fx * c, gx * d, fx * d


@compiled
def encode_points(points, count, table, resolutions, dense, offsets, out):
    """Features of points[:count] into out[:count, :L * F]."""
    num_features = table.shape[1]
    for level in range(len(resolutions)):
        resolution, is_dense = resolutions[level], dense[level]
        first, last = offsets[level], offsets[level + 1]
        column = level * num_features
        for p in range(count):
            x, fx = cell_of(points[p, 0], resolution)
            y, fy = cell_of(points[p, 1], resolution)
            z, fz = cell_of(points[p, 2], resolution)
            e0, e1, e2, e3, e4, e5, e6, e7 = corner_entries(
                x, y, z, resolution, is_dense, first, last
            )
            w0, w1, w2, w3, w4, w5, w6, w7 = corner_weights(fx, fy, fz)
            if num_features == 2:  # the usual number, written out: twice as fast as the loop
                out[p, column] = (
                    (w0 * table[e0, 0] + w1 * table[e1, 0])
                    + (w2 * table[e2, 0] + w3 * table[e3, 0])
                ) + (
                    (w4 * table[e4, 0] + w5 * table[e5, 0])
                    + (w6 * table[e6, 0] + w7 * table[e7, 0])
                )
                out[p, column + 1] = (
                    (w0 * table[e0, 1] + w1 * table[e1, 1])
                    + (w2 * table[e2, 1] + w3 * table[e3, 1])
                ) + (
                    (w4 * table[e4, 1] + w5 * table[e5, 1])
                    + (w6 * table[e6, 1] + w7 * table[e7, 1])
                )
            else:
                for f in range(num_features):
                    out[p, column + f] = (
                        (w0 * table[e0, f] + w1 * table[e1, f])
                        + (w2 * table[e2, f] + w3 * table[e3, f])
                    ) + (
                        (w4 * table[e4, f] + w5 * table[e5, f])
                        + (w6 * table[e6, f] + w7 * table[e7, f])
                    )


@compiled
def _forward(share, shares, points, table, resolutions, dense, offsets, out):
    num_points = len(points)
    for tile in range(share, (num_points + TILE - 1) // TILE, shares):
        begin = tile * TILE
        count = min(TILE, num_points - begin)
        encode_points(points[begin:], count, table, resolutions, dense, offsets, out[begin:])


@inlined
def dot_entry(table, entry, grad_out, p, column):
    """table[entry] . the features' gradient at point p: all that the loss sees of a corner."""
    if table.shape[1] == 2:
        return table[entry, 0] * grad_out[p, column] + table[entry, 1] * grad_out[p, column + 1]
    total = np.float32(0.0)
    for f in range(table.shape[1]):
        total += table[entry, f] * grad_out[p, column + f]
    return total


@compiled
def scatter_level(points, table, resolution, is_dense, first, last, grad_out, column, grad_table):
    """Add the gradient of one level to its entries."""
    for p in range(len(points)):
        x, fx = cell_of(points[p, 0], resolution)
        y, fy = cell_of(points[p, 1], resolution)
        z, fz = cell_of(points[p, 2], resolution)
        e0, e1, e2, e3, e4, e5, e6, e7 = corner_entries(x, y, z, resolution, is_dense, first, last)
        w0, w1, w2, w3, w4, w5, w6, w7 = corner_weights(fx, fy, fz)
        # Feature by feature: written out for two, this loop is three times slower.
        for f in range(table.shape[1]):
            g = grad_out[p, column + f]
            grad_table[e0, f] += w0 * g
            grad_table[e1, f] += w1 * g
            grad_table[e2, f] += w2 * g
            grad_table[e3, f] += w3 * g
            grad_table[e4, f] += w4 * g
            grad_table[e5, f] += w5 * g
            grad_table[e6, f] += w6 * g
            grad_table[e7, f] += w7 * g


@compiled
def differentiate_level(
    points, table, resolution, is_dense, first, last, grad_out, column, grad_points
):
    """Add to grad_points [P, 3] what flows back through the places inside the cells of a level."""
    one, zero = np.float32(1.0), np.float32(0.0)
    scale = np.float32(resolution)
    for p in range(len(points)):
        x, fx = cell_of(points[p, 0], resolution)
        y, fy = cell_of(points[p, 1], resolution)
        z, fz = cell_of(points[p, 2], resolution)
        gx, gy, gz = one - fx, one - fy, one - fz
        e0, e1, e2, e3, e4, e5, e6, e7 = corner_entries(x, y, z, resolution, is_dense, first, last)
        v0 = dot_entry(table, e0, grad_out, p, column)
        v1 = dot_entry(table, e1, grad_out, p, column)
        v2 = dot_entry(table, e2, grad_out, p, column)
        v3 = dot_entry(table, e3, grad_out, p, column)
        v4 = dot_entry(table, e4, grad_out, p, column)
        v5 = dot_entry(table, e5, grad_out, p, column)
        v6 = dot_entry(table, e6, grad_out, p, column)
        v7 = dot_entry(table, e7, grad_out, p, column)
        dx = gz * (gy * (v1 - v0) + fy * (v3 - v2)) + fz * (gy * (v5 - v4) + fy * (v7 - v6))
        dy = gz * (gx * (v2 - v0) + fx * (v3 - v1)) + fz * (gx * (v6 - v4) + fx * (v7 - v5))
        dz = gy * (gx * (v4 - v0) + fx * (v5 - v1)) + fy * (gx * (v6 - v2) + fx * (v7 - v3))
        if zero <= points[p, 0] <= one:
            grad_points[p, 0] += scale * dx
        if zero <= points[p, 1] <= one:
            grad_points[p, 1] += scale * dy
        if zero <= points[p, 2] <= one:
            grad_points[p, 2] += scale * dz


@compiled
def _backward_table(
    share, shares, points, table, resolutions, dense, offsets, grad_out, grad_table
):
    num_features = table.shape[1]
    num_levels = len(resolutions)
    # Levels are dealt in turn, because fine levels cost more than coarse ones.
    for level in range(share, num_levels, shares):
        scatter_level(
            points,
            table,
            resolutions[level],
            dense[level],
            offsets[level],
            offsets[level + 1],
            grad_out,
            level * num_features,
            grad_table,
        )


@compiled
def _backward_points(
    share, shares, points, table, resolutions, dense, offsets, grad_out, grad_points
):
    num_features = table.shape[1]
    num_points = len(points)
    for tile in range(share, (num_points + TILE - 1) // TILE, shares):
        begin, end = tile * TILE, min((tile + 1) * TILE, num_points)
        for level in range(len(resolutions)):
            differentiate_level(
                points[begin:end],
                table,
                resolutions[level],
                dense[level],
                offsets[level],
                offsets[level + 1],
                grad_out[begin:end],
                level * num_features,
                grad_points[begin:end],
            )


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
    ) -> Tensor:
        out = torch.empty(len(points), len(resolutions) * table.shape[1])
        arrays = _arrays(points, table, resolutions, dense, offsets)
        run_threads(_forward, *arrays, out.numpy())
        ctx.save_for_backward(points, table, resolutions, dense, offsets)
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        points, table, *levels = ctx.saved_tensors
        arrays = _arrays(points, table, *levels)
        grad_out = grad_outputs[0].contiguous().numpy()
        grad_points = grad_table = None
        if ctx.needs_input_grad[0]:
            grad_points = torch.zeros_like(points)
            run_threads(_backward_points, *arrays, grad_out, grad_points.numpy())
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(table)
            run_threads(_backward_table, *arrays, grad_out, grad_table.numpy())
        return grad_points, grad_table, None, None, None


def _arrays(*tensors: Tensor) -> tuple[Any, ...]:
    """The memory of CPU tensors as numpy arrays; nothing is copied where it is contiguous."""
    return tuple(tensor.detach().contiguous().numpy() for tensor in tensors)


def hash_encode_fast(
    points: Tensor, table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
) -> Tensor:
    """As `encodings.hash_encode`, for float32 tables on the CPU; differentiable once.

    points: [..., 3] in [0, 1]. Returns [..., L * F] float32.
    Raises ValueError for a table that is not float32 on the CPU.
    """
    if table.dtype != torch.float32 or table.device.type != "cpu":
        raise ValueError(
            f"the compiled hash grid needs a float32 table on the CPU, got {table.dtype} on "
            f"{table.device}: use engine 'plain'"
        )
    flat = points.reshape(-1, 3).to(torch.float32).contiguous()
    encoded: Tensor = _HashEncode.apply(flat, table, resolutions, dense, offsets)  # type: ignore[no-untyped-call]
    return encoded.reshape(*points.shape[:-1], encoded.shape[-1])
