"""The plain encodings against slow loops, closed forms and quadrature."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from pipelines.nerf.engines.hash_encoders import HASH_ENCODERS
from pipelines.nerf.networks.encodings import HashGrid, SphericalHarmonics
from pipelines.nerf.options.parts import HashGridConfig
from pipelines.nerf.space.harmonics import spherical_harmonics

SMALL = HashGridConfig(num_levels=4, min_res=3, max_res=24, log2_table_size=8, features_per_level=2)


def slow_hash_encode(point: list[float], grid: HashGrid) -> list[float]:
    """One point, corner by corner, in Python numbers with true uint32 arithmetic."""
    config, features = grid.config, []
    size, first = 2**config.log2_table_size, 0
    growth = (config.max_res / config.min_res) ** (1.0 / (config.num_levels - 1))
    for level in range(config.num_levels):
        cells = math.floor(config.min_res * growth**level + 1e-6)
        is_dense = (cells + 1) ** 3 <= size
        position = [min(max(value, 0.0), 1.0) * cells for value in point]
        low = [min(int(value), cells - 1) for value in position]
        total = [0.0] * config.features_per_level
        for corner in np.ndindex(2, 2, 2):
            x, y, z = (low[axis] + corner[axis] for axis in range(3))
            weight = 1.0
            for axis in range(3):
                part = position[axis] - low[axis]
                weight *= part if corner[axis] else 1.0 - part
            if is_dense:
                entry = x + (cells + 1) * (y + (cells + 1) * z)
            else:
                entry = (x ^ (2654435761 * y % 2**32) ^ (805459861 * z % 2**32)) % size
            for f in range(config.features_per_level):
                total[f] += weight * float(grid.table.detach()[first + entry, f])
        first += (cells + 1) ** 3 if is_dense else size
        features += total
    assert first == len(grid.table)
    return features


@pytest.fixture
def grid() -> HashGrid:
    torch.manual_seed(0)
    grid = HashGrid(SMALL)
    grid.table.data.normal_()
    return grid.double()


def test_hash_encode_equals_a_loop_over_corners(grid: HashGrid) -> None:
    points = torch.rand(40, 3, dtype=torch.float64) * 1.2 - 0.1
    points[:3] = torch.tensor([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0], [0.5, 1.0, 0.0]])
    expected = torch.tensor([slow_hash_encode(point.tolist(), grid) for point in points])
    assert (grid(points) - expected).abs().max() < 1e-6  # the loop's result is float32


def test_a_vertex_of_a_dense_level_reads_its_own_entry(grid: HashGrid) -> None:
    vertex = torch.tensor([1, 2, 3])
    features = grid(vertex.double() / 3.0)
    assert torch.allclose(features[:2], grid.table[1 + 4 * (2 + 4 * 3)])


def test_gradients_of_hash_encode_are_those_of_its_values(grid: HashGrid) -> None:
    # Away from cell faces, where the derivative in the points jumps.
    points = torch.rand(4, 3, dtype=torch.float64) * 0.9 + 0.05
    distance = (points[:, None] * grid.resolutions[:, None] % 1.0 - 0.5).abs()
    assert distance.max() < 0.5 - 1e-4
    points.requires_grad_()

    def encode(points: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(grid, {"table": table}, points)

    assert torch.autograd.gradcheck(encode, (points, grid.table), fast_mode=True)


def test_points_keep_their_leading_shape(grid: HashGrid) -> None:
    points = torch.rand(2, 5, 3, dtype=torch.float64)
    assert torch.allclose(grid(points)[1, 3], grid(points[1, 3]), rtol=1e-12)


def _slow_table_gradient(point: list[float], grid: HashGrid, column: int) -> dict[int, float]:
    """d feature[column] / d table[entry]: the summed weights of the corners stored there."""
    config = grid.config
    level, first = column // config.features_per_level, 0
    size = 2**config.log2_table_size
    growth = (config.max_res / config.min_res) ** (1.0 / (config.num_levels - 1))
    for below in range(level):
        cells = math.floor(config.min_res * growth**below + 1e-6)
        first += min((cells + 1) ** 3, size)
    cells = math.floor(config.min_res * growth**level + 1e-6)
    position = [value * cells for value in point]
    gradient: dict[int, float] = {}
    for corner in np.ndindex(2, 2, 2):
        x, y, z = (int(position[axis]) + corner[axis] for axis in range(3))
        weight = math.prod(
            1.0 - abs(place - vertex) for place, vertex in zip(position, (x, y, z), strict=True)
        )
        if (cells + 1) ** 3 <= size:
            entry = x + (cells + 1) * (y + (cells + 1) * z)
        else:
            entry = (x ^ (2654435761 * y % 2**32) ^ (805459861 * z % 2**32)) % size
        gradient[first + entry] = gradient.get(first + entry, 0.0) + weight
    return gradient


def test_table_gradients_are_the_corner_weights_on_dense_and_hashed_levels(grid: HashGrid) -> None:
    point = [0.31, 0.62, 0.87]
    for column in range(grid.num_outputs):
        feature = grid(torch.tensor(point, dtype=torch.float64))[column]
        (found,) = torch.autograd.grad(feature, grid.table)
        expected = torch.zeros_like(found)
        for entry, weight in _slow_table_gradient(point, grid, column).items():
            expected[entry, column % 2] = weight
        assert torch.allclose(found, expected, atol=1e-12)
        assert float(found.sum()) == pytest.approx(1.0)


def test_the_plain_grid_is_differentiable_twice(grid: HashGrid) -> None:
    # Normals in training need d/d table of d/d points; points away from cell faces.
    points = torch.rand(2, 3, dtype=torch.float64) * 0.9 + 0.05
    distance = (points[:, None] * grid.resolutions[:, None] % 1.0 - 0.5).abs()
    assert distance.max() < 0.5 - 1e-4
    points.requires_grad_()

    def encode(points: torch.Tensor, table: torch.Tensor) -> torch.Tensor:
        return torch.func.functional_call(grid, {"table": table}, points)

    assert torch.autograd.gradgradcheck(encode, (points, grid.table), fast_mode=True)


def test_spherical_harmonics_as_a_component_give_the_same_values() -> None:
    directions = torch.nn.functional.normalize(torch.randn(4, 2, 3, dtype=torch.float64), dim=-1)
    encoding = SphericalHarmonics()
    assert encoding.num_outputs == 16
    assert torch.equal(encoding(directions), spherical_harmonics(directions))


LATE = HashGridConfig(
    num_levels=5, min_res=4, max_res=40, log2_table_size=9, start_levels=2, steps_per_level=10
)


def test_levels_enter_one_after_the_other() -> None:
    grid = HashGrid(LATE)
    assert [grid.levels_at(step) for step in (0, 9, 10, 29, 30, 1000)] == [2, 2, 3, 4, 5, 5]
    assert HashGrid(replace(LATE, start_levels=0)).levels_at(0) == 5
    assert HashGrid(replace(LATE, start_levels=9)).levels_at(0) == 5


@pytest.mark.parametrize("engine", ["plain", "fast"])
def test_levels_that_wait_are_zero_and_learn_nothing(engine: str) -> None:
    torch.manual_seed(0)
    grid = HashGrid(LATE)
    grid.encode = HASH_ENCODERS[engine]
    points = torch.rand(50, 3)
    everything = grid(points).detach()
    grid.active_levels = 2
    features = grid(points)
    # Whoever reads all levels, as renderers do, sees the same as long as the others wait.
    assert torch.equal(features, everything)
    assert bool((features[:, 4:] == 0.0).all())
    assert bool((features[:, :4] != 0.0).any(dim=0).all())
    features.square().sum().backward()
    grid.active_levels = 5
    gradient = grid.table.grad
    assert gradient is not None
    first = int(grid.offsets[2])
    assert float(gradient[:first].abs().sum()) > 0.0
    assert float(gradient[first:].abs().sum()) == 0.0
