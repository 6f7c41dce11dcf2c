"""How well neighbours match a picture at each depth: plane sweep with ZNCC, in PyTorch.

Symbols: reference [H, W], N neighbours, D planes. Brightness in [0, 1]; a negative one means that
there is no picture. The kernel twin is `engines.cpu.stereo.matching`. What runs here runs on any
device; nothing asks it for a value, and no matrix product may be rounded to fewer bits.
"""

from __future__ import annotations

import torch
from torch import Tensor

VARIANCE_FLOOR = 2e-5
UNSEEN_COST = 1.0
WARPED_BYTES = 128
"""What a pixel of a plane takes while it is compared, at most."""


def plane_homographies(
    lens: Tensor, other_lenses: Tensor, other_from_this: Tensor, inverse_depths: Tensor
) -> Tensor:
    """From reference pixels to neighbours' pixels, for planes across the reference's axis.

    lens: [3, 3], pixel centres at integers. other_lenses: [N, 3, 3]. other_from_this: [N, 3, 4],
    OpenCV cameras. inverse_depths: [D]. Returns [N, D, 3, 3] = K' (R + t n^T / z) K^-1, n = +Z.
    Source: Hartley and Zisserman, Multiple View Geometry, eq. 13.2, with the plane's sign.
    """
    rotation, shift = other_from_this[:, None, :, :3], other_from_this[:, None, :, 3:]
    along = torch.zeros(1, 3, dtype=lens.dtype)
    along[0, 2] = 1.0
    moved = rotation + shift @ along * inverse_depths[None, :, None, None]
    maps: Tensor = other_lenses[:, None] @ moved @ torch.linalg.inv(lens)
    return maps


def matching_cost(
    reference: Tensor, others: Tensor, homographies: Tensor, radius: int, at_once: int = 8
) -> Tensor:
    """1 - ZNCC at every pixel and plane: the mean of the best two neighbours.

    reference: [H, W]. others: [N, H', W']. homographies: [N, D, 3, 3] of `plane_homographies`.
    radius: of the square windows, cut at the border. at_once: planes that are compared together,
    each for `WARPED_BYTES` a pixel. Returns [D, H, W] in [0, 2]; 1 where no
    neighbour sees the plane. The best half as in COLMAP and Kang, Szeliski, Chai (CVPR 2001): a
    neighbour before which something stands has no say.
    """
    reference = reference.float()
    counts = _box_sums(torch.ones_like(reference), radius)
    mean = _box_sums(reference, radius) / counts
    variance = (_box_sums(reference * reference, radius) / counts - mean.square()).clamp_min(0.0)
    told = reference, mean, (variance + VARIANCE_FLOOR).rsqrt(), counts
    corners = [_corners(other) for other in others]
    cost = reference.new_empty(homographies.shape[1], *reference.shape)
    for first in range(0, len(cost), at_once):
        planes = slice(first, first + at_once)
        best = torch.full_like(cost[planes], torch.inf)
        second = best.clone()
        for each, maps in zip(corners, homographies[:, planes], strict=True):
            found = _costs(told, *each, maps, radius)
            second = torch.minimum(second, torch.maximum(best, found))
            best = torch.minimum(best, found)
        both = torch.where(second.isfinite(), 0.5 * (best + second), best)
        cost[planes] = torch.where(best.isfinite(), both, UNSEEN_COST)
    return cost


def _costs(
    told: tuple[Tensor, Tensor, Tensor, Tensor],
    corners: Tensor,
    usable: Tensor,
    homographies: Tensor,
    radius: int,
) -> Tensor:
    """[P, H, W], 1 - ZNCC of P planes in one neighbour; infinite where it does not show them.

    told: of the reference, [H, W] each: brightness, its mean in the windows, 1 / deviation, counts.
    """
    reference, mean, scale, counts = told
    shown, seen = _warped(corners, usable, homographies, *reference.shape)
    sums = _box_sums(torch.stack([shown, shown * shown, shown * reference]), radius) / counts
    variance = (sums[1] - sums[0].square()).clamp_min(0.0) + VARIANCE_FLOOR
    covariance = sums[2] - mean * sums[0]
    found = 1.0 - covariance * scale / variance.sqrt()
    return torch.where(seen, found, torch.inf)


def _box_sums(values: Tensor, radius: int) -> Tensor:
    """[..., H, W] sums over squares of side 2 radius + 1, cut at the border."""
    side, (height, width) = 2 * radius + 1, values.shape[-2:]
    sums = values.reshape(-1, 1, height, width)
    for window, padding in (((side, 1), (radius, 0)), ((1, side), (0, radius))):
        sums = torch.nn.functional.avg_pool2d(
            sums, window, stride=1, padding=padding, divisor_override=1
        )
    return sums.reshape(values.shape)


def _corners(other: Tensor) -> tuple[Tensor, Tensor]:
    """Of each square of four pixels of a picture its brightness [H' - 1, W' - 1, 4], and whether
    all four have one."""
    corners = torch.stack([other[:-1, :-1], other[:-1, 1:], other[1:, :-1], other[1:, 1:]], dim=-1)
    return corners, (corners >= 0.0).all(dim=-1)


def _warped(
    corners: Tensor, usable: Tensor, homographies: Tensor, height: int, width: int
) -> tuple[Tensor, Tensor]:
    """(the neighbour on the reference's pixels [P, H, W], 0 where unseen; where it is seen)."""
    maps = homographies[..., None, None]
    x = torch.arange(width, device=corners.device, dtype=homographies.dtype)
    y = torch.arange(height, device=corners.device, dtype=homographies.dtype)[:, None]
    u, v, depth = (
        maps[:, row, 0] * x + (maps[:, row, 1] * y + maps[:, row, 2]) for row in range(3)
    )
    u, v = u / depth, v / depth
    rows, columns = usable.shape
    seen = (depth > 0) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    u, v = torch.where(seen, u, 0.0), torch.where(seen, v, 0.0)
    i, j = u.long(), v.long()
    at = j * columns + i
    seen &= usable.flatten()[at]
    four = corners.flatten(0, 1)[at]
    fu, fv = (u - i).float(), (v - j).float()
    top = four[..., 0] + fu * (four[..., 1] - four[..., 0])
    bottom = four[..., 2] + fu * (four[..., 3] - four[..., 2])
    return torch.where(seen, top + fv * (bottom - top), 0.0), seen
