"""The steps along one ray that training and rendering share, against their plain twins."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from pipelines.nerf.along_ray.intervals import sample_pdf, weights_from_density
from pipelines.nerf.engines.cpu.parts.intervals import (
    CONTRACTION_CODES,
    INSIDE,
    find_weights,
    place_ray,
    resample,
)
from pipelines.nerf.space.contraction import unit_from_scene

COUNT = 21


def ray_edges(seed: int, far: float) -> np.ndarray:
    generator = np.random.default_rng(seed)
    return np.sort(generator.uniform(0.05, far, COUNT + 1)).astype(np.float32)


@pytest.mark.parametrize("density", [1e-6, 0.3, 40.0])
def test_weights_keep_their_digits_in_fog_and_at_walls(density: float) -> None:
    edges = ray_edges(0, 2.0)
    densities = np.full(COUNT, density, np.float32)
    rows, weights = np.zeros((2, 32), np.float32), np.zeros(COUNT, np.float32)
    total = find_weights(densities, edges, COUNT, rows, weights)
    exact = weights_from_density(
        torch.from_numpy(densities).double(), torch.from_numpy(edges).double()
    ).numpy()
    # A difference of transmittances would lose all digits of the thinnest: 1 - 1e-8 is 1.
    np.testing.assert_allclose(weights, exact, rtol=1e-4, atol=1e-30)
    assert total == pytest.approx(exact.sum(), rel=1e-5)


def test_an_infinite_density_without_room_weighs_nothing() -> None:
    edges = ray_edges(0, 2.0)
    edges[5] = edges[4]
    densities = np.full(COUNT, 0.1, np.float32)
    densities[4] = np.inf
    rows, weights = np.zeros((2, 32), np.float32), np.zeros(COUNT, np.float32)
    find_weights(densities, edges, COUNT, rows, weights)
    assert weights[4] == 0.0


@pytest.mark.parametrize("num_offsets", [1, 10])
def test_new_edges_and_what_lies_between_them(num_offsets: int) -> None:
    generator = np.random.default_rng(1)
    edges, num_new = ray_edges(1, 1.0), 9
    weights = generator.uniform(0.0, 0.1, COUNT).astype(np.float32)
    offsets = generator.uniform(0.0, 1.0, num_offsets).astype(np.float32)
    new_edges, masses = np.zeros(num_new + 1, np.float32), np.zeros(num_new, np.float32)
    total = float(weights.sum(dtype=np.float64))
    resample(edges, weights, total, COUNT, num_new, offsets, 0.01, new_edges, masses)
    plain = sample_pdf(
        torch.from_numpy(edges).double()[None],
        torch.from_numpy(weights).double()[None],
        num_new,
        jitter=torch.from_numpy(offsets).double()[None],
    )
    np.testing.assert_allclose(new_edges, plain[0], atol=1e-6)
    cumulative = np.concatenate([[0.0], np.cumsum(weights, dtype=np.float64)])
    expected = np.diff(np.interp(new_edges, edges, cumulative))
    np.testing.assert_allclose(masses, expected, atol=1e-5)


@pytest.mark.parametrize("contraction", sorted(CONTRACTION_CODES))
def test_a_ray_s_samples_lie_where_the_definition_puts_them(contraction: str) -> None:
    origin = np.array([0.2, -0.4, 0.1], np.float32)
    direction = np.array([0.6, 0.64, -0.48], np.float32)
    edges, first = ray_edges(2, 8.0), 3
    rows = np.full((4, first + COUNT), 7.0, np.float32)
    place_ray(origin, direction, edges, COUNT, CONTRACTION_CODES[contraction], first, rows)
    middles = 0.5 * (edges[1:] + edges[:-1])
    unit, inside = unit_from_scene(
        torch.from_numpy(origin + direction * middles[:, None]), contraction
    )
    np.testing.assert_allclose(rows[:3, first:].T, unit, atol=1e-6)
    expected = np.ones(COUNT) if inside is None else inside.numpy()
    np.testing.assert_array_equal(rows[INSIDE, first:], expected)
    assert (rows[:, :first] == 7.0).all()
    if contraction == "none":
        assert 0 < expected.sum() < COUNT
