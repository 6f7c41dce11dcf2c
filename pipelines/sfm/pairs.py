"""Which pairs of images are matched. Pairs are (i, j), i < j, indices in capture order."""

from __future__ import annotations

import itertools
import math
from collections import defaultdict
from collections.abc import Collection, Sequence

import numpy as np
import numpy.typing as npt

Pairs = list[tuple[int, int]]

MAX_EXHAUSTIVE_PHOTOS = 40
"""Photos beyond this are matched with those most like them: at 50 that is half of all pairs."""
SHORT_SEQUENCE = 30
"""Up to here, all pairs cost no more than a sequence's."""
LEADING_MATCHES = 30
"""Verified matches of a pair from which what one image shares with a third the other may, too."""


def sequential_pairs(num: int, overlap: int) -> Pairs:
    """Each image with its next `overlap`, and with those 2, 4, 8, ... further on."""
    steps = set(range(1, overlap + 1)) | {2**k for k in range(num.bit_length())}
    return sorted((i, i + step) for step in steps for i in range(num - step))


def spaced_pairs(num: int) -> Pairs:
    """All pairs among about 2 sqrt(num) evenly spaced images, so that a loop closes."""
    count = min(num, max(8, round(2 * math.sqrt(num))))
    chosen = sorted({round(i * (num - 1) / max(count - 1, 1)) for i in range(count)})
    return [(i, j) for position, i in enumerate(chosen) for j in chosen[position + 1 :]]


def exhaustive_pairs(num: int) -> Pairs:
    """All pairs."""
    return [(i, j) for i in range(num) for j in range(i + 1, num)]


def pairs_through_others(
    verified: npt.NDArray[np.int64], matched: Collection[tuple[int, int]]
) -> Pairs:
    """Pairs that were not matched, of images that both show what a third one shows.

    verified: [V, 3], of each verified pair both images, the lower first, and its matches. Those
    with fewer than 30 lead nowhere. matched: pairs that are not asked for again.
    """
    beside: dict[int, set[int]] = defaultdict(set)
    for i, j in verified[verified[:, 2] >= LEADING_MATCHES, :2].tolist():
        beside[i].add(j)
        beside[j].add(i)
    pairs = {pair for third in beside.values() for pair in itertools.combinations(sorted(third), 2)}
    return sorted(pairs.difference(matched))


def choose_matcher(num: int, matcher: str, *, is_video: bool) -> str:
    """How pairs are chosen at first: sequential, exhaustive or retrieval.

    matcher: what was asked for. auto: all pairs for few images, neighbours in time for more frames
    of a video, neighbours in looks for more photos.
    """
    if matcher != "auto":
        return matcher
    if num <= (SHORT_SEQUENCE if is_video else MAX_EXHAUSTIVE_PHOTOS):
        return "exhaustive"
    return "sequential" if is_video else "retrieval"


def planned_pairs(
    num: int, matcher: str, overlap: int, stretches: Sequence[range] | None = None
) -> Pairs:
    """The pairs of `exhaustive` or `sequential` matching.

    stretches: indices of the clips of a film; only within one are neighbours neighbours in time.
    """
    if matcher == "exhaustive":
        return exhaustive_pairs(num)
    along = {
        (clip.start + i, clip.start + j)
        for clip in stretches or [range(num)]
        for i, j in sequential_pairs(len(clip), overlap)
    }
    return sorted(along | set(spaced_pairs(num)))
