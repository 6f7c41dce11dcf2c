"""How far a surface is from where it should be: depth maps compared.

All depths are z-depth, [H, W], 0 or not finite where nothing is known. `relative error` is
|asset - truth| / truth.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]

WITHIN = 0.05
AGREES = 0.02


def known(depth: Floats) -> NDArray[np.bool_]:
    """Where a depth says anything."""
    return np.isfinite(depth) & (np.asarray(depth) > 0.0)


def depth_scores(
    asset: Sequence[Floats],
    truth: Sequence[Floats],
    confident: Sequence[NDArray[np.bool_]] | None = None,
) -> dict[str, float | int | None]:
    """The asset's depth against the truth's, over all views together.

    asset, truth: maps of equal shapes, same units. confident: where the truth is to be believed;
    None for wherever it is known. `median_relative_error` and `within_5_percent` are over confident
    pixels that the asset covers, `covered_and_within_5_percent` and `coverage` over all confident
    ones. Values are None where there is no such pixel.
    """
    errors, num_confident = [np.zeros(0)], 0
    for index, (found, true) in enumerate(zip(asset, truth, strict=True)):
        if found.shape != true.shape:
            raise ValueError(f"depth maps of {found.shape} and {true.shape} cannot be compared")
        counted = known(true) if confident is None else known(true) & confident[index]
        both = counted & known(found)
        num_confident += int(counted.sum())
        errors.append(np.abs(found[both] - true[both]) / true[both])
    error = np.concatenate(errors)
    right = float((error <= WITHIN).sum())
    return {
        "median_relative_error": round(float(np.median(error)), 6) if len(error) else None,
        "within_5_percent": round(right / len(error), 4) if len(error) else None,
        "covered_and_within_5_percent": round(right / num_confident, 4) if num_confident else None,
        "coverage": round(len(error) / num_confident, 4) if num_confident else None,
        "num_pixels": num_confident,
    }


def depth_agreement(
    asset: Sequence[Floats],
    agreed: Sequence[Floats],
    confident: Sequence[NDArray[np.bool_]] | None = None,
) -> dict[str, float | int | None]:
    """Of the pixels with an agreed depth, the shares by what the asset does there; they sum to 1.

    `agrees`: within 2 %. `before`, `behind`: nearer or farther than that, so a surface where views
    saw through, or none where they saw one. `missing`: no surface at all.
    """
    counts = dict.fromkeys(("agrees", "before", "behind", "missing"), 0)
    for index, (found, true) in enumerate(zip(asset, agreed, strict=True)):
        counted = known(true) if confident is None else known(true) & confident[index]
        there = counted & known(found)
        off = (found[there] - true[there]) / true[there]
        counts["missing"] += int(counted.sum() - there.sum())
        counts["before"] += int((off < -AGREES).sum())
        counts["behind"] += int((off > AGREES).sum())
        counts["agrees"] += int((np.abs(off) <= AGREES).sum())
    total = sum(counts.values())
    shares = {name: round(count / total, 4) if total else None for name, count in counts.items()}
    return {**shares, "num_pixels": total}


def fitted_scale(asset: Sequence[Floats], truth: Sequence[Floats]) -> float | None:
    """The factor on the asset's depth that brings its median ratio to the truth to 1.

    For cameras found from pictures alone, whose unit is arbitrary. None where nothing overlaps.
    """
    ratios = [np.zeros(0)]
    for found, true in zip(asset, truth, strict=True):
        both = known(found) & known(true)
        ratios.append(true[both] / found[both])
    every = np.concatenate(ratios)
    return float(np.median(every)) if len(every) else None


def nearest(stored: NDArray[Any], shape: tuple[int, int]) -> NDArray[Any]:
    """A map [h, w] brought to `shape`; each pixel takes the nearest stored value."""
    rows = ((np.arange(shape[0]) + 0.5) * stored.shape[0] / shape[0]).astype(int)
    columns = ((np.arange(shape[1]) + 0.5) * stored.shape[1] / shape[1]).astype(int)
    return stored[np.ix_(rows, columns)]
