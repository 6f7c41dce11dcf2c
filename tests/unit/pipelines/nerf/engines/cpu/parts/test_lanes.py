"""Vector exponentials against numpy in float64, the vector hash grid against its plain twin."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.nerf.engines.cpu.parts.dense_layers import TILE
from pipelines.nerf.engines.cpu.parts.hash_lanes import (
    PLACE_ROWS,
    encode_columns,
    pack_grid,
    scatter_columns,
)
from pipelines.nerf.engines.cpu.parts.lanes import exp_all, expm1_all
from pipelines.nerf.networks.encodings import HashGrid
from pipelines.nerf.options.parts import HashGridConfig

TINY = float(np.finfo(np.float32).tiny)
GRIDS = [
    HashGridConfig(num_levels=5, max_res=100, log2_table_size=12),
    HashGridConfig(num_levels=2, min_res=3, max_res=65535, log2_table_size=16),
]


def test_exp_is_right_to_two_roundings_from_nothing_to_infinity() -> None:
    x = np.linspace(-104.0, 88.7, 1 << 16, dtype=np.float32)
    found, truth = np.empty_like(x), np.exp(x.astype(np.float64))
    exp_all(x, len(x), found)
    normal = truth > TINY
    assert (np.abs(found - truth)[normal] < 1.6e-7 * truth[normal]).all()
    assert (np.abs(found - truth)[~normal] < 3e-45).all()


def test_expm1_does_not_cancel_near_zero() -> None:
    x = -np.geomspace(1e-30, 100.0, 1 << 16).astype(np.float32)
    found, truth = np.empty_like(x), np.expm1(x.astype(np.float64))
    expm1_all(x, len(x), found)
    assert (np.abs(found - truth) < 2.5e-7 * np.abs(truth)).all()


def test_exponentials_keep_the_special_numbers() -> None:
    x = np.array([np.nan, -np.inf, np.inf, 0.0] * 4, np.float32)
    found = np.empty_like(x)
    exp_all(x, len(x), found)
    np.testing.assert_array_equal(found[:4], np.array([np.nan, 0.0, np.inf, 1.0], np.float32))
    expm1_all(x, len(x), found)
    assert np.isnan(found[0])
    assert found[1] == -1.0
    assert found[3] == 0.0


@pytest.mark.parametrize("config", GRIDS, ids=["dense and hashed", "fine"])
@pytest.mark.parametrize("count", [TILE, 17, 1])
def test_features_and_their_gradient_equal_the_plain_ones(
    config: HashGridConfig, count: int
) -> None:
    torch.manual_seed(0)
    grid = HashGrid(config)
    grid.table.data.normal_()
    begin = 32
    points = torch.rand(TILE + begin, 3) * 1.2 - 0.1  # some lie outside and are moved to a face
    points[begin : begin + 2] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    points[begin + 40 : begin + 60] = points[begin + 40]  # a run in one cell
    columns = np.ascontiguousarray(points.numpy().T)
    arrays = pack_grid(grid.table, grid.resolutions, grid.dense, grid.offsets)
    out = np.zeros((grid.num_outputs, TILE), np.float32)
    encode_columns(columns, begin, count, arrays, out)
    plain = grid(points[begin : begin + count])
    assert np.abs(out[:, :count].T - plain.detach().numpy()).max() < 5e-6

    upstream = torch.randn(grid.num_outputs, TILE)
    (expected,) = torch.autograd.grad(plain, grid.table, upstream[:, :count].T)
    found = np.zeros(tuple(grid.table.shape), np.float32)
    places = np.zeros((PLACE_ROWS, TILE), np.float32)
    scatter_columns(columns, begin, count, arrays, upstream.numpy(), places, found)
    assert np.abs(found - expected.numpy()).max() < 2e-5


def test_points_that_are_not_numbers_read_nothing_beyond_the_table() -> None:
    grid = HashGrid(GRIDS[0])
    columns = np.full((3, TILE), np.nan, np.float32)
    columns[1:, :4] = np.inf
    columns[:, 16:] = 0.5
    arrays = pack_grid(grid.table, grid.resolutions, grid.dense, grid.offsets)
    out = np.zeros((grid.num_outputs, TILE), np.float32)
    encode_columns(columns, 0, TILE, arrays, out)
    assert np.isnan(out[:, :16]).all()
    assert np.isfinite(out[:, 16:]).all()
