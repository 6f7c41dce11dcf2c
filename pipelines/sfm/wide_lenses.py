"""Fisheyes: recognised by matches, and given a focal length to start from.

COLMAP verifies pairs of a lens it knows nothing of by a fundamental matrix. A fisheye's pictures
fit none: of a fisheye of 150 degrees it verifies no pair at all. With the right model, and a focal
length within a tenth, matches fit essential matrices. So a few pairs of neighbours are matched
first; the focal length is the one that most of their matches fit, and the lens is a fisheye where
that is clearly more than any plain lens gets (docs/poses.md).
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

from pipelines.sfm.intrinsics import FISHEYE
from pipelines.sfm.pairs import Pairs

_PLAIN = "SIMPLE_PINHOLE"
ANGLES_DEG = (60.0, 80.0, 100.0, 120.0, 140.0, 160.0, 180.0, 200.0, 220.0)
"""Tried for a fisheye, across the picture's long side."""
PLAIN_ANGLES_DEG = (50.0, 90.0, 110.0)
_FIRST_DEG, _USUAL_DEG = (120.0, 160.0), 70.0
"""Of fisheyes, and of plain lenses: where these two gain nothing, no other is tried."""
MIN_ANGLE_DEG = 100.0
"""Narrower fisheyes are what RADIAL and OPENCV describe as well."""
MIN_GAIN = 1.03
"""How many times as many matches must fit a fisheye as fit the best plain lens."""
MIN_MATCHES = 200
"""Matches that fit, below which nothing is said."""
NUM_PAIRS = 8
_STEPS = (2, 4)


class Matches(Protocol):
    """What `pipelines.tools.colmap_probing.MatchedPairs` offers."""

    @property
    def size(self) -> tuple[int, int]: ...

    def num_fitting(self, lens: str, focal_px: float | None) -> int: ...


@dataclass(frozen=True)
class WideLens:
    """A fisheye. focal_px: to start from. num_fitting, num_plain: matches that fit it, and that fit
    the best plain lens."""

    focal_px: float
    angle_deg: float
    num_fitting: int
    num_plain: int


def probing_pairs(indices: Sequence[int]) -> Pairs:
    """A few pairs of near neighbours, spread over images in their order."""
    pairs = [(indices[i], indices[i + step]) for step in _STEPS for i in range(len(indices) - step)]
    stride = max(1, len(pairs) // NUM_PAIRS)
    return sorted(pairs[stride // 2 :: stride][:NUM_PAIRS])


def recognised(matches: Matches, *, asked_for: bool) -> WideLens | None:
    """The fisheye that the matches are for; None where they are for none, or say nothing.

    asked_for: it is one, and only its focal length is looked for.
    """
    long_side = max(matches.size)

    def fisheye(angle: float) -> int:
        return matches.num_fitting(FISHEYE, long_side / math.radians(angle))

    def plain(angle: float) -> int:
        return matches.num_fitting(_PLAIN, long_side / 2 / math.tan(math.radians(angle) / 2))

    num_plain = 0 if asked_for else max(matches.num_fitting(_PLAIN, None), plain(_USUAL_DEG))
    counts = {angle: fisheye(angle) for angle in _FIRST_DEG}
    if max(counts.values()) <= MIN_GAIN * num_plain:
        return None
    counts |= {angle: fisheye(angle) for angle in ANGLES_DEG if angle not in counts}
    best = max(counts, key=lambda angle: counts[angle])
    counts |= {angle: fisheye(angle) for angle in (best - 10.0, best + 10.0)}
    best = max(counts, key=lambda angle: counts[angle])
    if not asked_for:
        num_plain = max(num_plain, *(plain(angle) for angle in PLAIN_ANGLES_DEG))
    if counts[best] < MIN_MATCHES:
        return None
    is_wide = best >= MIN_ANGLE_DEG and counts[best] > MIN_GAIN * num_plain
    found = WideLens(long_side / math.radians(best), best, counts[best], num_plain)
    return found if asked_for or is_wide else None
