"""How well given poses fit the pictures: by how many pixels matches miss where they should meet.

A match is two rays; under right poses they meet (`pipelines.sfm.agreement`). By what angle they
miss each other is told in pixels of the pictures as features were found in them, since a feature is
placed to a fraction of such a pixel whatever the size of the original.

Symbols: N images; poses [N, 3, 4] world_from_camera, OpenCV axes.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt

from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.agreement import NEAR, off_lines
from pipelines.tools.colmap_rays import px_per_radian

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Matches = Mapping[tuple[int, int], tuple[Floats, Floats]]

FEWEST_MATCHES, FEWEST_PAIRS = 12, 3
"""Of a pair, and of all, for them to tell anything."""
_FULL_WEIGHT = 60
_TELLING_PAIRS = 2
"""Of an image, that say anything of it alone: one pair has two images."""
_LOST = 0.5
"""Agreement of an image's own pairs, in that of the median image, below which its pose is
suspected."""
_USUAL = 0.6
"""And that of the median image from which this can be told from drift."""


@dataclass(frozen=True)
class Fit:
    """error_px: the median over pairs of the median match. worst_px: that of the pair that nine in
    ten are better than. agreement: share of matches that the poses can be right about, mean over
    pairs. num_images: N. ends, shares, weights: the P pairs, [P, 2], the share of each, [P], and
    how much it counts, [P]."""

    error_px: float
    worst_px: float
    agreement: float
    num_matches: int
    num_images: int
    ends: Ints
    shares: Floats
    weights: Floats

    @property
    def num_pairs(self) -> int:
        return len(self.shares)

    def of_image(self, without: Collection[int] = ()) -> Floats:
        """The agreement of each image's own pairs, [N], NaN of one that too few tell about.

        without: images whose pairs do not count: they would speak against their neighbours.
        """
        counted = ~np.isin(self.ends, list(without)).any(axis=1)
        ends, weights = self.ends[counted].ravel(), np.repeat(self.weights[counted], 2)
        shares = np.repeat(self.shares[counted], 2)
        pairs = np.bincount(ends, minlength=self.num_images)
        counts = np.bincount(ends, weights, self.num_images)
        with np.errstate(invalid="ignore"):
            of_image: Floats = np.bincount(ends, shares * weights, self.num_images) / counts
        of_image[(pairs < _TELLING_PAIRS) | (counts < _FULL_WEIGHT)] = np.nan
        return of_image

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
    medians, ends, shares, weights = [], [], [], []
    total = 0
    for (i, j), places in matches.items():
        if len(places[0]) < FEWEST_MATCHES:
            continue
        both = (lenses[i], lenses[j])
        off_rad, is_before = off_lines((poses[i], poses[j]), both, places)
        off_rad = np.nan_to_num(off_rad, nan=np.pi, posinf=np.pi)
        near_rad = NEAR * min(np.hypot(o.width, o.height) / px_per_radian(o) for o in both)
        medians.append(float(np.median(off_rad)) * px_scale(both, long_side_px))
        ends.append((i, j))
        shares.append(float(((off_rad <= near_rad) & is_before).mean()))
        weights.append(min(len(off_rad), _FULL_WEIGHT))
        total += len(off_rad)
    if len(medians) < FEWEST_PAIRS:
        return None
    return Fit(
        error_px=float(np.median(medians)),
        worst_px=float(np.quantile(medians, 0.9)),
        agreement=float(np.average(shares, weights=weights)),
        num_matches=total,
        num_images=len(poses),
        ends=np.array(ends, np.int64),
        shares=np.array(shares),
        weights=np.array(weights, np.float64),
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


def suspects(fit: Fit | None) -> list[int]:
    """Images whose matches contradict their poses far more than others' do.

    One after the other, the worst first, and the others are judged without its pairs: whoever
    looks at a picture that has another one's pose seems to lie, too.
    """
    found: list[int] = []
    if fit is None or np.isnan(fit.of_image()).all():
        return found
    usual = float(np.nanmedian(fit.of_image()))
    if usual < _USUAL:
        return found
    while True:
        of_image = np.nan_to_num(fit.of_image(found), nan=np.inf)
        worst = int(of_image.argmin())
        if not of_image[worst] < _LOST * usual:
            return sorted(found)
        found.append(worst)
