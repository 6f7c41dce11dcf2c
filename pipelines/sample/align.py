"""Similarities between two frames: what a reconstruction may differ by and still be right.

A reconstruction from pictures has its own origin, axes and scale. `similarity` finds the move that
brings one set of points onto another; everything else is then judged under that same move.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.orientation import Similarity

Floats = NDArray[np.float64]


def similarity(source: Floats, target: Floats) -> Similarity:
    """The similarity that moves source [N, 3] onto target [N, 3] with the least squared error.

    Raises ValueError for fewer than 3 points, unequal shapes, or points on one line, which leave
    the turn around that line open.
    Source: Umeyama, "Least-squares estimation of transformation parameters between two point
    patterns", PAMI 13(4), 1991, eqs. 34 to 43.
    """
    if source.shape != target.shape or source.ndim != 2 or source.shape[1] != 3:
        raise ValueError(f"source {source.shape} and target {target.shape} must both be [N, 3]")
    if len(source) < 3:
        raise ValueError(f"a similarity needs at least 3 points, not {len(source)}")
    source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
    from_mean, to_mean = source - source_mean, target - target_mean
    u, singular, vt = np.linalg.svd(to_mean.T @ from_mean / len(source))
    if not singular[0] > 0.0 or singular[1] < 1e-9 * singular[0]:
        raise ValueError("the points lie on one line or in one place: no unique similarity")
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(u) * np.linalg.det(vt))])
    rotation = (u * signs) @ vt
    scale = float((singular * signs).sum() / (from_mean**2).sum(axis=1).mean())
    return Similarity(rotation, target_mean - scale * rotation @ source_mean, scale)


def path_extent(centers: Floats) -> float:
    """The largest distance between two of the camera centres [N, 3], in their units."""
    gaps = np.linalg.norm(centers[:, None] - centers[None], axis=2)
    return float(gaps.max())
