"""Exponential maps against the matrix exponential; the optimiser's effect on rays."""

from __future__ import annotations

import math

import pytest
import torch

from pipelines.nerf.space.camera_optimizer import (
    CameraOptimizer,
    common_motions,
    se3_exp,
    so3_exp,
)
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


def _orbit(num: int) -> torch.Tensor:
    """Optical axes [N, 3] of cameras around the origin that look at it, some from above."""
    angle = torch.arange(num) * (2 * math.pi / num)
    axes = torch.stack([angle.cos(), angle.sin(), 0.3 + 0.2 * (3 * angle).sin()], dim=-1)
    return axes / axes.norm(dim=-1, keepdim=True)


def test_common_motions_are_orthonormal_and_as_many_as_there_are() -> None:
    for axes, num in ((_orbit(20), 12), (torch.tensor([[0.0, 0.0, 1.0]]).expand(9, 3), 6)):
        motions = common_motions(axes).flatten(0, 1)
        assert motions.shape == (6 * len(axes), num)
        assert torch.allclose(motions.T @ motions, torch.eye(num), atol=1e-6)


@pytest.mark.parametrize("mode", ["so3xr3", "se3"])
def test_what_the_cameras_do_together_moves_none_of_them(mode: str) -> None:
    axes = _orbit(20)
    optimizer = CameraOptimizer(20, mode)
    optimizer.keep_frame(axes)
    rays = Rays(-2.0 * axes, axes, torch.arange(20))
    with torch.no_grad():
        optimizer.tangent.normal_(std=0.01, generator=torch.Generator().manual_seed(0))
    expected = optimizer.apply_to(rays)
    shift, turn, aside = torch.tensor([[0.1, -0.2, 0.3], [0.02, 0.01, -0.03], [0.05, 0.0, 0.04]])
    with torch.no_grad():
        optimizer.tangent[:, :3] += shift
        optimizer.tangent[:, 3:] += turn
        # Cameras at two units from the origin that follow a scene shifted by two times `aside`.
        optimizer.tangent[:, 3:] += torch.linalg.cross(axes, aside.expand_as(axes))
    moved = optimizer.apply_to(rays)
    assert not torch.allclose(moved.directions, axes, atol=1e-3)
    assert torch.allclose(moved.origins, expected.origins, atol=1e-5)
    assert torch.allclose(moved.directions, expected.directions, atol=1e-5)


def test_a_scene_that_is_shifted_is_not_followed() -> None:
    """The cameras' best turns towards a shifted point, which is what training would find."""
    axes, offset = _orbit(40), torch.tensor([0.003, -0.002, 0.004])
    aim = 2.0 * axes + offset
    turns = torch.linalg.cross(axes, aim / aim.norm(dim=-1, keepdim=True))
    optimizer = CameraOptimizer(40, "so3xr3")
    with torch.no_grad():
        optimizer.tangent[:, 3:] = turns
    assert optimizer.corrections().norm(dim=-1).max() > 1e-3
    optimizer.keep_frame(axes)
    assert optimizer.corrections().norm(dim=-1).max() < 1e-5


def test_a_camera_that_is_off_alone_is_corrected() -> None:
    axes = _orbit(40)
    optimizer = CameraOptimizer(40, "so3xr3")
    optimizer.keep_frame(axes)
    with torch.no_grad():
        optimizer.tangent[7, 3:] = torch.tensor([0.01, 0.02, -0.01])
    found = optimizer.corrections()
    assert torch.allclose(found[7, 3:], optimizer.tangent[7, 3:], rtol=0.3)
    others = torch.cat([found[:7], found[8:]])
    assert others.norm(dim=-1).max() < 0.2 * found[7].norm()


def test_a_camera_that_no_ray_came_from_gets_no_gradient() -> None:
    optimizer = CameraOptimizer(3, "so3xr3")
    optimizer.keep_frame(torch.eye(3))
    moved = optimizer.apply_to(Rays(torch.rand(2, 3), torch.eye(3)[:2], torch.tensor([0, 2])))
    (moved.origins.sum() + moved.directions[:, 1].sum()).backward()
    gradient = optimizer.tangent.grad
    assert gradient is not None
    assert gradient.any(dim=1).tolist() == [True, False, True]


def test_penalty_is_the_weighted_mean_length() -> None:
    optimizer = CameraOptimizer(2, "so3xr3", translation_penalty=2.0, rotation_penalty=3.0)
    with torch.no_grad():
        optimizer.tangent[0] = torch.tensor([3.0, 4.0, 0.0, 0.0, 0.0, 2.0])
    assert abs(float(optimizer.penalty().detach()) - (2.0 * 5.0 / 2 + 3.0 * 2.0 / 2)) < 1e-6
    optimizer.penalty().backward()
    assert optimizer.tangent.grad is not None
    assert bool(optimizer.tangent.grad.isfinite().all())
