"""Kernel twin of `stereo.neighbours.pair_scores`: from what angle two views see the same points."""

# Kernels carry no annotations: numba infers their types, docstrings state shapes.
# mypy: disable-error-code="no-untyped-def"

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.engines.cpu.parts.runtime import compiled, run_threads

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]


@compiled
def _score(share, shares, toward, shown, facing, best, below, above, scores):
    num_views, num_points = shown.shape
    for index in range(share, num_views, shares):
        count = 0
        for point in range(num_points):
            count += shown[index, point]
        for other in range(num_views):
            if count == 0 or other == index or not facing[index, other]:
                continue
            total = 0.0
            for point in range(num_points):
                if not (shown[index, point] and shown[other, point]):
                    continue
                cosine = 0.0
                for axis in range(3):
                    cosine += toward[index, point, axis] * toward[other, point, axis]
                angle = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
                off = (angle - best) / (below if angle < best else above)
                total += math.exp(-0.5 * off * off)
            scores[index, other] = total / count


def pair_scores_fast(
    toward: Floats,
    shown: Bools,
    facing: Bools,
    best_angle_deg: float,
    spread_deg: tuple[float, float],
) -> Floats:
    """As `stereo.neighbours.pair_scores`. spread_deg: below and above the best angle."""
    scores = np.zeros((len(shown), len(shown)))
    run_threads(_score, toward, shown, facing, float(best_angle_deg), *spread_deg, scores)
    return scores
