"""Things that look the same from several sides: a model that is folded, found by what should match.

A helmet with its name on both sides, a can with its label on it twice: mapping lays the one side
over the other. Where images between the sides are placed they contradict it, and in order of time
`pipelines.sfm.tears` hears them. Where they were too poor to be placed nothing does: what matches
fits. But of images that stand nearly in one place and look the same way, nearly all should match.
Those of one side do, background and all; those of the other share only what looks the same with
them. (Missing correspondences: Zach, Irschara, Bischof, "What can missing correspondences tell us
about 3D structure and motion?", CVPR 2008; Heinly et al., ECCV 2014.)

So images are joined that match as near ones should. What falls apart by that, though the model has
it in one place, may be two sides. Whether it is, mapping anew without the pairs across tells
(`pipelines.sfm.mending`): the other side then finds a place of its own, from which SIFT could not
have found these matches, or none at all.

Symbols: N images of a model.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.sfm.agreement import FEWEST_MATCHES, Floats, Matches
from pipelines.sfm.tears import PairSet
from pipelines.tools.colmap_results import SparseModel

_NEAR_DEG, _IN_VIEW_DEG, _MOST_POINTS = 15.0, 25.0, 5000
"""Parallax, and angle between the optical axes, up to which two images see the same from nearly one
place; and how far from an axis points tell how far away that is, of so many."""
_USUAL = 0.8
"""What is usual for an image: this quantile of its matches with near ones."""
_STRONG = 0.35
"""Of what is usual for both images: so many matches join them. Measured: 0.05 to 0.24 between the
two sides of a helmet, 0.40 and more for nine tenths of the near pairs of one side."""
_LEAST_SHARE, _MOST_PARTS = 0.1, 6
"""Of the images, for a part to be a side; and how many parts are put together in all ways."""
_LIES_OVER = 0.3
"""Share of a side's images that have a near one on the other, for it to lie over that. Measured:
.81 of a helmet's side; .13 of a part of a desk that was photographed in several stretches."""
_LEAST_PAIRS, _MOST_TRIED = 8, 2
"""Near pairs that should have matched better, from which a fold is suspected; and how many ways to
part the sides are worth mapping anew."""


def suspected_folds(
    model: SparseModel, matches: Matches, num_matches: Mapping[tuple[int, int], int]
) -> list[PairSet]:
    """Sets of pairs one of which lays one side over another, if that is what the model does: those
    first without which most near pairs match as they should, and of such the smaller ones.

    matches: verified, of all pairs, some of each. num_matches: how many each pair has in all.
    """
    pairs, counts = _pairs_of(model, matches, num_matches)
    is_near = _near(model)
    near = is_near[pairs[:, 0], pairs[:, 1]]
    usual = _usual(pairs[near], counts[near], len(model.indices))
    strong = near & (counts >= _STRONG * np.sqrt(usual[pairs[:, 0]] * usual[pairs[:, 1]]))
    links = coo_array((np.ones(strong.sum()), tuple(pairs[strong].T)), (len(model.indices),) * 2)
    part = connected_components(links, directed=False)[1]
    sizes = np.bincount(part)
    sides = np.flatnonzero(sizes >= _LEAST_SHARE * len(model.indices))
    sides = sides[np.argsort(-sizes[sides], kind="stable")][:_MOST_PARTS]
    found = []
    # The largest part stays where it is, so that each way to part the sides is there once.
    for count in range(1, len(sides)):
        for moved in itertools.combinations(sides[1:].tolist(), count):
            across = _across(part[pairs], sides, moved)
            weak = int((across & near & ~strong).sum())
            here = np.isin(part, moved)
            there = np.isin(part, sides) & ~here
            if weak >= _LEAST_PAIRS and _lies_over(is_near[np.ix_(here, there)]):
                found.append((-weak, int(across.sum()), across))
    found.sort(key=lambda one: one[:2])
    return [
        frozenset((model.indices[i], model.indices[j]) for i, j in pairs[across].tolist())
        for _, _, across in found[:_MOST_TRIED]
    ]


def _near(model: SparseModel) -> npt.NDArray[np.bool_]:
    """[N, N] which images should share most of what they show."""
    centers, axes = model.world_from_camera[:, :, 3], model.world_from_camera[:, :, 2]
    points = model.points[:: max(1, len(model.points) // _MOST_POINTS)]
    depth = np.zeros(len(centers))
    for row, (center, axis) in enumerate(zip(centers, axes, strict=True)):
        away = points - center
        distance = np.linalg.norm(away, axis=1)
        seen = away @ axis > np.cos(np.radians(_IN_VIEW_DEG)) * distance
        depth[row] = np.median(distance[seen]) if seen.any() else 0.0
    reach = np.tan(np.radians(_NEAR_DEG)) * np.minimum(depth[:, None], depth[None, :])
    apart = np.linalg.norm(centers[:, None] - centers[None, :], axis=2)
    near: npt.NDArray[np.bool_] = (axes @ axes.T > np.cos(np.radians(_NEAR_DEG))) & (apart < reach)
    return near


def _lies_over(near: npt.NDArray[np.bool_]) -> bool:
    """Whether the smaller of two sides is where the other is. near: [A, B], of their images."""
    share = near.any(axis=1).mean() if near.shape[0] <= near.shape[1] else near.any(axis=0).mean()
    return bool(share >= _LIES_OVER)


def _across(
    parts: npt.NDArray[np.int32], sides: npt.NDArray[np.intp], moved: tuple[int, ...]
) -> npt.NDArray[np.bool_]:
    """Which pairs, by the parts [P, 2] of their images, join the moved sides and the others."""
    is_moved = np.isin(parts, moved)
    are_sides = np.isin(parts, sides).all(axis=1)
    joins: npt.NDArray[np.bool_] = are_sides & (is_moved[:, 0] != is_moved[:, 1])
    return joins


def _pairs_of(
    model: SparseModel, matches: Matches, num_matches: Mapping[tuple[int, int], int]
) -> tuple[npt.NDArray[np.intp], npt.NDArray[np.int64]]:
    """Pairs of rows of the model's images [P, 2] that match, and how many matches each has [P]."""
    row = {index: number for number, index in enumerate(model.indices)}
    known = [
        (row[i], row[j], num_matches[i, j])
        for (i, j), places in matches.items()
        if i in row and j in row and len(places[0]) >= FEWEST_MATCHES
    ]
    rows = np.asarray(known, np.intp).reshape(-1, 3)
    return rows[:, :2], rows[:, 2]


def _usual(pairs: npt.NDArray[np.intp], counts: npt.NDArray[np.int64], num: int) -> Floats:
    """[N] the matches that each image usually has with near ones; infinite without any."""
    usual = np.full(num, np.inf)
    if not len(pairs):
        return usual
    both = np.concatenate([pairs[:, 0], pairs[:, 1]])
    order = np.argsort(both, kind="stable")
    twice = np.concatenate([counts, counts])[order]
    images, starts = np.unique(both[order], return_index=True)
    for image, own in zip(images, np.split(twice, starts[1:]), strict=True):
        usual[image] = np.quantile(own, _USUAL)
    return usual
