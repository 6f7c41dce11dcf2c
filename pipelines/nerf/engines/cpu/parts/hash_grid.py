"""The hash grid for any points on the CPU: `encodings.hash_encode` by the kernels of `hash_lanes`.

Forward, and backward to the table and to the points, for two features per entry. Symbols as in
`encodings`: L levels, P points. Sums are taken in another order than in the plain definition, so
values agree to float32 rounding. Backward gives a level to one thread, so that no two threads write
the same entry and results repeat.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from typing import Any

import numpy as np
import torch
from torch import Tensor

from pipelines.nerf.engines.cpu.parts.dense_layers import TILE
from pipelines.nerf.engines.cpu.parts.hash_lanes import (
    NUM_FEATURES,
    PLACE_ROWS,
    encode_columns,
    one_level,
    pack_grid,
    scatter_columns,
)
from pipelines.nerf.engines.cpu.parts.hash_slopes import encode_slopes
from pipelines.nerf.engines.cpu.parts.runtime import compiled, merged, run_threads


@merged
def _load_rows(values, begin, first, out):
    """out[k, c] = values[begin + c, first + k] as far as there are rows; returns how many."""
    count = min(TILE, len(values) - begin)
    for c in range(count):
        for k in range(len(out)):
            out[k, c] = values[begin + c, first + k]
    return count


@compiled
def _forward(share, shares, points, grid, out):
    """out [P, L * 2] at points [P, 3]; tile after tile."""
    columns = np.zeros((3, TILE), np.float32)
    features = np.zeros((out.shape[1], TILE), np.float32)
    for begin in range(share * TILE, len(points), shares * TILE):
        count = _load_rows(points, begin, 0, columns)
        encode_columns(columns, 0, count, grid, features)
        for c in range(count):
            for row in range(len(features)):
                out[begin + c, row] = features[row, c]


@compiled
def _backward_table(share, shares, points, grid, grad_out, grad_table):
    """Add to grad_table [E, 2] what comes back for features [P, L * 2]; a level per turn."""
    columns = np.zeros((3, TILE), np.float32)
    upstream = np.zeros((NUM_FEATURES, TILE), np.float32)
    places = np.zeros((PLACE_ROWS, TILE), np.float32)
    # Levels are dealt in turn, because fine levels cost more than coarse ones.
    for level in range(share, len(grid.resolutions), shares):
        alone = one_level(grid, level)
        for begin in range(0, len(points), TILE):
            count = _load_rows(points, begin, 0, columns)
            _load_rows(grad_out, begin, NUM_FEATURES * level, upstream)
            scatter_columns(columns, 0, count, alone, upstream, places, grad_table)


@compiled
def _backward_points(share, shares, points, grid, grad_out, grad_points):
    """grad_points [P, 3]: zeros that become what comes back for features [P, L * 2]."""
    columns = np.zeros((3, TILE), np.float32)
    features = np.zeros((NUM_FEATURES, TILE), np.float32)
    slopes = np.zeros((3 * NUM_FEATURES, TILE), np.float32)
    low, high = np.float32(0.0), np.float32(1.0)
    for begin in range(share * TILE, len(points), shares * TILE):
        count = _load_rows(points, begin, 0, columns)
        for level in range(len(grid.resolutions)):
            encode_slopes(grid, level, columns, count, features, slopes)
            first = NUM_FEATURES * level
            for c in range(count):
                one, other = grad_out[begin + c, first], grad_out[begin + c, first + 1]
                for axis in range(3):
                    # What lies outside was moved to the nearest face and does not follow its point.
                    if low <= columns[axis, c] <= high:
                        slope = one * slopes[axis, c] + other * slopes[3 + axis, c]
                        grad_points[begin + c, axis] += slope


class _HashEncode(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, points: Tensor, table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
    ) -> Tensor:
        out = torch.empty(len(points), len(resolutions) * NUM_FEATURES)
        grid = pack_grid(table, resolutions, dense, offsets)
        run_threads(_forward, points.detach().numpy(), grid, out.numpy())
        ctx.save_for_backward(points, table, resolutions, dense, offsets)
        return out

    @staticmethod
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        points, table, *levels = ctx.saved_tensors
        shared = points.detach().numpy(), pack_grid(table, *levels)
        upstream = grad_outputs[0].detach().contiguous().numpy()
        grad_points = grad_table = None
        if ctx.needs_input_grad[0]:
            grad_points = torch.zeros_like(points)
            run_threads(_backward_points, *shared, upstream, grad_points.numpy())
        if ctx.needs_input_grad[1]:
            grad_table = torch.zeros_like(table, memory_format=torch.contiguous_format)
            run_threads(_backward_table, *shared, upstream, grad_table.numpy())
        return grad_points, grad_table, None, None, None


def hash_encode_fast(
    points: Tensor, table: Tensor, resolutions: Tensor, dense: Tensor, offsets: Tensor
) -> Tensor:
    """As `encodings.hash_encode`, for float32 tables [E, 2] on the CPU; differentiable once.

    points: [..., 3] in [0, 1]. Returns [..., L * 2] float32. Raises ValueError for another table.
    """
    if table.dtype != torch.float32 or table.device.type != "cpu":
        raise ValueError(
            f"the compiled hash grid needs a float32 table on the CPU, got {table.dtype} on "
            f"{table.device}: use engine 'plain'"
        )
    if table.shape[1] != NUM_FEATURES:
        raise ValueError(
            f"the compiled hash grid needs {NUM_FEATURES} features per entry, got "
            f"{table.shape[1]}: use engine 'plain'"
        )
    flat = points.reshape(-1, 3).to(torch.float32).contiguous()
    encoded: Tensor = _HashEncode.apply(flat, table, resolutions, dense, offsets)  # type: ignore[no-untyped-call]
    return encoded.reshape(*points.shape[:-1], encoded.shape[-1])
