"""Counted bytes and operations of a step, against numbers worked out by hand."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
import torch

from pipelines.nerf.config import HashGridConfig, NerfactoConfig
from tests.benchmarks.gpu_counts import (
    Device,
    Work,
    forward_work,
    grid_entries,
    grid_work,
    known_device,
    mlp_bytes,
    mlp_flops,
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


def test_a_grid_asks_for_four_sectors_a_level_and_point() -> None:
    grid = HashGridConfig(num_levels=5, min_res=16, max_res=128, log2_table_size=17)
    work = grid_work("grid", 7, grid, directions=1)
    assert work.sectors == 7 * 5 * 4
    assert work.hbm_bytes == 7 * 4 * (3 + 10)


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


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU, so it would measure")
def test_without_a_gpu_the_benchmark_says_so_and_fails() -> None:
    command = [sys.executable, "-m", "tests.benchmarks.gpu_speed"]
    answer = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert answer.returncode == 2, answer.stderr
    assert "no CUDA GPU" in answer.stdout
