"""Whether other views' own depths agree with a depth map, in PyTorch.

Symbols: depth [H, W] along the camera's axis (z), 0 where unknown; OpenCV cameras. The kernel twin
is `engines.cpu.stereo.agreement`. The scheme is that of COLMAP's fusion and of the MVSNet filters.
"""

from __future__ import annotations

import torch
from torch import Tensor

AGREE, SEE_THROUGH, HIDDEN, IN_PICTURE = range(4)


def count_votes(
    depth: Tensor,
    rays: tuple[Tensor, Tensor],
    other_from_this: Tensor,
    other: Tensor,
    lens: Tensor,
    within: float,
    votes: Tensor,
    sums: Tensor,
) -> None:
    """Add what one other view says of each pixel.

    rays: x of each column [W] and y of each row [H] at z = 1. other_from_this: [3, 4].
    other: [H', W'], its depth. lens: [4] fx, fy, cx, cy of the other view, pixel centres at + 0.5.
    within: relative difference up to which depths agree.
    votes: [4, H, W] int32: AGREE; SEE_THROUGH: the other view sees a surface behind the point, by
    more than twice that; HIDDEN: one before it; IN_PICTURE: the point lies before the other view
    and within its picture, whatever that knows there.
    sums: [H, W], of the depths in this view where it agrees.
    """
    x, y = rays[0][None, :] * depth, rays[1][:, None] * depth
    # Written out: a product of matrices may be rounded to fewer bits on a GPU.
    px, py, pz = (row[0] * x + row[1] * y + row[2] * depth + row[3] for row in other_from_this)
    fx, fy, cx, cy = lens
    u, v = fx * px / pz + cx, fy * py / pz + cy
    rows, columns = other.shape
    seen = (depth > 0) & (pz > 0) & (u >= 0) & (v >= 0) & (u < columns) & (v < rows)
    votes[IN_PICTURE] += seen
    i, j = (torch.where(seen, w, 0.0).floor().long() for w in (u, v))
    known = torch.where(seen, other[j, i], 0.0)
    seen &= known > 0
    gap = known / pz - 1.0
    agree = seen & (gap.abs() <= within)
    behind = seen & (gap > 2.0 * within)
    votes[AGREE] += agree
    votes[SEE_THROUGH] += behind
    votes[HIDDEN] += seen & ~agree & (gap < 0)
    (a, b, c), shift = other_from_this[:, 2], other_from_this[:, 3]
    moved = known / pz
    back = a * (px * moved - shift[0]) + b * (py * moved - shift[1]) + c * (known - shift[2])
    sums += torch.where(agree, back, 0.0)
