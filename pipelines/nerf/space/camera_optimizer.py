"""Small learned corrections of the training cameras.

Symbols: per camera six numbers [t, omega], zero at the start; t a translation in scene units, omega
a rotation vector in radians, both in scene axes about the camera centre: origin += t (for SE(3) the
left Jacobian times t), direction = R direction.

A scene that moves with its cameras looks the same to them, so nothing but chance decides whether
all of them move together. In Adam's first steps, when little is learned, they do, by a fraction of
a degree, and views that were held out, depth maps and points stay behind (docs/poses.md, "Corrected
poses"). `keep_frame` takes such motions off.
"""

from __future__ import annotations

from dataclasses import replace

import torch
from torch import Tensor, nn

from pipelines.nerf.space.rays import Rays

SERIES_BELOW = 1e-4
"""Squared angle below which the series replace sin(a)/a and the like, which lose digits there."""
DEPENDENT_BELOW = 1e-3
"""Singular values, as a share of the largest, of motions that others are made of already."""
SMALLEST_SPREAD = 1e-9
"""Scene units between cameras that all stand in one place."""


def so3_exp(omega: Tensor) -> Tensor:
    """Rotation vectors [..., 3] in radians to rotation matrices [..., 3, 3] (Rodrigues)."""
    first, second, _ = _coefficients(omega)
    skew = _skew(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    return eye + first * skew + second * (skew @ skew)


def se3_exp(tangent: Tensor) -> tuple[Tensor, Tensor]:
    """[t, omega] [..., 6] to rotation [..., 3, 3] and translation V(omega) t [..., 3].

    Source: Sola et al., "A micro Lie theory", arXiv:1812.01537, eqs. 172 and 174.
    """
    shift, omega = tangent[..., :3], tangent[..., 3:]
    _, second, third = _coefficients(omega)
    skew = _skew(omega)
    eye = torch.eye(3, dtype=omega.dtype, device=omega.device)
    left = eye + second * skew + third * (skew @ skew)
    return so3_exp(omega), (left @ shift[..., None]).squeeze(-1)


def common_motions(scene_from_camera: Tensor) -> Tensor:
    """What all cameras may do together, the scene following: [N, 6, K], K <= 30, orthonormal.

    scene_from_camera: [N, 3, 4].
    Shifts and turns that are the same for all or change evenly with the place: a scene that is
    moved, turned, scaled or bent a little has them. And the turns with which cameras that stay
    where they are follow a scene that is shifted by e, axis x e if it is equally far from all, or
    turned about e, (axis . e) axis.
    """
    poses = scene_from_camera.detach().double().cpu()
    num, axes, places = len(poses), poses[:, :, 2], poses[:, :, 3]
    eye = torch.eye(3, dtype=torch.float64)
    same = eye.expand(num, 3, 3)
    away = places - places.mean(dim=0)
    # One unit is how far cameras usually are from their middle, whatever the scene's scale.
    away = away / away.square().sum(dim=-1).mean().sqrt().clamp_min(SMALLEST_SPREAD)
    even = torch.einsum("nk,ij->nikj", away, eye).reshape(num, 3, 9)
    followed = torch.linalg.cross(axes[:, None, :].expand(num, 3, 3), same).transpose(1, 2)
    turned = axes[:, :, None] * axes[:, None, :]
    of_shifts = torch.cat([same, even], dim=-1)
    of_turns = torch.cat([same, even, followed, turned], dim=-1)
    motions = torch.zeros(num, 6, 30, dtype=torch.float64)
    motions[:, :3, :12], motions[:, 3:, 12:] = of_shifts, of_turns
    basis, sizes, _ = torch.linalg.svd(motions.reshape(6 * num, 30), full_matrices=False)
    kept: Tensor = basis[:, sizes > DEPENDENT_BELOW * sizes.max()]
    return kept.reshape(num, 6, -1).to(scene_from_camera)


class CameraOptimizer(nn.Module):
    """Corrections [N, 6] of N training cameras, applied to rays while training.

    mode: "off", "so3xr3" (rotation and translation apart) or "se3".
    """

    def __init__(
        self,
        num_cameras: int,
        mode: str,
        *,
        translation_penalty: float = 1e-2,
        rotation_penalty: float = 1e-3,
    ) -> None:
        super().__init__()
        self.mode = mode
        self.translation_penalty = translation_penalty
        self.rotation_penalty = rotation_penalty
        rows = 0 if mode == "off" else num_cameras
        self.tangent = nn.Parameter(torch.zeros(rows, 6))
        self.common: Tensor
        self.register_buffer("common", torch.zeros(rows, 6, 0), persistent=False)

    def keep_frame(self, scene_from_camera: Tensor) -> None:
        """From now on corrections have nothing of `common_motions`. Poses: [N, 3, 4]."""
        if self.mode != "off":
            self.common = common_motions(scene_from_camera).to(self.tangent)

    def corrections(self) -> Tensor:
        """[t, omega] [N, 6] as they are applied: of `tangent`, what cameras do not do together."""
        # Adam makes whole steps of small gradients: no camera gets a share of another's.
        tangent = self.tangent.detach()[..., None]
        together = (self.common * (self.common * tangent).sum(dim=(0, 1))).sum(dim=-1)
        return self.tangent - together

    def apply_to(self, rays: Rays) -> Rays:
        """The rays with each camera's correction; `camera_indices` are training indices."""
        if self.mode == "off":
            return rays
        tangent = self.corrections().index_select(0, rays.camera_indices)
        # Products of half precision would turn every ray by a thousandth.
        with torch.autocast(tangent.device.type, enabled=False):
            if self.mode == "se3":
                rotation, shift = se3_exp(tangent)
            else:
                rotation, shift = so3_exp(tangent[:, 3:]), tangent[:, :3]
            directions = (rotation @ rays.directions[..., None]).squeeze(-1)
        return replace(rays, origins=rays.origins + shift, directions=directions)

    def penalty(self) -> Tensor:
        """Weighted mean lengths of the translations and rotations; a scalar."""
        if self.mode == "off":
            return self.tangent.sum()
        corrections = self.corrections()
        moved = corrections[:, :3].norm(dim=-1).mean()
        turned = corrections[:, 3:].norm(dim=-1).mean()
        penalty: Tensor = self.translation_penalty * moved + self.rotation_penalty * turned
        return penalty


def _skew(omega: Tensor) -> Tensor:
    """The matrix [..., 3, 3] of the cross product with omega."""
    x, y, z = omega.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], dim=-1).reshape(
        *omega.shape[:-1], 3, 3
    )


def _coefficients(omega: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """sin a / a, (1 - cos a) / a^2, (a - sin a) / a^3 for a = |omega|, each [..., 1, 1]."""
    squared = omega.square().sum(dim=-1)[..., None, None]
    is_small = squared < SERIES_BELOW
    # The branch that `where` drops must stay finite, or its gradient is NaN.
    safe = torch.where(is_small, torch.ones_like(squared), squared)
    angle = safe.sqrt()
    first = torch.where(is_small, 1.0 - squared / 6.0, torch.sin(angle) / angle)
    second = torch.where(is_small, 0.5 - squared / 24.0, (1.0 - torch.cos(angle)) / safe)
    third = torch.where(
        is_small, 1.0 / 6.0 - squared / 120.0, (angle - torch.sin(angle)) / (safe * angle)
    )
    return first, second, third
