"""How well neighbours match a picture at each depth: plane sweep with ZNCC, in plain PyTorch.

Symbols: reference [H, W], N neighbours, D planes. Brightness in [0, 1]; a negative one means that
there is no picture. The kernel twin is `engines.cpu.stereo.matching`.
"""

from __future__ import annotations

import torch
from torch import Tensor

VARIANCE_FLOOR = 2e-5
UNSEEN_COST = 1.0


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


def matching_cost(reference: Tensor, others: Tensor, homographies: Tensor, radius: int) -> Tensor:
    """1 - ZNCC at every pixel and plane: the mean of the best two neighbours.

    reference: [H, W]. others: [N, H', W']. homographies: [N, D, 3, 3] of `plane_homographies`.
    radius: of the square windows, cut at the border. Returns [D, H, W] in [0, 2]; 1 where no
    neighbour sees the plane. The best half as in COLMAP and Kang, Szeliski, Chai (CVPR 2001): a
    neighbour before which something stands has no say.
    """
    reference = reference.float()
    height, width = reference.shape
    counts = _box_sums(torch.ones_like(reference), radius)
    mean_r = _box_sums(reference, radius) / counts
    var_r = (_box_sums(reference * reference, radius) / counts - mean_r.square()).clamp_min(0.0)
    planes = []
    for plane in range(homographies.shape[1]):
        costs = []
        for other, homography in zip(others, homographies[:, plane], strict=True):
            shown, seen = _warp(other, homography, height, width)
            mean_o = _box_sums(shown, radius) / counts
            var_o = (_box_sums(shown * shown, radius) / counts - mean_o.square()).clamp_min(0.0)
            covariance = _box_sums(shown * reference, radius) / counts - mean_r * mean_o
            scale = (var_r + VARIANCE_FLOOR) * (var_o + VARIANCE_FLOOR)
            found = 1.0 - covariance / scale.sqrt()
            costs.append(torch.where(seen, found, torch.inf))
        best = torch.stack(costs).sort(dim=0).values[:2]
        mean = torch.where(best[-1].isfinite(), best.mean(dim=0), best[0])
        planes.append(torch.where(best[0].isfinite(), mean, UNSEEN_COST))
    return torch.stack(planes)


def _box_sums(values: Tensor, radius: int) -> Tensor:
    """[H, W] sums over squares of side 2 radius + 1, cut at the border."""
    side = 2 * radius + 1
    pooled = torch.nn.functional.avg_pool2d(
        values[None, None], side, stride=1, padding=radius, divisor_override=1
    )
    return pooled[0, 0]


def _warp(other: Tensor, homography: Tensor, height: int, width: int) -> tuple[Tensor, Tensor]:
    """(the neighbour on the reference's pixels [H, W], 0 where unseen; where it is seen)."""
    rows, columns = other.shape
    y, x = torch.meshgrid(
        torch.arange(height, device=other.device),
        torch.arange(width, device=other.device),
        indexing="ij",
    )
    grid = torch.stack([x, y, torch.ones_like(x)], dim=-1).to(homography.dtype)
    u, v, depth = (grid @ homography.T).unbind(-1)
    u, v = u / depth, v / depth
    seen = (depth > 0) & (u >= 0) & (v >= 0) & (u < columns - 1) & (v < rows - 1)
    i, j = (torch.where(seen, w, 0.0).floor().long() for w in (u, v))
    corners = torch.stack(
        [
            other[j, i],
            other[j, (i + 1).clamp_max(columns - 1)],
            other[(j + 1).clamp_max(rows - 1), i],
            other[(j + 1).clamp_max(rows - 1), (i + 1).clamp_max(columns - 1)],
        ]
    )
    seen &= (corners >= 0.0).all(dim=0)
    fu, fv = (u - i).float(), (v - j).float()
    top = corners[0] + fu * (corners[1] - corners[0])
    bottom = corners[2] + fu * (corners[3] - corners[2])
    return torch.where(seen, top + fv * (bottom - top), 0.0), seen
