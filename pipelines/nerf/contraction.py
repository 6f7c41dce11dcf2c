"""Unbounded scene space <-> a bounded cube or ball of radius 2, and <-> the grids' unit cube.

Symbols: x in scene space [..., 3]; z contracted; u = (z + 2) / 4 in [0, 1]^3. The inverses are for
exports and tests.
"""

from __future__ import annotations

import torch
from torch import Tensor

CONTRACTIONS = ("linf", "l2", "none")


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

    points: [..., 3], scene units. contraction: one of `CONTRACTIONS`.
    Returns (unit points [..., 3], inside [...] bool or None). A contraction brings every finite
    point into the open unit cube, so `inside` is None; without one, points outside lie outside.
    """
    if contraction == "linf":
        return contract_linf(points) * 0.25 + 0.5, None
    if contraction == "l2":
        return contract_l2(points) * 0.25 + 0.5, None
    unit = contract_none(points) * 0.5 + 0.5
    return unit, ((unit > 0.0) & (unit < 1.0)).all(dim=-1)


def scene_from_unit(unit: Tensor, contraction: str) -> Tensor:
    """The inverse of `unit_from_scene` for points strictly inside what it reaches."""
    if contraction == "linf":
        return uncontract_linf(unit * 4.0 - 2.0)
    if contraction == "l2":
        return uncontract_l2(unit * 4.0 - 2.0)
    return unit * 2.0 - 1.0


def _contract(points: Tensor, size: Tensor) -> Tensor:
    inverse = 1.0 / size.clamp_min(1.0)  # 1 inside, where the factor below is then 1 as well
    return points * ((2.0 - inverse) * inverse)


def _uncontract(contracted: Tensor, size: Tensor) -> Tensor:
    scale = torch.where(size > 1.0, 1.0 / ((2.0 - size) * size).clamp_min(1e-12), 1.0)
    return contracted * scale
