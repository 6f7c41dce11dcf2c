"""The interlevel loss and the resampling of a histogram, one ray at a time, for training.

Twins of `losses.interlevel_loss` and `intervals.sample_pdf`. Both walk along two sorted rows of
edges at once, where torch searches, gathers and copies. The other losses cost less than a
millisecond for 1,024 rays as they are. Symbols: R rays; final histogram (s, w) with S intervals; a
proposal's (s^, w^) with S^; C_k the sum of the first k of w^. Sums run in float64.
"""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from pipelines.nerf.along_ray.intervals import HISTOGRAM_PADDING
from pipelines.nerf.along_ray.losses import INTERLEVEL_EPS
from pipelines.nerf.engines.cpu.parts.intervals import resample
from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads


@compiled
def _interlevel(share, shares, edges, weights, proposal_edges, proposal_weights, losses, slopes):
    """losses [R] = sum over S of max(0, w - W)^2 / (w + 1e-7); slopes [R, S^] its slope in w^."""
    num_rays, count = weights.shape
    num_bins = proposal_weights.shape[1]
    sums = np.zeros(num_bins + 1, np.float64)
    pull = np.zeros(num_bins + 1, np.float64)  # dL / dC
    for ray in range(num_rays * share // shares, num_rays * (share + 1) // shares):
        bins = proposal_edges[ray]
        for k in range(num_bins):
            sums[k + 1] = sums[k] + proposal_weights[ray, k]
            pull[k + 1] = 0.0
        pull[0] = 0.0
        loss = 0.0
        first, end = 0, 0
        for i in range(count):
            # The last proposal edge not above the interval, and the first one above all of it.
            while first < num_bins - 1 and bins[first + 1] <= edges[ray, i]:
                first += 1
            while end < num_bins - 1 and bins[end + 1] <= edges[ray, i + 1]:
                end += 1
            weight = np.float64(weights[ray, i])
            excess = weight - (sums[end + 1] - sums[first])
            if not excess <= 0.0:  # a NaN is to show
                slope = excess / (weight + INTERLEVEL_EPS)
                loss += excess * slope
                pull[end + 1] -= 2.0 * slope
                pull[first] += 2.0 * slope
        losses[ray] = loss
        total = 0.0
        for k in range(num_bins - 1, -1, -1):
            total += pull[k + 1]
            slopes[ray, k] = total


class _InterlevelLoss(torch.autograd.Function):
    @staticmethod
    def forward(
        ctx: Any, proposal_weights: Tensor, edges: Tensor, weights: Tensor, proposal_edges: Tensor
    ) -> Tensor:
        losses = torch.zeros(len(weights), dtype=torch.float64)
        slopes = torch.empty_like(proposal_weights, memory_format=torch.contiguous_format)
        inputs = (edges, weights, proposal_edges, proposal_weights)
        arrays = (tensor.detach().contiguous().numpy() for tensor in inputs)
        run_threads(_interlevel, *arrays, losses.numpy(), slopes.numpy())
        ctx.save_for_backward(slopes)
        ctx.count = weights.numel()
        return (losses.sum() / weights.numel()).to(proposal_weights.dtype)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grad_outputs: Tensor) -> tuple[Tensor | None, ...]:
        (slopes,) = ctx.saved_tensors
        return slopes * (grad_outputs[0] / ctx.count), None, None, None


def interlevel_loss_fast(
    s_edges: Tensor, weights: Tensor, proposals: Sequence[tuple[Tensor, Tensor]]
) -> Tensor:
    """As `losses.interlevel_loss`, for float32 on the CPU; differentiable once.

    s_edges: [R, S + 1]; weights: [R, S], both taken as constants.
    proposals: (edges [R, S^ + 1], weights [R, S^]) of each round. Returns a scalar.
    """
    losses = [
        _InterlevelLoss.apply(found, s_edges, weights, edges)  # type: ignore[no-untyped-call]
        for edges, found in proposals
    ]
    return torch.stack(losses).sum()


@compiled
def _resample(share, shares, edges, weights, offsets, padding, new_edges):
    """new_edges [R, N + 1] of edges [R, S + 1], weights [R, S] and offsets [R, 1 or N + 1]."""
    num_rays, count = weights.shape
    num_new = new_edges.shape[1] - 1
    masses = np.zeros(num_new, np.float32)  # nobody asks for them
    for ray in range(num_rays * share // shares, num_rays * (share + 1) // shares):
        total = 0.0
        for i in range(count):
            total += weights[ray, i]
        resample(
            edges[ray],
            weights[ray],
            total,
            count,
            num_new,
            offsets[ray],
            padding,
            new_edges[ray],
            masses,
        )


def sample_pdf_fast(
    s_edges: Tensor,
    weights: Tensor,
    num_samples: int,
    *,
    jitter: Tensor | None = None,
    padding: float = HISTOGRAM_PADDING,
) -> Tensor:
    """As `intervals.sample_pdf`, for float32 on the CPU.

    s_edges: [R, S + 1], increasing. weights: [R, S], >= 0. jitter: [R, 1] or [R, N + 1] in [0, 1),
    or None. Returns [R, N + 1], increasing, within the old edges, without a gradient.
    """
    num_edges = num_samples + 1
    if jitter is None:
        jitter = torch.full((len(weights), 1), 0.5)
    new_edges = torch.empty(len(weights), num_edges)
    if new_edges.numel():
        inputs = (s_edges, weights, jitter)
        arrays = (tensor.detach().contiguous().numpy() for tensor in inputs)
        run_threads(_resample, *arrays, padding, new_edges.numpy())
    return new_edges
