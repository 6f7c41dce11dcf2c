"""The plain encodings against slow loops, closed forms and quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.config import HashGridConfig
from pipelines.nerf.encodings import HashGrid, level_layout, spherical_harmonics

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


def test_the_small_grid_has_dense_and_hashed_levels() -> None:
    assert level_layout(SMALL).dense == [True, False, False, False]
    assert level_layout(SMALL).resolutions == [3, 6, 12, 24]


def test_the_default_grid_has_the_paper_s_levels() -> None:
    layout = level_layout(HashGridConfig())
    assert layout.resolutions[0] == 16
    assert layout.resolutions[-1] == 2048
    assert layout.offsets[-1] - layout.offsets[-2] == 2**19
    assert layout.offsets[1] == 17**3


def test_one_level_has_the_smallest_resolution() -> None:
    assert level_layout(HashGridConfig(num_levels=1)).resolutions == [16]


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


def test_spherical_harmonics_have_their_closed_forms() -> None:
    theta, phi = 0.7, -1.9
    x, y, z = (
        math.sin(theta) * math.cos(phi),
        math.sin(theta) * math.sin(phi),
        math.cos(theta),
    )
    values = spherical_harmonics(torch.tensor([x, y, z], dtype=torch.float64)).tolist()
    assert values[0] == pytest.approx(0.5 / math.sqrt(math.pi))
    assert values[2] == pytest.approx(math.sqrt(0.75 / math.pi) * math.cos(theta))
    assert values[8] == pytest.approx(
        math.sqrt(15 / (16 * math.pi)) * math.sin(theta) ** 2 * math.cos(2 * phi)
    )
    assert values[12] == pytest.approx(
        math.sqrt(7 / (16 * math.pi)) * (5 * math.cos(theta) ** 3 - 3 * math.cos(theta))
    )
    assert values[15] == pytest.approx(
        -math.sqrt(35 / (32 * math.pi)) * math.sin(theta) ** 3 * math.cos(3 * phi)
    )


def test_spherical_harmonics_are_orthonormal() -> None:
    # Gauss-Legendre in z and even steps in phi integrate these polynomials exactly.
    nodes, node_weights = np.polynomial.legendre.leggauss(8)
    phi = np.arange(16) * (2 * np.pi / 16)
    z = np.repeat(nodes, 16)
    ring = np.sqrt(1 - z**2)
    directions = np.stack([ring * np.cos(np.tile(phi, 8)), ring * np.sin(np.tile(phi, 8)), z], -1)
    weights = torch.from_numpy(np.repeat(node_weights, 16) * (2 * np.pi / 16))
    values = spherical_harmonics(torch.from_numpy(directions))
    gram = values.T @ (weights[:, None] * values)
    assert torch.allclose(gram, torch.eye(16, dtype=torch.float64), atol=1e-12)
