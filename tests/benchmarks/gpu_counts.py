"""Bytes and operations of a training step and of a rendered ray, counted from the shapes.

What the bound of a device is worth: the least traffic that the chosen kernels need, with every
tensor between two kernels written once and read once. Symbols: R rays, S samples, P = R S points,
L levels, F features. Counted apart: `hbm_bytes` of tensors too large for the cache, `sectors` of
32 bytes that scattered reads and additions of a hash grid ask of the L2 cache, `flops` of matrix
products. What a grid's kernels do for a level and point is read off their machine code, which
`tests/unit/pipelines/nerf/engines/gpu/test_compile.py` pins: eight loads of two features, and eight
additions of two features on GPUs that have those (sm_90 on), sixteen of one elsewhere.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

from pipelines.nerf.options.methods.nerfacto import NerfactoConfig, ProposalConfig
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.hash_levels import level_layout

SECTOR = 32
CORNERS = 8
FLOAT, HALF = 4, 2
PAIRED_ADDITIONS_FROM = 90
"""The architecture from which one addition takes two neighbouring float32."""
ADAM_PASSES = 11
"""The gradient is set to zero (1 write), checked and written back (2); Adam reads it with parameter
and moments (4), and writes these and, divided by the loss scale, the gradient (4)."""
PER_SAMPLE_PASSES = 24
"""float32 values per sample that weights, resampling, positions and losses move, forward; the
backward pass moves about as many. Plain PyTorch, one kernel per operation."""


@dataclass(frozen=True)
class Device:
    """What a device can do at best, as its maker states it: bytes/s and dense float16 flop/s.

    arch: its compute capability, 90 for 9.0.
    """

    name: str
    hbm_bytes_per_s: float
    half_flops_per_s: float
    arch: int = PAIRED_ADDITIONS_FROM


DEVICES = (
    Device("H200", 4.8e12, 989e12),
    Device("H100", 3.35e12, 989e12),
    Device("A100", 2.04e12, 312e12, 80),
    Device("RTX 4090", 1.008e12, 165e12, 89),
    Device("L4", 0.3e12, 121e12, 89),
    Device("T4", 0.32e12, 65e12, 75),
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


def read_sectors(features: int, entry_bytes: int) -> float:
    """Sectors that the reads of eight corners ask of L2, for one level and point.

    The corners along x are neighbours, on hashed levels nearly as often as on dense ones (x and
    x + 1 differ in their lowest bits alone, and the hash leaves these together): a second sector is
    needed where the first corner is the last entry of its own, one time in (sector / entry).
    """
    return CORNERS / 2 * (1.0 + min(1.0, features * entry_bytes / SECTOR))


def added_sectors(features: int, arch: int) -> float:
    """Sectors that the additions to eight corners ask of L2, which does them one by one."""
    at_once = 2 if arch >= PAIRED_ADDITIONS_FROM and features % 2 == 0 else 1
    return float(CORNERS * features // at_once)


def grid_forward(phase: str, points: int, grid: HashGridConfig) -> Work:
    """Points read once, float16 features written, corners asked for."""
    features = grid.features_per_level
    moved = points * (3.0 * FLOAT + HALF * grid.num_levels * features)
    return Work(phase, moved, points * grid.num_levels * read_sectors(features, FLOAT), 0.0)


def grid_backward(
    phase: str, points: int, grid: HashGridConfig, *, to_points: bool, arch: int
) -> Work:
    """Points and float16 gradients read, the table's additions; and the same again with reads of
    the corners for the gradient of the points, where it is wanted."""
    features, num_levels = grid.features_per_level, grid.num_levels
    moved = points * (3.0 * FLOAT + HALF * num_levels * features)
    sectors = added_sectors(features, arch)
    if to_points:
        moved += moved + points * 3.0 * FLOAT
        sectors += read_sectors(features, FLOAT)
    return Work(phase, moved, points * num_levels * sectors, 0.0)


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
        proposal = _proposal(config, index)
        points = rays * count
        proposal_points += points
        width = proposal.grid.num_levels * proposal.grid.features_per_level
        widths = (width, proposal.hidden_dim, 1)
        works.append(grid_forward(f"proposal grid {index + 1}", points, proposal.grid))
        works.append(_mlp(f"proposal network {index + 1}", points, (widths,), fused=fused))
    points = rays * config.num_nerf_samples
    works.append(grid_forward("field grid", points, config.grid))
    works.append(_mlp("field networks", points, mlp_widths(config), fused=fused))
    per_sample = float(FLOAT * PER_SAMPLE_PASSES * (proposal_points + points))
    works.append(Work("per-sample operations", per_sample, 0.0, 0.0))
    return works


def step_work(
    config: NerfactoConfig,
    rays: int,
    *,
    update_proposals: bool,
    fused: bool = False,
    arch: int = PAIRED_ADDITIONS_FROM,
) -> list[Work]:
    """A whole training step, by phase.

    update_proposals: whether the proposal networks learn in it. fused: the networks' hidden layers
    stay on the chip. arch: compute capability, for how many features an addition takes.
    """
    works = forward_work(config, rays, fused=fused)
    entries = float(grid_entries(config.grid))
    moves_cameras = config.camera_mode != "off"
    for work in list(works):
        if work.phase.startswith("proposal") and not update_proposals:
            continue
        phase = f"{work.phase}, backward"
        if work.phase.startswith("proposal grid"):
            index = int(work.phase.split()[-1]) - 1
            points, grid = rays * config.num_proposal_samples[index], _proposal(config, index).grid
            # Where the proposals' samples lie passes no gradient to the cameras.
            works.append(grid_backward(phase, points, grid, to_points=False, arch=arch))
        elif work.phase == "field grid":
            points, grid = rays * config.num_nerf_samples, config.grid
            works.append(grid_backward(phase, points, grid, to_points=moves_cameras, arch=arch))
        else:
            # Inputs and gradients are read, gradients written; products for inputs and weights.
            works.append(Work(phase, 2.0 * work.hbm_bytes, 0.0, 2.0 * work.flops))
    if update_proposals:
        networks = 1 if config.share_proposal_network else len(config.num_proposal_samples)
        entries += sum(grid_entries(proposal.grid) for proposal in config.proposals[:networks])
    works.append(Work("gradients and Adam", FLOAT * ADAM_PASSES * entries, 0.0, 0.0))
    return works


def _proposal(config: NerfactoConfig, index: int) -> ProposalConfig:
    """The network of a round."""
    return config.proposals[0 if config.share_proposal_network else index]


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
