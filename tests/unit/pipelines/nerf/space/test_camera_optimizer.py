"""Exponential maps against the matrix exponential; the optimiser's effect on rays."""

from __future__ import annotations

import math
from collections.abc import Callable

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


def _looking(places: torch.Tensor) -> torch.Tensor:
    """Poses [N, 3, 4] of cameras that look at the origin; Z points away from it."""
    back = places / places.norm(dim=-1, keepdim=True)
    right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]).expand_as(back), back)
    right = right / right.norm(dim=-1, keepdim=True)
    return torch.stack([right, torch.linalg.cross(back, right), back, places], dim=-1)


def _orbit(num: int) -> torch.Tensor:
    """Poses [N, 3, 4] of cameras on their way around the origin, up and down and to and fro."""
    angle = torch.arange(num) * (2 * math.pi / num)
    axes = torch.stack([angle.cos(), angle.sin(), 0.3 + 0.2 * (3 * angle).sin()], dim=-1)
    return _looking(axes / axes.norm(dim=-1, keepdim=True) * (2 + 0.5 * (2 * angle).cos())[:, None])


def test_common_motions_are_orthonormal_and_as_many_as_there_are() -> None:
    row = _looking(torch.tensor([0.0, -2.0, 1.0])).expand(9, 3, 4).clone()
    in_one_place = row.clone()
    row[:, 0, 3] = torch.arange(9)  # side by side, all looking the same way
    # In a row there is one direction to be even in, and whoever looks one way follows a scene by
    # turns that are the same for all.
    for poses, num in ((_orbit(20), 30), (row, 12), (in_one_place, 6), (_orbit(4), 24)):
        motions = common_motions(poses).flatten(0, 1)
        assert motions.shape == (6 * len(poses), num)
        assert torch.allclose(motions.T @ motions, torch.eye(num), atol=1e-6)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_common_motions_do_not_hang_on_the_unit_or_the_origin(scale: float) -> None:
    poses = _orbit(20)
    moved = poses.clone()
    moved[:, :, 3] = scale * (poses[:, :, 3] + torch.tensor([4.0, -2.0, 1.0]))
    found, other = (common_motions(each).flatten(0, 1) for each in (poses, moved))
    assert torch.allclose(found @ found.T, other @ other.T, atol=1e-5)


@pytest.mark.parametrize("mode", ["so3xr3", "se3"])
def test_what_the_cameras_do_together_moves_none_of_them(mode: str) -> None:
    poses = _orbit(20)
    axes, places = poses[:, :, 2], poses[:, :, 3]
    optimizer = CameraOptimizer(20, mode)
    optimizer.keep_frame(poses)
    rays = Rays(places, -axes, torch.arange(20))
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
    assert not torch.allclose(moved.directions, rays.directions, atol=1e-3)
    assert torch.allclose(moved.origins, expected.origins, atol=1e-5)
    assert torch.allclose(moved.directions, expected.directions, atol=1e-5)


def _shifted(places: torch.Tensor) -> torch.Tensor:
    return places + torch.tensor([0.03, -0.02, 0.04])


def _turned(places: torch.Tensor) -> torch.Tensor:
    turn = torch.tensor([0.01, 0.03, -0.02]).expand_as(places)
    return places + torch.linalg.cross(turn, places - torch.tensor([0.5, 0.0, 0.2]))


def _scaled(places: torch.Tensor) -> torch.Tensor:
    return 1.02 * places


def _sheared(places: torch.Tensor) -> torch.Tensor:
    return places + torch.tensor([0.0, 0.02, 0.01]) * places[:, :1]


@pytest.mark.parametrize("change", [_shifted, _turned, _scaled, _sheared])
def test_cameras_do_not_move_with_their_scene(
    change: Callable[[torch.Tensor], torch.Tensor],
) -> None:
    poses = _orbit(40)
    optimizer = CameraOptimizer(40, "so3xr3")
    with torch.no_grad():
        optimizer.tangent[:, :3] = change(poses[:, :, 3]) - poses[:, :, 3]
    assert optimizer.corrections().norm(dim=-1).max() > 1e-2
    optimizer.keep_frame(poses)
    assert optimizer.corrections().norm(dim=-1).max() < 1e-5


def test_a_scene_that_is_shifted_is_not_followed() -> None:
    """The cameras' best turns towards a shifted point, which is what training would find."""
    poses, offset = _orbit(40), torch.tensor([0.003, -0.002, 0.004])
    places = 2.0 * poses[:, :, 2]
    aim = offset - places
    turns = torch.linalg.cross(-poses[:, :, 2], aim / aim.norm(dim=-1, keepdim=True))
    optimizer = CameraOptimizer(40, "so3xr3")
    with torch.no_grad():
        optimizer.tangent[:, 3:] = turns
    assert optimizer.corrections().norm(dim=-1).max() > 1e-3
    optimizer.keep_frame(poses)
    assert optimizer.corrections().norm(dim=-1).max() < 1e-5


def test_a_camera_that_is_off_alone_is_corrected() -> None:
    optimizer = CameraOptimizer(40, "so3xr3")
    optimizer.keep_frame(_orbit(40))
    with torch.no_grad():
        optimizer.tangent[7, 3:] = torch.tensor([0.01, 0.02, -0.01])
    found = optimizer.corrections()
    assert torch.allclose(found[7, 3:], optimizer.tangent[7, 3:], rtol=0.3)
    others = torch.cat([found[:7], found[8:]])
    assert others.norm(dim=-1).max() < 0.2 * found[7].norm()


def test_of_cameras_that_are_all_off_by_chance_most_of_it_is_corrected() -> None:
    optimizer = CameraOptimizer(60, "so3xr3")
    optimizer.keep_frame(_orbit(60))
    with torch.no_grad():
        optimizer.tangent.normal_(std=0.01, generator=torch.Generator().manual_seed(0))
    left = optimizer.tangent - optimizer.corrections()
    # Thirty of 360 numbers.
    assert float((left.square().sum() / optimizer.tangent.square().sum()).detach()) < 0.12


def test_a_camera_that_no_ray_came_from_gets_no_gradient() -> None:
    optimizer = CameraOptimizer(12, "so3xr3")
    optimizer.keep_frame(_orbit(12))
    moved = optimizer.apply_to(Rays(torch.rand(2, 3), torch.eye(3)[:2], torch.tensor([0, 2])))
    (moved.origins.sum() + moved.directions[:, 1].sum()).backward()
    gradient = optimizer.tangent.grad
    assert gradient is not None
    assert gradient.any(dim=1).tolist() == [True, False, True, *[False] * 9]


def test_penalty_is_the_weighted_mean_length() -> None:
    optimizer = CameraOptimizer(2, "so3xr3", translation_penalty=2.0, rotation_penalty=3.0)
    with torch.no_grad():
        optimizer.tangent[0] = torch.tensor([3.0, 4.0, 0.0, 0.0, 0.0, 2.0])
    assert abs(float(optimizer.penalty().detach()) - (2.0 * 5.0 / 2 + 3.0 * 2.0 / 2)) < 1e-6
    optimizer.penalty().backward()
    assert optimizer.tangent.grad is not None
    assert bool(optimizer.tangent.grad.isfinite().all())
