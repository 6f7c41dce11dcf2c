"""How brightly each picture was taken, told by the surfaces that pictures share.

Two pictures of one point of the scene differ by the ratio of their gains (`nerf.data.light`), as
far as it does not shine. The median over all points that two depth maps agree on is one number per
pair and channel; the gains that fit all pairs best, in the sense of least absolute errors, are
those of the pictures. After Brown and Lowe, "Automatic panoramic image stitching using invariant
features", IJCV 2007, section 6, with depths in place of a homography. Symbols: V views, S pairs.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.data.light import Light, exposed, in_logarithms, is_measurable
from pipelines.nerf.stereo.shelves import ByView
from pipelines.nerf.stereo.views import StereoView

Floats = NDArray[np.float64]
Depths = NDArray[np.float32]

DRIFT = 0.03
"""Standard deviation of the gains' logarithms from which on pictures are levelled."""
_HOLDS = 0.5
"""Pairs may contradict the gains by at most this share of that deviation: a lamp on the phone, or
surfaces that shine, are no gains."""
_BENDS = (0.0, 0.25, 0.5, 0.7, 0.8, 0.9, 1.0)
_MOST_POINTS, _MOST_SHARED, _MIN_SHARED = 3000, 500, 100
_WITHIN = 0.02
_COMPARING = 0.6
_ROUNDS, _LEAST_ERROR, _HOLD = 12, 0.01, 1e-3
_MOST_EXPOSED, _MOST_TINTED = 1.8, 0.4
"""Logarithms, of a picture's gain and of a channel's beside the others', that are believed: two and
a half stops either way, and half as much again in colour. What is seen through (a fence before the
sky) changes its looks as a camera comes near, all pairs say the same, and it adds up on the way."""


@dataclass(frozen=True)
class CaptureLight:
    """The light of V pictures.

    gains: [V, 3], with the geometric mean 1. bend: of the camera's curve. drift: the largest
    channel's standard deviation of the gains' logarithms. contradiction: by how much the median
    pair's ratio differs from that of its gains, a logarithm too. num_pairs: that were asked.
    num_held: pictures whose gains would have been beyond reason.
    """

    gains: Floats
    bend: float = 0.0
    drift: float = 0.0
    contradiction: float = 0.0
    num_pairs: int = 0
    num_held: int = 0

    @property
    def is_drifting(self) -> bool:
        """Whether the pictures' light differs, and gains explain it."""
        return self.drift >= DRIFT and self.contradiction <= _HOLDS * self.drift

    def of(self, index: int) -> Light:
        """The light of one picture."""
        red, green, blue = (round(float(value), 5) for value in self.gains[index])
        return red, green, blue, self.bend


@dataclass(frozen=True)
class _Shared:
    """What two views show of the same surfaces: their colours [P, 3] in [0, 1]."""

    first: int
    second: int
    here: Floats
    there: Floats


