"""Counted bytes and operations of a step, against numbers worked out by hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pipelines.nerf.options.methods.nerfacto import NerfactoConfig
from pipelines.nerf.options.parts import HashGridConfig
from tests.benchmarks.gpu_counts import (
    SECTOR,
    Device,
    Work,
    added_sectors,
    forward_work,
    grid_backward,
    grid_entries,
    grid_forward,
    known_device,
    mlp_bytes,
    mlp_flops,
    read_sectors,
    step_work,
    total,
)

ROOT = Path(__file__).resolve().parents[3]
SLOW = Device("slow", hbm_bytes_per_s=100.0, half_flops_per_s=10.0)


def test_operations_of_a_network_are_two_per_weight_and_point() -> None:
    assert mlp_flops(3, (10, 16, 1)) == 2 * 3 * (160 + 16)


def test_a_fused_network_moves_its_ends_alone() -> None:
    assert mlp_bytes(5, (32, 64, 16), fused=True) == 2 * 5 * (32 + 16)
    # Written before and behind ReLU, read as often.
    assert mlp_bytes(5, (32, 64, 16), fused=False) == 2 * 5 * (32 + 4 * 64 + 16)


GRID = HashGridConfig(num_levels=5, min_res=16, max_res=128, log2_table_size=17)


def test_reads_of_corners_share_sectors_along_x() -> None:
    """Counted: for every start x of a pair of neighbours, the sectors that hold both."""
    entries = SECTOR // 8  # two float32 each
    sectors = [len({x // entries, (x + 1) // entries}) for x in range(64)]
    assert read_sectors(2, 4) == pytest.approx(4 * sum(sectors) / 64)
    # A hashed level: the other axes change which entries these are, not how far they are apart.
    mask, other = (1 << 12) - 1, 2654435761 * 77 ^ 805459861 * 13
    hashed = [
        len({((x ^ other) & mask) // entries, (((x + 1) ^ other) & mask) // entries})
        for x in range(64)
    ]
    assert read_sectors(2, 4) == pytest.approx(4 * sum(hashed) / 64)


def test_additions_take_two_features_where_the_gpu_can() -> None:
    assert added_sectors(2, 90) == 8
    assert added_sectors(2, 80) == 16
    assert added_sectors(3, 90) == 24


def test_a_grid_moves_its_points_and_features_once_each_way() -> None:
    forward = grid_forward("grid", 7, GRID)
    assert forward.sectors == 7 * 5 * read_sectors(2, 4)
    assert forward.hbm_bytes == 7 * (3 * 4 + 10 * 2)
    table = grid_backward("grid", 7, GRID, to_points=False, arch=90)
    assert table.sectors == 7 * 5 * 8
    assert table.hbm_bytes == forward.hbm_bytes
    both = grid_backward("grid", 7, GRID, to_points=True, arch=90)
    assert both.sectors == table.sectors + forward.sectors
    assert both.hbm_bytes == 2 * table.hbm_bytes + 7 * 3 * 4


def test_entries_count_dense_levels_by_their_vertices() -> None:
    grid = HashGridConfig(num_levels=2, min_res=2, max_res=100, log2_table_size=8)
    assert grid_entries(grid) == 2 * (27 + 256)


def test_bounds_are_the_slowest_of_memory_cache_and_products() -> None:
    assert Work("", hbm_bytes=200.0, sectors=0.0, flops=10.0).bound_s(SLOW) == 2.0
    assert Work("", hbm_bytes=200.0, sectors=0.0, flops=50.0).bound_s(SLOW) == 5.0
    assert Work("", hbm_bytes=200.0, sectors=1.0, flops=0.0).bound_s(SLOW, 4.0) == 8.0


def test_paper_step_has_the_products_of_its_samples() -> None:
    model = NerfactoConfig()
    field = 32 * 64 + 64 * 16 + 63 * 64 + 64 * 64 + 64 * 3
    proposals = (256 + 96) * (10 * 16 + 16)
    flops = 2 * 4096 * (48 * field + proposals)
    assert total(forward_work(model, 4096, fused=False)).flops == flops
    assert total(step_work(model, 4096, update_proposals=True)).flops == 3 * flops
    skipped = total(step_work(model, 4096, update_proposals=False)).flops
    assert skipped == 3 * flops - 2 * 2 * 4096 * proposals


def test_devices_are_known_by_the_names_that_drivers_give() -> None:
    found = known_device("NVIDIA H200")
    assert found is not None
    assert found.hbm_bytes_per_s == 4.8e12
    assert known_device("Radeon") is None


@pytest.mark.skipif(
    torch.cuda.is_available(),
    reason="what it says without a GPU is NOT tested: there is one, so it would measure",
)
def test_without_a_gpu_the_benchmark_says_so_and_fails() -> None:
    command = [sys.executable, "-m", "tests.benchmarks.gpu_speed"]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 2, answer.stderr
    assert "no CUDA GPU" in answer.stdout
