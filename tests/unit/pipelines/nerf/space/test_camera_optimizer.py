"""Exponential maps against the matrix exponential; the optimiser's effect on rays."""

from __future__ import annotations

import pytest
import torch

from pipelines.nerf.space.camera_optimizer import CameraOptimizer, se3_exp, so3_exp
from pipelines.nerf.space.rays import Rays


def _tangents() -> torch.Tensor:
    generator = torch.Generator().manual_seed(0)
    values = torch.randn(60, 6, generator=generator, dtype=torch.float64)
    return values * torch.logspace(-8, 0.4, 60, dtype=torch.float64)[:, None]


def _matrix(tangent: torch.Tensor) -> torch.Tensor:
    shift, (x, y, z) = tangent[:3], tangent[3:].tolist()
    matrix = torch.zeros(4, 4, dtype=torch.float64)
    matrix[:3, :3] = torch.tensor([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=torch.float64)
    matrix[:3, 3] = shift
    return matrix


def test_so3_exp_equals_the_matrix_exponential() -> None:
    for tangent in _tangents():
        expected = torch.linalg.matrix_exp(_matrix(tangent)[:3, :3])
        assert torch.allclose(so3_exp(tangent[3:]), expected, atol=1e-9)


def test_so3_exp_is_a_rotation() -> None:
    rotations = so3_exp(_tangents()[:, 3:])
    eye = torch.eye(3, dtype=torch.float64).expand_as(rotations)
    assert torch.allclose(rotations @ rotations.transpose(1, 2), eye, atol=1e-8)
    assert torch.allclose(torch.linalg.det(rotations), torch.ones(60, dtype=torch.float64))


def test_se3_exp_equals_the_matrix_exponential() -> None:
    for tangent in _tangents():
        expected = torch.linalg.matrix_exp(_matrix(tangent))
        rotation, shift = se3_exp(tangent)
        assert torch.allclose(rotation, expected[:3, :3], atol=1e-9)
        assert torch.allclose(shift, expected[:3, 3], atol=1e-9)


def test_gradients_are_right_also_at_zero() -> None:
    some = torch.cat([torch.zeros(1, 6, dtype=torch.float64), _tangents()[::12]])
    assert torch.autograd.gradcheck(lambda v: se3_exp(v), (some.requires_grad_(),))


@pytest.mark.parametrize("mode", ["off", "so3xr3", "se3"])
def test_rays_are_unchanged_at_the_start(mode: str) -> None:
    rays = Rays(torch.rand(5, 3), torch.eye(3)[[0, 1, 2, 0, 1]], torch.tensor([0, 1, 2, 1, 0]))
    moved = CameraOptimizer(3, mode).apply_to(rays)
    assert torch.allclose(moved.origins, rays.origins)
    assert torch.allclose(moved.directions, rays.directions)


def test_a_quarter_turn_about_z_takes_x_to_y() -> None:
    optimizer = CameraOptimizer(2, "so3xr3")
    with torch.no_grad():
        optimizer.tangent[1] = torch.tensor([0.1, 0.2, 0.3, 0.0, 0.0, torch.pi / 2])
    rays = Rays(torch.zeros(2, 3), torch.eye(3)[[0, 0]], torch.tensor([0, 1]))
    moved = optimizer.apply_to(rays)
    assert torch.allclose(moved.directions, torch.eye(3)[[0, 1]], atol=1e-6)
    assert torch.allclose(moved.origins, torch.tensor([[0.0, 0, 0], [0.1, 0.2, 0.3]]))


def test_penalty_is_the_weighted_mean_length() -> None:
    optimizer = CameraOptimizer(2, "so3xr3", translation_penalty=2.0, rotation_penalty=3.0)
    with torch.no_grad():
        optimizer.tangent[0] = torch.tensor([3.0, 4.0, 0.0, 0.0, 0.0, 2.0])
    assert abs(float(optimizer.penalty().detach()) - (2.0 * 5.0 / 2 + 3.0 * 2.0 / 2)) < 1e-6
    optimizer.penalty().backward()
    assert optimizer.tangent.grad is not None
    assert bool(optimizer.tangent.grad.isfinite().all())
