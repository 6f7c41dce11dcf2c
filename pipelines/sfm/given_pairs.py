"""Which pairs of images with given poses are matched: those that should show the same.

How far two cameras are apart is told by the angle between their axes and the distance between
them, see `apart`. Pairs are (i, j), i < j, indices in capture order. Poses are [N, 3, 4]
world_from_camera, any axes with Z along the gaze.
"""

from __future__ import annotations

import itertools

import numpy as np
import numpy.typing as npt

from pipelines.scene.nearness import apart
from pipelines.sfm.pairs import Pairs

Floats = npt.NDArray[np.float64]

FEW_IMAGES = 60
"""Up to here, a sample has pairs of all of them."""
_SPOTS = 16
"""Images of a sample of more, each with its partners."""
_PARTNER = 0.5
"""How far apart a sampled pair should be: far enough for a wrong pose to show."""
_RING_EDGES = (0.0, 0.2, 0.4, 0.7, 1.0, 1.4)
_PER_RING = 3
"""Partners at each distance: near ones match best, far ones hold a path together."""
_NEAR_RINGS = (0.2, 0.5)
"""Partners by which points are found: far enough for rays to meet, near enough to match well."""
_STEPS = (1, 2, 4)
"""Neighbours in the capture, whatever the poses say of them: those may be wrong."""


def sampled_pairs(poses: Floats) -> Pairs:
    """Pairs by which poses are judged: of some images, or of all where they are few, the next one,
    one that is _PARTNER apart, and one that is as near but far away in the capture."""
    num = len(poses)
    spots = np.arange(num)
    if num > FEW_IMAGES:
        spots = np.linspace(0, num - 1, _SPOTS).round().astype(int)
    pairs = set()
    for i in spots.tolist():
        badness = np.abs(np.log(np.maximum(apart(poses, i), 1e-9) / _PARTNER))
        badness[i] = np.inf
        later = np.where(np.abs(np.arange(num) - i) > num // 4, badness, np.inf)
        for j in {min(i + 1, num - 1), int(badness.argmin()), int(later.argmin())} - {i}:
            if badness[j] < np.inf and (j == i + 1 or badness[j] < np.log(3.0)):
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def near_pairs(poses: Floats) -> Pairs:
    """Pairs by which points are found under poses that are known: of each image neighbours in the
    capture, and the nearest that is at least so far away, for each of two distances."""
    num = len(poses)
    pairs = {(i, i + step) for step in _STEPS for i in range(num - step)}
    for i in range(num):
        distances = apart(poses, i)
        distances[i] = np.inf
        for least in _NEAR_RINGS:
            j = int(np.where(distances >= least, distances, np.inf).argmin())
            if distances[j] <= _RING_EDGES[-1]:
                pairs.add((min(i, j), max(i, j)))
    return sorted(pairs)


def overlapping_pairs(poses: Floats) -> Pairs:
    """Pairs by which poses are refined: of each image neighbours in the capture, and at each of
    several distances some others, spread over the capture."""
    num = len(poses)
    pairs = {(i, i + step) for step in _STEPS for i in range(num - step)}
    for i in range(num):
        distances = apart(poses, i)
        distances[i] = np.inf
        for inner, outer in itertools.pairwise(_RING_EDGES):
            there = np.flatnonzero((distances >= inner) & (distances < outer))
            chosen = np.linspace(0, len(there) - 1, min(len(there), _PER_RING)).round().astype(int)
            pairs |= {(min(i, j), max(i, j)) for j in there[chosen].tolist()}
    return sorted(pairs)
