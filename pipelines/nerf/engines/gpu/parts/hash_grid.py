"""Triton twin of `encodings.hash_encode`, differentiable once: the host's side of `hash_kernels`.

Symbols as in `encodings`: L levels, F features per entry, E entries, P points.

Nothing here runs at import. Without a GPU the kernels run in Triton's interpreter, where
TRITON_INTERPRET=1 was set before triton was imported; that is how they are tested.
"""

# Triton's launches carry no types.
# mypy: disable-error-code="no-untyped-call"

from __future__ import annotations

from typing import Any

import torch
import triton
from torch import Tensor

from pipelines.nerf.engines.gpu.parts.hash_kernels import (
    forward_kernel,
    point_gradient_kernel,
    table_gradient_kernel,
)
from pipelines.nerf.errors import NerfError

POINTS_PER_PROGRAM = 256
NUM_WARPS = 4
"""Two points a thread: 16 reads under way at once with 32 to 72 registers, no spills, and at least
0.4 of a processor's threads resident on every GPU from sm_75 to sm_120."""
MAX_FEATURES = 8


def _in_pairs(values: Tensor, paired: bool) -> tuple[Tensor, bool]:
    """(values [..., N] as the kernels read them, whether they are float16).

    paired: two neighbours are one integer, int64 of float32 and int32 of float16.
    """
    is_half = values.dtype == torch.float16
    if paired:
        wide = torch.int32 if is_half else torch.int64
        if values.data_ptr() % wide.itemsize:
            values = values.clone()  # a slice that begins between two pairs
        values = values.view(wide)
    return values, is_half


def _is_paired(table: Tensor) -> bool:
    return table.shape[1] % 2 == 0 and table.dtype == torch.float32


class _HashEncode(torch.autograd.Function):
    """points [P, 3], table [E, F], the table that is read, the three arrays of the layout, and the
    type of the features."""

    @staticmethod
    def forward(
        ctx: Any,
        points: Tensor,
        table: Tensor,
        lookup: Tensor,
        resolutions: Tensor,
        dense: Tensor,
        offsets: Tensor,
        dtype: torch.dtype,
    ) -> Tensor:
        num_points, num_levels, num_features = len(points), len(resolutions), table.shape[1]
        encoded = points.new_empty(num_points, num_levels * num_features, dtype=dtype)
        ctx.save_for_backward(points, table, lookup, resolutions, dense, offsets)
        if num_points == 0:
            return encoded
        read, is_half = _in_pairs(lookup, _is_paired(table))
        forward_kernel[(triton.cdiv(num_points, POINTS_PER_PROGRAM), num_levels)](
            points,
            read,
            resolutions,
            dense,
            offsets,
            encoded,
            num_points,
            num_levels,
            F=num_features,
            IS_PAIRED=_is_paired(table),
            IS_HALF=is_half,
            B=POINTS_PER_PROGRAM,
            num_warps=NUM_WARPS,
        )
        return encoded

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, *gradients: Tensor) -> tuple[Tensor | None, ...]:
        points, table, lookup, resolutions, dense, offsets = ctx.saved_tensors
        is_paired, num_levels = _is_paired(table), len(resolutions)
        gradient, is_half_gradient = _in_pairs(gradients[0].contiguous(), is_paired)
        num_programs = triton.cdiv(len(points), POINTS_PER_PROGRAM)
        point_gradient, table_gradient = None, None
        if ctx.needs_input_grad[0]:
            point_gradient = torch.empty_like(points)
            if num_programs:
                read, is_half = _in_pairs(lookup, is_paired)
                point_gradient_kernel[(num_programs,)](
                    points,
                    read,
                    gradient,
                    resolutions,
                    dense,
                    offsets,
                    point_gradient,
                    len(points),
                    L=num_levels,
                    F=table.shape[1],
                    IS_PAIRED=is_paired,
                    IS_HALF=is_half,
                    IS_HALF_GRADIENT=is_half_gradient,
                    B=POINTS_PER_PROGRAM,
                    num_warps=NUM_WARPS,
                )
        if ctx.needs_input_grad[1]:
            table_gradient = torch.zeros_like(table)
            if num_programs:
                table_gradient_kernel[(num_programs, num_levels)](
                    points,
                    gradient,
                    resolutions,
                    dense,
                    offsets,
                    table_gradient,
                    len(points),
                    num_levels,
                    F=table.shape[1],
                    IS_PAIRED=is_paired,
                    IS_HALF_GRADIENT=is_half_gradient,
                    B=POINTS_PER_PROGRAM,
                    num_warps=NUM_WARPS,
                )
        return point_gradient, table_gradient, None, None, None, None, None


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
    Returns [..., L * F], coarsest level first, of the table's type; within an autocast to float16
    float16 at once, to which the network behind would round them anyway.
    Raises NerfError `bad_config` where a shape or type is another.
    """
    read = table if lookup is None else lookup
    _check(points, table, read)
    flat = points.reshape(-1, 3).to(table.dtype).contiguous()
    dtype = _feature_type(table)
    encoded: Tensor = _HashEncode.apply(flat, table, read, resolutions, dense, offsets, dtype)
    return encoded.reshape(*points.shape[:-1], encoded.shape[-1])


def _feature_type(table: Tensor) -> torch.dtype:
    kind = table.device.type
    if not torch.is_autocast_enabled(kind) or table.dtype != torch.float32:
        return table.dtype
    wanted = torch.get_autocast_dtype(kind)
    return wanted if wanted == torch.float16 else table.dtype


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
