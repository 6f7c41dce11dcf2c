"""Spherical harmonics against closed forms, their definition and quadrature."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from pipelines.nerf.space.harmonics import spherical_harmonics


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


def _legendre(degree: int, m: int, z: float) -> float:
    """Associated Legendre function with the Condon-Shortley phase, by repeated derivatives."""
    coefficients = np.polynomial.legendre.leg2poly([0.0] * degree + [1.0])
    bent = np.polynomial.polynomial.polyder(coefficients, m) if m else coefficients
    return float((-1.0) ** m * (1.0 - z * z) ** (m / 2) * np.polynomial.polynomial.polyval(z, bent))


def test_every_spherical_harmonic_equals_its_definition() -> None:
    # Y_lm = sqrt(2) K P_l^|m|(cos theta) {cos(m phi), sin(|m| phi)}, l from 0, m from -l to l.
    generator = np.random.default_rng(0)
    for z, phi in generator.uniform([-1.0, -np.pi], [1.0, np.pi], (20, 2)).tolist():
        expected = []
        for degree in range(4):
            for m in range(-degree, degree + 1):
                order = abs(m)
                ratio = math.factorial(degree - order) / math.factorial(degree + order)
                norm = math.sqrt((2 * degree + 1) / (4 * math.pi) * ratio)
                wave = math.cos(m * phi) if m >= 0 else math.sin(order * phi)
                scale = math.sqrt(2.0) if m else 1.0
                expected.append(scale * norm * _legendre(degree, order, z) * wave)
        ring = math.sqrt(1.0 - z * z)
        direction = [ring * math.cos(phi), ring * math.sin(phi), z]
        found = spherical_harmonics(torch.tensor(direction, dtype=torch.float64))
        assert found.tolist() == pytest.approx(expected, abs=1e-12)


def test_spherical_harmonics_have_the_right_gradients() -> None:
    directions = torch.randn(4, 3, dtype=torch.float64)
    directions = torch.nn.functional.normalize(directions, dim=-1).requires_grad_()
    assert torch.autograd.gradcheck(spherical_harmonics, (directions,))
