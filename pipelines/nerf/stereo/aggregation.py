"""From noisy matching costs to one depth a pixel: semi-global aggregation, in plain PyTorch.

A plain surface says nothing of where it is; its borders do. Costs are summed along eight straight
paths through every pixel, on which a small step in depth costs little and a jump much, less where
the picture has an edge. Symbols: [D, H, W] costs of D planes. The kernel twin is
`engines.cpu.stereo.aggregation`. Source: Hirschmueller, TPAMI 2008, section 2.3.
"""

from __future__ import annotations

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
    weights = torch.ones(len(PAIRS), *picture.shape)
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
    """
    volume = cost.permute(1, 2, 0).contiguous()
    total = torch.zeros_like(volume)
    for k, (dy, dx) in enumerate(PAIRS):
        for sign in (1, -1):
            total += _along(volume, weights[k], (sign * dy, sign * dx), sign == 1, small, large)
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


def _along(
    volume: Tensor,
    weight: Tensor,
    step: tuple[int, int],
    forward: bool,
    small: float,
    large: float,
) -> Tensor:
    """Costs [H, W, D] gathered along one path; step: (dy, dx) to the pixel before.

    forward: whether that is the pair's other pixel, so that the pair's weight lies at this one.
    """
    height, width, _ = volume.shape
    dy, dx = step
    path = torch.empty_like(volume)
    # Rows after rows, or columns after columns on a level path; the other axis is a vector.
    if dy == 0:
        for n in range(width):
            x = n if dx < 0 else width - 1 - n
            before = path[:, x + dx] if 0 <= x + dx < width else None
            at = weight[:, x if forward else x + dx] if before is not None else None
            path[:, x] = _advance(volume[:, x], before, at, small, large)
        return path
    for n in range(height):
        y = n if dy < 0 else height - 1 - n
        path[y] = volume[y]
        if not 0 <= y + dy < height:
            continue
        columns = slice(max(0, -dx), width - max(0, dx))
        source = slice(max(0, dx), width - max(0, -dx))
        at = weight[y, columns] if forward else weight[y + dy, source]
        path[y, columns] = _advance(volume[y, columns], path[y + dy, source], at, small, large)
    return path


def _advance(
    cost: Tensor, before: Tensor | None, weight: Tensor | None, small: float, large: float
) -> Tensor:
    """[P, D] of the next pixels of P paths."""
    if before is None or weight is None:
        return cost
    least = before.amin(dim=-1, keepdim=True)
    padded = torch.nn.functional.pad(before, (1, 1), value=_FAR)
    beside = torch.minimum(padded[:, :-2], padded[:, 2:]) + small
    jump = least + (large * weight).clamp_min(small)[:, None]
    return cost + torch.minimum(torch.minimum(before, beside), jump) - least