def find_light(
    views: Sequence[StereoView],
    depths: ByView[Depths],
    pictures: ByView[NDArray[np.uint8]],
    neighbours: Sequence[Sequence[int]],
    on_progress: Callable[[float], None] = lambda done: None,
) -> CaptureLight:
    """The gains of V views; 1 for those that share nothing with others.

    depths: [H, W], 0 where unknown; pictures: [H, W, 3], of the views' own cameras; neighbours: of
    each view those it is compared with. The bend is the one with which levelled pictures differ
    least. on_progress: told the share that is done; may raise.
    """

    def compare(index: int) -> list[_Shared]:
        points, colors = _known_points(views[index], depths[index], pictures[index])
        pairs = []
        for other in neighbours[index]:
            same, there = _seen_too(points, views[other], depths[other], pictures[other])
            if len(same) >= _MIN_SHARED:
                step = max(1, len(same) // _MOST_SHARED)
                pairs.append(_Shared(index, other, colors[same[::step]], there[::step]))
        return pairs

    shared = []
    for index, pairs in enumerate(each_ahead(compare, range(len(views)))):
        shared += pairs
        on_progress(_COMPARING * index / len(views))
    if not shared:
        return CaptureLight(np.ones((len(views), 3)))
    tried = []
    for index, bend in enumerate(_BENDS):
        on_progress(_COMPARING + (1.0 - _COMPARING) * index / len(_BENDS))
        tried.append(_with_bend(shared, len(views), bend))
    return min(tried, key=lambda found: found[0])[1]


def _with_bend(
    shared: Sequence[_Shared], num_views: int, bend: float
) -> tuple[float, CaptureLight]:
    """By how much levelled pictures differ with a bend, a mean over colours; and the gains."""
    which = np.array([(pair.first, pair.second) for pair in shared])
    ratios = np.array(
        [
            np.median(in_logarithms(pair.there, bend) - in_logarithms(pair.here, bend), axis=0)
            for pair in shared
        ]
    )
    trust = np.array([min(1.0, len(pair.here) / _MOST_SHARED) for pair in shared])
    found = offsets_between(which, ratios, num_views, trust)
    asked = np.unique(which)
    # About what is usual, not about a mean that the wild ones have a part in.
    found[asked] -= np.median(found[asked], axis=0)
    wild = found[asked]
    found[asked] = within_reason(wild)
    num_held = int((found[asked] != wild).any(axis=1).sum())
    found[asked] -= found[asked].mean(axis=0)
    told = found[which[:, 1]] - found[which[:, 0]]
    differences = [
        np.abs(exposed(pair.here, np.exp(step), bend) - pair.there).mean()
        for pair, step in zip(shared, told, strict=True)
    ]
    light = CaptureLight(
        np.exp(found),
        bend,
        float(found[asked].std(axis=0).max()),
        float(np.median(np.abs(ratios - told).max(axis=1))),
        len(shared),
        num_held,
    )
    return float(np.mean(differences)), light


def within_reason(offsets: Floats) -> Floats:
    """Logarithms of gains [V, 3] about the usual ones, with no more than a camera does between
    pictures of one scene."""
    exposure = offsets.mean(axis=1, keepdims=True)
    tint = offsets - exposure
    shrunk = _MOST_TINTED / np.maximum(np.abs(tint).max(axis=1, keepdims=True), _MOST_TINTED)
    reasonable = np.clip(exposure, -_MOST_EXPOSED, _MOST_EXPOSED) + shrunk * tint
    is_wild = (np.abs(exposure) > _MOST_EXPOSED) | (shrunk < 1.0)
    return np.where(is_wild, reasonable, offsets)


def offsets_between(
    pairs: NDArray[np.integer[Any]],
    differences: Floats,
    count: int,
    weights: Floats | None = None,
) -> Floats:
    """Values [count, 3] that differ as pairs say: least absolute errors over all of them.

    pairs: [S, 2], first and second; differences: [S, 3], second less first; weights: [S]. By least
    squares whose weights are the last round's 1 / error (Weiszfeld); each group of connected ones
    has about the mean 0.
    """
    first, second = pairs.T.astype(np.int64)
    given = np.ones(len(differences)) if weights is None else weights
    trust = given
    found = np.zeros((count, 3))
    for _ in range(_ROUNDS):
        joined = np.bincount(first * count + second, trust, count * count).reshape(count, count)
        joined = joined + joined.T
        matrix = np.diag(joined.sum(axis=1) + _HOLD) - joined
        wanted = [
            np.bincount(second, trust * values, count) - np.bincount(first, trust * values, count)
            for values in differences.T
        ]
        found = np.asarray(np.linalg.solve(matrix, np.stack(wanted, axis=-1)), np.float64)
        error = np.abs(differences - (found[second] - found[first])).max(axis=1)
        trust = given / np.maximum(error, _LEAST_ERROR)
    return found


def _known_points(
    view: StereoView, depth: Depths, picture: NDArray[np.uint8]
) -> tuple[Floats, Floats]:
    """World points [P, 3] and their colours [P, 3] in [0, 1], at most 3,000 of a view."""
    rows, columns = np.nonzero(depth > 0)
    step = max(1, len(rows) // _MOST_POINTS)
    rows, columns = rows[::step], columns[::step]
    x, y = view.rays()
    z = depth[rows, columns].astype(np.float64)
    local = np.stack([x[columns] * z, y[rows] * z, z], axis=-1)
    colors = picture[rows, columns] / 255.0
    kept = is_measurable(colors)
    return local[kept] @ view.world_from_camera[:, :3].T + view.center, colors[kept]


def _seen_too(
    points: Floats, other: StereoView, depth: Depths, picture: NDArray[np.uint8]
) -> tuple[NDArray[np.intp], Floats]:
    """Which of the points another view shows, where nothing hides them, and in which colours."""
    local = (points - other.center) @ other.world_from_camera[:, :3]
    z = np.where(local[:, 2] > 0, local[:, 2], np.inf)
    fx, fy, cx, cy = other.lens
    columns, rows = fx * local[:, 0] / z + cx, fy * local[:, 1] / z + cy
    height, width = depth.shape
    inside = (local[:, 2] > 0) & (columns >= 0) & (columns < width) & (rows >= 0) & (rows < height)
    which = np.flatnonzero(inside)
    i, j = columns[which].astype(np.intp), rows[which].astype(np.intp)
    colors = picture[j, i] / 255.0
    same = (np.abs(depth[j, i] / z[which] - 1.0) <= _WITHIN) & is_measurable(colors)
    return which[same], colors[same]
