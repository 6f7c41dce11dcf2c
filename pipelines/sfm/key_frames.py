"""Key frames: of a long film, those that are mapped; the others are placed on what these show.

Frames of a long film differ by little, and mapping and matching cost by the frame. So about
NUM_KEYS of them, spread over each clip, are matched and mapped as a short film is; where two of
them that follow each other share too little, the frame half way between is one too, until they
share enough or nothing is left between. Every other frame is matched with the key frames around it
alone. docs/poses-experiments.md, "Long films", has what that costs and saves.
"""

from __future__ import annotations

import bisect
import itertools
import math
from collections.abc import Collection, Sequence

from pipelines.sfm.pairs import SHORT_SEQUENCE, Pairs, exhaustive_pairs, planned_pairs
from pipelines.tools.colmap_results import PairStatistics

LONG_FILM = 150
"""Frames from which a film is mapped by key frames."""
NUM_KEYS = 60
"""Key frames that a film starts with, at most; every other frame at least."""
MOST_SHARE = 0.6
"""Share of key frames from which nothing is saved: all frames are mapped then."""
AROUND = 2
"""Key frames before and behind that each other frame is matched with."""
_ENOUGH_MATCHES, _ENOUGH_SHARE = 150, 0.3
"""What two key frames that follow each other must share: verified matches, and what part those are
of the features of the one that has fewer."""


def first_keys(stretches: Sequence[range]) -> list[int]:
    """Key frames to begin with: of each clip the first, every so many, and the last."""
    step = max(2, math.ceil(sum(map(len, stretches)) / NUM_KEYS))
    return sorted({i for clip in stretches for i in (*clip[::step], clip[-1])})


def following(keys: Sequence[int], stretches: Sequence[range]) -> Pairs:
    """Key frames of one clip that follow each other."""
    starts = {clip.start for clip in stretches}
    return [(i, j) for i, j in itertools.pairwise(keys) if j not in starts]


def missing_keys(followers: Pairs, statistics: PairStatistics) -> list[int]:
    """Frames half way between key frames that follow each other but share too little."""
    shared = {(int(i), int(j)): int(num) for i, j, num in statistics.verified}
    features = statistics.num_features
    return [
        (i + j) // 2
        for i, j in followers
        if j - i > 1
        and shared.get((i, j), 0)
        < max(_ENOUGH_MATCHES, _ENOUGH_SHARE * min(int(features[i]), int(features[j])))
    ]


def key_pairs(keys: Sequence[int], stretches: Sequence[range], overlap: int) -> Pairs:
    """Pairs of key frames, as those of a film that has no other frames."""
    if len(keys) <= SHORT_SEQUENCE:
        chosen = exhaustive_pairs(len(keys))
    else:
        chosen = planned_pairs(len(keys), "sequential", overlap, clips_of_keys(keys, stretches))
    return [(keys[i], keys[j]) for i, j in chosen]


def clips_of_keys(keys: Sequence[int], stretches: Sequence[range]) -> list[range]:
    """Of each clip the places that its key frames have in `keys`."""
    return [
        range(bisect.bisect_left(keys, clip.start), bisect.bisect_left(keys, clip.stop))
        for clip in stretches
    ]


def placing_pairs(keys: Sequence[int], stretches: Sequence[range]) -> Pairs:
    """Each frame that is no key frame with the key frames of its clip around it."""
    are_keys = frozenset(keys)
    pairs = []
    for clip, places in zip(stretches, clips_of_keys(keys, stretches), strict=True):
        own = keys[places.start : places.stop]
        for i in clip:
            if i not in are_keys:
                behind = bisect.bisect_left(own, i)
                near = own[max(behind - AROUND, 0) : behind + AROUND]
                pairs += [(min(i, j), max(i, j)) for j in near]
    return sorted(pairs)


def is_worth_it(keys: Collection[int], num_frames: int) -> bool:
    """Whether so few frames are key frames that mapping them alone saves something."""
    return len(keys) < MOST_SHARE * num_frames
