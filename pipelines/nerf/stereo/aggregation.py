"""From noisy matching costs to one depth a pixel: semi-global aggregation, in PyTorch.

A plain surface says nothing of where it is; its borders do. Costs are summed along eight straight
paths through every pixel, on which a small step in depth costs little and a jump much, less where
the picture has an edge. Symbols: [D, H, W] costs of D planes. The kernel twin is
`engines.cpu.stereo.aggregation`. Paths that run the same way go on together, as a device is kept
waiting by each order. Source: Hirschmueller, TPAMI 2008, section 2.3.
"""

from __future__ import annotations

from collections.abc import Sequence

import torch
from torch import Tensor

PAIRS = ((0, -1), (-1, 0), (-1, -1), (-1, 1))
"""(dy, dx) to the other pixel of each pair that `jump_weights` speaks of."""
_FAR = 1e9


def jump_weights(picture: Tensor, edge_scale: float) -> Tensor:
    """How much a jump in depth between neighbours costs, [4, H, W] in (0, 1], by pair as `PAIRS`.

    picture: [H, W], brightness. exp(-|difference| / edge_scale); 1 where the pair leaves the
    picture.
    """
    weights = picture.new_ones(len(PAIRS), *picture.shape)
    height, width = picture.shape
    for k, (dy, dx) in enumerate(PAIRS):
        rows, columns = slice(-dy, height), slice(max(0, -dx), width - max(0, dx))
        other = picture[: height + dy, max(0, dx) : width - max(0, -dx)]
        weights[k, rows, columns] = torch.exp(-(picture[rows, columns] - other).abs() / edge_scale)
    return weights


def aggregate(cost: Tensor, weights: Tensor, small: float, large: float) -> tuple[Tensor, Tensor]:
    """The best plane of each pixel and how clearly it is the best.

    cost: [D, H, W]. weights: [4, H, W] of `jump_weights`. small, large: costs of a step to the next
    plane and of a jump, the latter times the weight and never below `small`.
    Returns ([H, W] planes, with a fraction from a parabola through the costs beside the best;
    [H, W] margins: the mean cost a path by which the best plane beats all that are over two away).
    Memory: three more volumes like `cost`.
    """
    volume = cost.permute(1, 2, 0).contiguous()
    total = torch.zeros_like(volume)
    jumps = (large * weights).clamp_min(small)
    _add_paths(volume, total, jumps[1:], [dx for _, dx in PAIRS[1:]], small)
    # Along a row it is the same as along a column of the picture's transpose.
    beside = jumps[:1].transpose(1, 2)
    _add_paths(volume.transpose(0, 1), total.transpose(0, 1), beside, [0], small)
    lowest, best = total.min(dim=-1)
    plane = torch.arange(len(cost), device=cost.device)
    apart = (plane - best[..., None]).abs() > 2
    margin = (torch.where(apart, total, _FAR).amin(dim=-1) - lowest) / 8.0
    inner = best.clamp(1, len(cost) - 2)
    before, after = (total.gather(-1, (inner + shift)[..., None])[..., 0] for shift in (-1, 1))
    bend = before - 2.0 * lowest + after
    usable = (inner == best) & (bend > 0.0)
    shift = torch.where(usable, 0.5 * (before - after) / torch.where(usable, bend, 1.0), 0.0)
    return best + shift.clamp(-0.5, 0.5), margin


def _add_paths(
    volume: Tensor, total: Tensor, jumps: Tensor, columns: Sequence[int], small: float
) -> None:
    """Add to `total` the costs gathered along paths that go from row to row, down and up.

    volume, total: [H, W, D]. columns: of each of K paths, how far to the right of a pixel the one
    before it in the row above is. jumps: [K, H, W], the cost of a jump between those two, kept at
    the lower one.
    """
    height, width, num_planes = volume.shape
    # Upwards the pixel before is the lower one. What a roll brings round is before no pixel.
    upward = [one.flip(0).roll((1, dx), (0, 1)) for one, dx in zip(jumps, columns, strict=True)]
    large = torch.stack([*jumps, *upward])[..., None]
    shifts = [*columns, *(-dx for dx in columns)]
    # Beside the picture there is no path before, which is one that cost nothing; beside the planes
    # there is no plane.
    state = volume.new_full((len(shifts), width + 2, num_planes + 2), _FAR)
    state[..., 1:-1] = 0.0
    for down in range(height):
        up = height - 1 - down
        before = torch.stack(
            [path[1 + dx : 1 + dx + width] for path, dx in zip(state, shifts, strict=True)]
        )
        same = before[..., 1:-1]
        least = same.amin(dim=-1, keepdim=True)
        beside = torch.minimum(before[..., :-2], before[..., 2:]).add_(small)
        cheapest = torch.minimum(torch.minimum(same, beside), least + large[:, down])
        here = torch.stack([volume[down], volume[up]])[:, None]
        path = cheapest.reshape(2, -1, width, num_planes).add_(here)
        path -= least.reshape(2, -1, width, 1)
        state[:, 1:-1, 1:-1] = path.flatten(0, 1)
        both = path.sum(dim=1)
        total[down] += both[0]
        total[up] += both[1]
