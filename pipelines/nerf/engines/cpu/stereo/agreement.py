"""Kernel twin of `stereo.agreement.count_votes`: what one neighbour's depth says of a map."""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads

Floats = NDArray[np.float32]


@compiled
def _vote(share, shares, depth, ray_x, ray_y, there, other, back, lens, within, votes, sums):
    height, width = depth.shape
    rows, columns = other.shape
    fx, fy, cx, cy = lens
    for y in range(share, height, shares):
        for x in range(width):
            z = depth[y, x]
            if z <= 0.0:
                continue
            a, b = ray_x[x] * z, ray_y[y] * z
            px = there[0, 0] * a + there[0, 1] * b + there[0, 2] * z + there[0, 3]
            py = there[1, 0] * a + there[1, 1] * b + there[1, 2] * z + there[1, 3]
            pz = there[2, 0] * a + there[2, 1] * b + there[2, 2] * z + there[2, 3]
            if pz <= 0.0:
                continue
            u, v = fx * px / pz + cx, fy * py / pz + cy
            if not (u >= 0.0 and v >= 0.0 and u < columns and v < rows):
                continue
            votes[3, y, x] += 1
            i, j = int(u), int(v)
            known = other[j, i]
            if known <= 0.0:
                continue
            gap = known / pz - np.float32(1.0)
            if abs(gap) <= within:
                votes[0, y, x] += 1
                # Where along this pixel's ray the neighbour has the point.
                qx = px * known / pz
                qy = py * known / pz
                sums[y, x] += back[0] * qx + back[1] * qy + back[2] * known + back[3]
            elif gap > np.float32(2.0) * within:
                votes[1, y, x] += 1
            else:
                votes[2, y, x] += gap < 0.0


def count_votes_fast(
    depth: Floats,
    rays: tuple[Floats, Floats],
    other_from_this: Floats,
    other: Floats,
    lens: Floats,
    within: float,
    votes: NDArray[np.int32],
    sums: Floats,
) -> None:
    """As `stereo.agreement.count_votes`, adding to `votes` [4, H, W] and `sums` [H, W]."""
    rotation = other_from_this[:, :3]
    back = np.append(rotation[:, 2], -rotation[:, 2] @ other_from_this[:, 3]).astype(np.float32)
    run_threads(
        _vote,
        depth,
        *rays,
        other_from_this,
        other,
        back,
        lens,
        np.float32(within),
        votes,
        sums,
    )
