"""Unbounded scene space <-> a bounded cube or ball of radius 2, and <-> the grids' unit cube.

Symbols: x in scene space [..., 3]; z contracted; u = (z + 2) / 4 in [0, 1]^3; n the norm of x that
a contraction goes by: z = f(n) x with f = (2 - 1 / n) / n beyond n = 1. A Gaussian is carried
through by the Jacobian J of the contraction at its mean. The inverses are for exports and tests.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import torch
from torch import Tensor

from pipelines.nerf.errors import NerfError
from pipelines.nerf.plugins import plugin_components
from pipelines.nerf.space.frustums import Gaussians

CONTRACTIONS = ("linf", "l2", "none")


class Contraction(NamedTuple):
    """A contraction of another package: scene points [..., 3] into the cube (-2, 2)^3, and back."""

    contract: Callable[[Tensor], Tensor]
    uncontract: Callable[[Tensor], Tensor]


def _of_a_plugin(name: str) -> Contraction:
    offered: dict[str, Contraction] = plugin_components("contraction")
    if name not in offered:
        allowed = ", ".join((*CONTRACTIONS, *offered))
        raise NerfError(
            "bad_config", f"There is no contraction {name!r}; allowed: {allowed}.", "Choose one."
        )
    return offered[name]


def contract_linf(points: Tensor) -> Tensor:
    """Into the cube [-2, 2]^3: x inside the unit cube, (2 - 1/|x|)(x/|x|) outside, |.| the maximum.

    points: [..., 3], scene units. Source: Nerfacto, arXiv:2302.04264, section 5.
    """
    return _contract(points, points.abs().amax(dim=-1, keepdim=True))


def contract_l2(points: Tensor) -> Tensor:
    """Into the ball of radius 2, as `contract_linf` with the Euclidean norm.

    points: [..., 3], scene units. Source: Mip-NeRF 360, arXiv:2111.12077, eq. 10.
    """
    # The clamp only touches points that stay as they are; without it the norm's gradient at the
    # origin is NaN.
    squared = points.square().sum(dim=-1, keepdim=True)
    return _contract(points, squared.clamp_min(1e-12).sqrt())


def contract_none(points: Tensor) -> Tensor:
    """The identity: for scenes that fit the unit cube [-1, 1]^3."""
    return points


def uncontract_linf(contracted: Tensor) -> Tensor:
    """The inverse of `contract_linf` for points strictly inside the cube [-2, 2]^3."""
    return _uncontract(contracted, contracted.abs().amax(dim=-1, keepdim=True))


def uncontract_l2(contracted: Tensor) -> Tensor:
    """The inverse of `contract_l2` for points strictly inside the ball of radius 2."""
    return _uncontract(contracted, contracted.norm(dim=-1, keepdim=True))


def unit_from_scene(points: Tensor, contraction: str) -> tuple[Tensor, Tensor | None]:
    """What the grids see of scene points.

    points: [..., 3], scene units. contraction: one of `CONTRACTIONS` or a plugin's.
    Returns (unit points [..., 3], inside [...] bool or None). A contraction brings every finite
    point into the open unit cube, so `inside` is None; without one, points outside lie outside.
    """
    if contraction == "linf":
        return contract_linf(points) * 0.25 + 0.5, None
    if contraction == "l2":
        return contract_l2(points) * 0.25 + 0.5, None
    if contraction != "none":
        return _of_a_plugin(contraction).contract(points) * 0.25 + 0.5, None
    unit = contract_none(points) * 0.5 + 0.5
    return unit, ((unit > 0.0) & (unit < 1.0)).all(dim=-1)


def contract_gaussian(gaussians: Gaussians, contraction: str) -> Gaussians:
    """Gaussians of scene space in contracted space: mean z(x), covariance J Sigma J^T.

    gaussians: mean [..., 3], scene units. contraction: one of `CONTRACTIONS`. The Jacobian is
    J = f I + f' x (grad n)^T, the identity up to n = 1, where both pieces meet smoothly.
    Source: Mip-NeRF 360, arXiv:2111.12077, eqs. 9 and 10; for `linf` the norm is the maximum.
    """
    mean, sigma = gaussians.mean, gaussians.covariance
    if contraction == "none":
        return gaussians
    if contraction not in CONTRACTIONS:
        return _contract_gaussian_by(_of_a_plugin(contraction).contract, gaussians)
    if contraction == "linf":
        size = mean.abs().amax(dim=-1, keepdim=True)
        # Where several coordinates are the largest, their mean, as autograd has it.
        largest = (mean.abs() == size).to(mean.dtype)
        slope = mean.sign() * largest / largest.sum(dim=-1, keepdim=True)
    else:
        size = mean.square().sum(dim=-1, keepdim=True).clamp_min(1e-12).sqrt()
        slope = mean / size
    inverse = 1.0 / size.clamp_min(1.0)
    factor = (2.0 - inverse) * inverse  # f
    bend = 2.0 * inverse.square() * (inverse - 1.0)  # df / dn
    # J Sigma J^T with J = f I + bend x slope^T, without building J.
    leaned = (sigma @ slope[..., None]).squeeze(-1)  # Sigma slope
    spread = (leaned * slope).sum(dim=-1, keepdim=True)  # slope^T Sigma slope
    side = factor * bend * leaned + 0.5 * bend.square() * spread * mean
    outer = mean[..., :, None] * side[..., None, :]
    covariance = factor.square()[..., None] * sigma + outer + outer.transpose(-1, -2)
    return Gaussians(mean=mean * factor, covariance=covariance)


def unit_gaussians(gaussians: Gaussians, contraction: str) -> tuple[Gaussians, Tensor | None]:
    """`unit_from_scene` for Gaussians: the same scaling of means, its square for covariances.

    Returns (Gaussians in the grids' unit cube, inside [...] bool of the means or None).
    """
    contracted = contract_gaussian(gaussians, contraction)
    scale = 0.5 if contraction == "none" else 0.25
    unit = Gaussians(contracted.mean * scale + 0.5, contracted.covariance * scale**2)
    if contraction != "none":
        return unit, None
    return unit, ((unit.mean > 0.0) & (unit.mean < 1.0)).all(dim=-1)


def scene_from_unit(unit: Tensor, contraction: str) -> Tensor:
    """The inverse of `unit_from_scene` for points strictly inside what it reaches."""
    if contraction == "linf":
        return uncontract_linf(unit * 4.0 - 2.0)
    if contraction == "l2":
        return uncontract_l2(unit * 4.0 - 2.0)
    if contraction != "none":
        return _of_a_plugin(contraction).uncontract(unit * 4.0 - 2.0)
    return unit * 2.0 - 1.0


def _contract_gaussian_by(contract: Callable[[Tensor], Tensor], gaussians: Gaussians) -> Gaussians:
    """Any contraction's `contract_gaussian`, its Jacobian by automatic differentiation."""
    flat = gaussians.mean.reshape(-1, 3)
    jacobian = torch.func.vmap(torch.func.jacrev(contract))(flat)
    jacobian = jacobian.reshape(*gaussians.mean.shape, 3)
    covariance = jacobian @ gaussians.covariance @ jacobian.transpose(-1, -2)
    return Gaussians(mean=contract(gaussians.mean), covariance=covariance)


def _contract(points: Tensor, size: Tensor) -> Tensor:
    inverse = 1.0 / size.clamp_min(1.0)  # 1 inside, where the factor below is then 1 as well
    return points * ((2.0 - inverse) * inverse)


def _uncontract(contracted: Tensor, size: Tensor) -> Tensor:
    scale = torch.where(size > 1.0, 1.0 / ((2.0 - size) * size).clamp_min(1e-12), 1.0)
    return contracted * scale
