"""How well given poses fit the pictures: by how many pixels matches miss where they should meet.

A match is two rays; under right poses they meet (`pipelines.sfm.agreement`). By what angle they
miss each other is told in pixels of the pictures as features were found in them, since a feature is
placed to a fraction of such a pixel whatever the size of the original.

Symbols: N images; poses [N, 3, 4] world_from_camera, OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.agreement import NEAR, off_lines
from pipelines.tools.colmap_rays import px_per_radian

Floats = npt.NDArray[np.float64]
Matches = Mapping[tuple[int, int], tuple[Floats, Floats]]

FEWEST_MATCHES, FEWEST_PAIRS = 12, 3
"""Of a pair, and of all, for them to tell anything."""
_FULL_WEIGHT = 60
_TELLING_PAIRS = 2
"""Of an image, that say anything of it alone: one pair has two images."""


@dataclass(frozen=True)
class Fit:
    """error_px: the median over pairs of the median match. worst_px: that of the pair that nine in
    ten are better than. agreement: share of matches that the poses can be right about, mean over
    pairs. of_image: [N], the same of each image's pairs, NaN of one that too few tell about."""

    error_px: float
    worst_px: float
    agreement: float
    num_pairs: int
    num_matches: int
    of_image: Floats

    def as_dict(self) -> dict[str, Any]:
        """As report.json has it."""
        return {
            "error_px": round(self.error_px, 4),
            "worst_pairs_px": round(self.worst_px, 4),
            "agreement": round(self.agreement, 4),
            "num_pairs": self.num_pairs,
            "num_matches": self.num_matches,
        }


def fit_of(
    poses: Floats, lenses: Sequence[Intrinsics], matches: Matches, long_side_px: int
) -> Fit | None:
    """The fit of poses to verified matches; None where too few pairs have enough of them.

    long_side_px: at which features were found, at most.
    """
    num = len(poses)
    medians, shares, weights = [], [], []
    sums, counts, pairs_of = np.zeros(num), np.zeros(num), np.zeros(num, np.int64)
    total = 0
    for (i, j), places in matches.items():
        if len(places[0]) < FEWEST_MATCHES:
            continue
        both = (lenses[i], lenses[j])
        off_rad, is_before = off_lines((poses[i], poses[j]), both, places)
        off_rad = np.nan_to_num(off_rad, nan=np.pi, posinf=np.pi)
        near_rad = NEAR * min(np.hypot(o.width, o.height) / px_per_radian(o) for o in both)
        share = float(((off_rad <= near_rad) & is_before).mean())
        weight = min(len(off_rad), _FULL_WEIGHT)
        medians.append(float(np.median(off_rad)) * px_scale(both, long_side_px))
        shares.append(share)
        weights.append(weight)
        total += len(off_rad)
        for index in (i, j):
            sums[index] += share * weight
            counts[index] += weight
            pairs_of[index] += 1
    if len(medians) < FEWEST_PAIRS:
        return None
    with np.errstate(invalid="ignore"):
        of_image = sums / counts
    of_image[(pairs_of < _TELLING_PAIRS) | (counts < _FULL_WEIGHT)] = np.nan
    return Fit(
        error_px=float(np.median(medians)),
        worst_px=float(np.quantile(medians, 0.9)),
        agreement=float(np.average(shares, weights=weights)),
        num_pairs=len(medians),
        num_matches=total,
        of_image=of_image,
    )


def px_scale(lenses: Sequence[Intrinsics], long_side_px: int) -> float:
    """Pixels per radian in the middle of pictures as features are found in them, mean of lenses."""
    return float(
        np.mean(
            [
                px_per_radian(lens) * min(1.0, long_side_px / max(lens.width, lens.height))
                for lens in lenses
            ]
        )
    )
