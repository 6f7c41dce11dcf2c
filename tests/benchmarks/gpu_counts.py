"""Bytes and operations of a training step and of a rendered ray, counted from the shapes.

What the bound of a device is worth: the least traffic that the chosen kernels need, with every
tensor between two kernels written once and read once. Symbols: R rays, S samples, P = R S points,
L levels, F features. Counted apart: `hbm_bytes` of tensors too large for the cache, `sectors` of
32 bytes that scattered reads and additions of a hash grid ask of the L2 cache (the two corners
along x lie in one sector, as a rule: four a level and point), `flops` of matrix products.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from pipelines.nerf.config import HashGridConfig, NerfactoConfig
from pipelines.nerf.encodings import level_layout

SECTOR = 32
SECTORS_PER_LEVEL = 4
FLOAT, HALF = 4, 2
ADAM_PASSES = 10
"""The gradient is set to zero (1 write), checked and written back (2); Adam reads it with parameter
and moments (4) and writes the latter three back (3)."""
PER_SAMPLE_PASSES = 24
"""float32 values per sample that weights, resampling, positions and losses move, forward; the
backward pass moves about as many. Plain PyTorch, one kernel per operation."""


@dataclass(frozen=True)
class Device:
    """What a device can do at best, as its maker states it: bytes/s and dense float16 flop/s."""

    name: str
    hbm_bytes_per_s: float
    half_flops_per_s: float


DEVICES = (
    Device("H200", 4.8e12, 989e12),
    Device("H100", 3.35e12, 989e12),
    Device("A100", 2.04e12, 312e12),
    Device("RTX 4090", 1.008e12, 165e12),
    Device("L4", 0.3e12, 121e12),
    Device("T4", 0.32e12, 65e12),
)


@dataclass(frozen=True)
class Work:
    """What one phase needs."""

    phase: str
    hbm_bytes: float
    sectors: float
    flops: float

    def bound_s(self, device: Device, l2_bytes_per_s: float | None = None) -> float:
        """The least time on a device: memory, cache and matrix units work side by side.

        l2_bytes_per_s: rate of the L2 cache for scattered sectors, which makers do not state.
        """
        bounds = [self.hbm_bytes / device.hbm_bytes_per_s, self.flops / device.half_flops_per_s]
        if l2_bytes_per_s is not None:
            bounds.append(SECTOR * self.sectors / l2_bytes_per_s)
        return max(bounds)


def known_device(name: str) -> Device | None:
    """The device whose name occurs in the one that the driver gives."""
    return next((device for device in DEVICES if device.name in name), None)


def mlp_flops(points: int, widths: Sequence[int]) -> float:
    """Two per weight and point."""
    return 2.0 * points * sum(a * b for a, b in pairwise(widths))


def mlp_bytes(points: int, widths: Sequence[int], *, fused: bool) -> float:
    """Half-precision inputs and outputs of the whole, or, layer by layer, of every layer."""
    ends = widths[0] + widths[-1]
    return HALF * points * float(ends if fused else ends + 4 * sum(widths[1:-1]))


def grid_work(phase: str, points: int, grid: HashGridConfig, *, directions: int) -> Work:
    """One pass over a grid: points read once a level, features moved, corners asked for.

    directions: 1 forward, 2 for both gradients, of which each asks for the corners again.
    """
    width = grid.num_levels * grid.features_per_level
    moved = points * FLOAT * (3.0 + width) * directions
    sectors = float(points * grid.num_levels * SECTORS_PER_LEVEL * directions)
    return Work(phase, moved, sectors, 0.0)


def grid_entries(grid: HashGridConfig) -> int:
    """Features of a whole table."""
    return level_layout(grid).offsets[-1] * grid.features_per_level


def mlp_widths(config: NerfactoConfig) -> tuple[tuple[int, ...], tuple[int, ...]]:
    """(density, colour): inputs, hidden layers and outputs of the field's networks."""
    features = config.grid.num_levels * config.grid.features_per_level
    density = (features, config.hidden_dim, 1 + config.geo_feature_dim)
    inputs = 16 + config.geo_feature_dim + config.appearance_dim
    return density, (inputs, config.hidden_dim_color, config.hidden_dim_color, 3)


def forward_work(config: NerfactoConfig, rays: int, *, fused: bool) -> list[Work]:
    """Proposals, field and everything per sample, forward."""
    works = []
    proposal_points = 0
    for index, count in enumerate(config.num_proposal_samples):
        proposal = config.proposals[0 if config.share_proposal_network else index]
        points = rays * count
        proposal_points += points
        width = proposal.grid.num_levels * proposal.grid.features_per_level
        widths = (width, proposal.hidden_dim, 1)
        works.append(grid_work(f"proposal grid {index + 1}", points, proposal.grid, directions=1))
        works.append(_mlp(f"proposal network {index + 1}", points, (widths,), fused=fused))
    points = rays * config.num_nerf_samples
    works.append(grid_work("field grid", points, config.grid, directions=1))
    works.append(_mlp("field networks", points, mlp_widths(config), fused=fused))
    per_sample = float(FLOAT * PER_SAMPLE_PASSES * (proposal_points + points))
    works.append(Work("per-sample operations", per_sample, 0.0, 0.0))
    return works


def step_work(
    config: NerfactoConfig, rays: int, *, update_proposals: bool, fused: bool = False
) -> list[Work]:
    """A whole training step, by phase.

    update_proposals: whether the proposal networks learn in it. fused: the networks' hidden layers
    stay on the chip.
    """
    forward = forward_work(config, rays, fused=fused)
    works = list(forward)
    entries = float(grid_entries(config.grid))
    for work in forward:
        if work.phase.startswith("proposal") and not update_proposals:
            continue
        # Backward: inputs and gradients are read, gradients written; products for inputs and
        # weights. A proposal's grid has a gradient for its table alone.
        factor = 1.0 if work.phase.startswith("proposal grid") else 2.0
        works.append(
            Work(
                f"{work.phase}, backward",
                factor * work.hbm_bytes,
                factor * work.sectors,
                2.0 * work.flops,
            )
        )
    if update_proposals:
        networks = 1 if config.share_proposal_network else len(config.num_proposal_samples)
        entries += sum(grid_entries(proposal.grid) for proposal in config.proposals[:networks])
    works.append(Work("gradients and Adam", FLOAT * ADAM_PASSES * entries, 0.0, 0.0))
    return works


def total(works: Sequence[Work], phase: str = "step") -> Work:
    """All phases together, one after another."""
    return Work(
        phase,
        sum(work.hbm_bytes for work in works),
        sum(work.sectors for work in works),
        sum(work.flops for work in works),
    )


def _mlp(phase: str, points: int, networks: Sequence[Sequence[int]], *, fused: bool) -> Work:
    moved = sum(mlp_bytes(points, widths, fused=fused) for widths in networks)
    return Work(phase, moved, 0.0, sum(mlp_flops(points, widths) for widths in networks))
