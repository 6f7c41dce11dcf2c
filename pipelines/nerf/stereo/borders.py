"""Borders of plain patches: what is known next to them, and lines that several views see there.

Nothing can match a plain patch, but its border has places. Those of several views lie on one line
in space where something ends there; where a thing merely hides what is behind it, each view sees
another line.

Symbols as in `stereo.planes`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.segmentation import expand_labels

from pipelines.nerf.stereo.patches import Labels
from pipelines.nerf.stereo.planes import ON_PLANE, Floats, inverse_depths, ray_grid
from pipelines.nerf.stereo.spreading import MOST_KNOWN, PlainPatches
from pipelines.nerf.stereo.views import StereoView

Depths = NDArray[np.float32]
Bools = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_LEAST_AREA = 0.004
"""A patch is open if it is so large, of the picture, and no more than half of it is known."""
_LEAST_INSIDE = 0.5
"""What is thinner is an edge that is not sharp, neither here nor there."""
_REACH_PX = 5
"""Matching takes squares, so depths next to an edge are not to be had, or are the other side's."""
LEAST_VIEWS, LEAST_VIEW_PX = 3, 8
"""A line is one if so many views have so many pixels on it."""
_LEAST_PX, _MOST_VIEW_PX, _HYPOTHESES = 60, 60, 2000
_LEAST_LENGTH = 0.03
"""Of a line between two points that stand for one, relative to their depth."""


@dataclass(frozen=True)
class Look(PlainPatches):
    """A view's plain patches, and the places of their borders that have a known depth next to them.

    Of each of K places: x, y, its ray at z = 1; the patch; z: the depth that is known next to it,
    in another patch; plane: which one that lies on, or -1.
    """

    x: Floats
    y: Floats
    patch: Numbers
    z: Floats
    plane: Numbers


def look_at(view: StereoView, z: Depths, planes: Floats, patches: Labels) -> Look:
    known, usable = z > 0, view.picture >= 0.0
    num = int(patches.max()) + 1
    area = np.bincount(patches.ravel(), minlength=num)
    num_known = np.bincount(patches[known], minlength=num)
    edges = edges_of(patches)
    inside = np.bincount(patches[~edges], minlength=num)
    is_open = (area >= _LEAST_AREA * patches.size) & (num_known < MOST_KNOWN * area)
    is_open &= inside >= _LEAST_INSIDE * area
    places = np.arange(patches.size).reshape(patches.shape)
    expand: Any = expand_labels
    nearest = expand(np.where(known & ~is_open[patches], places + 1, 0), _REACH_PX)
    border = edges & is_open[patches] & (nearest > 0) & usable
    here, there = np.nonzero(border), np.unravel_index(nearest[border] - 1, patches.shape)
    columns, rows = (axis.ravel() for axis in ray_grid(view))
    depth = z[there].astype(np.float64)
    off = np.abs(inverse_depths(view, planes, columns[there[1]], rows[there[0]]) * depth - 1.0)
    plane = off.argmin(axis=0)
    plane = np.where(off[plane, np.arange(len(plane))] < ON_PLANE, plane, -1)
    # An edge is some pixels wide: it is half way between what is plain and what is known.
    x = 0.5 * (columns[here[1]] + columns[there[1]])
    y = 0.5 * (rows[here[0]] + rows[there[0]])
    inverse = inverse_depths(view, planes, x, y)[plane, np.arange(len(plane))]
    depth = np.where((plane >= 0) & (inverse > 1e-9), 1.0 / np.maximum(inverse, 1e-9), depth)
    patch = patches[border].astype(np.int64)
    return Look(view, patches, np.flatnonzero(is_open), x, y, patch, depth, plane)


def edges_of(patches: Labels) -> Bools:
    """[H, W]: the pixels that have one of another patch above, below or beside them."""
    edges = np.zeros(patches.shape, bool)
    down, right = patches[:-1] != patches[1:], patches[:, :-1] != patches[:, 1:]
    edges[:-1] |= down
    edges[1:] |= down
    edges[:, :-1] |= right
    edges[:, 1:] |= right
    return edges


def ends_on(floor: int, looks: Sequence[Look]) -> tuple[Floats, Floats, Numbers, Numbers]:
    """Where open patches begin on a floor: [K, 3] world, and of each its depth, view and patch."""
    places, depths = [np.zeros((0, 3))], [np.zeros(0)]
    views, pieces = [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    begun = 0
    for number, look in enumerate(looks):
        at = look.plane == floor
        depth = look.z[at]
        local = np.stack([look.x[at] * depth, look.y[at] * depth, depth], axis=-1)
        places.append(local @ look.view.world_from_camera[:, :3].T + look.view.center)
        depths.append(depth)
        views.append(np.full(len(depth), number))
        pieces.append(begun + look.patch[at])
        begun += int(look.patches.max()) + 1
    return (
        np.concatenate(places),
        np.concatenate(depths),
        np.concatenate(views),
        np.concatenate(pieces),
    )


def _best_line(
    places: Floats, depths: Floats, views: Numbers, pieces: Numbers, rng: np.random.Generator
) -> Floats | None:
    """The line (a, b, c) with (a, b) . X = c and a^2 + b^2 = 1 that most views show, if any.

    places: [K, 2] on the floor, with their depths, views and patches. By RANSAC over pairs of the
    same patch; one view's pixels count up to 60, or one that is near it would outvote all others.
    """
    if len(places) < _LEAST_PX:
        return None
    one = rng.integers(0, len(places), _HYPOTHESES)
    order = np.argsort(pieces, kind="stable")
    begin = np.searchsorted(pieces[order], pieces[one], "left")
    end = np.searchsorted(pieces[order], pieces[one], "right")
    two = order[begin + (rng.random(len(one)) * (end - begin)).astype(np.int64)]
    step = places[two] - places[one]
    length = np.linalg.norm(step, axis=1)
    far = length > _LEAST_LENGTH * depths[one]
    best, most = None, float(_LEAST_PX)
    for at, (x, y) in zip(places[one[far]], step[far] / length[far, None], strict=True):
        across = np.array([-y, x])
        on_it = np.abs((places - at) @ across) < ON_PLANE * depths
        count = np.bincount(views[on_it])
        votes = float(np.minimum(count, _MOST_VIEW_PX).sum())
        if votes >= most and (count >= LEAST_VIEW_PX).sum() >= LEAST_VIEWS:
            best, most = np.append(across, across @ at), votes
    if best is None:
        return None
    for _ in range(3):
        on_it = np.abs(places @ best[:2] - best[2]) < ON_PLANE * depths
        weight = 1.0 / depths[on_it]
        middle = weight @ places[on_it] / weight.sum()
        _, _, axes = np.linalg.svd((places[on_it] - middle) * weight[:, None], full_matrices=False)
        best = np.append(axes[1], axes[1] @ middle)
    return best


def spread_deg(to_centers: Floats, direction: Floats) -> float:
    """The largest angle, seen along the line, between cameras [V, 3]: how much it would move if it
    were the edge of something that hides the floor.
    """
    normal = np.cross(to_centers, direction)
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return float(np.degrees(np.arccos(np.clip(np.abs(normal @ normal.T).min(), 0.0, 1.0))))


def lines_of(
    most: int,
    rng: np.random.Generator,
    places: Floats,
    depths: Floats,
    views: Numbers,
    pieces: Numbers,
    on_line: Callable[[], None] = lambda: None,
) -> Iterator[tuple[Floats, Numbers, Numbers]]:
    """Lines as `_best_line` finds them, one after the other among what the ones before have left;
    of each the numbers of the places on it, and the views that see it."""
    left = np.arange(len(places))
    for _ in range(most):
        on_line()
        line = _best_line(places[left], depths[left], views[left], pieces[left], rng)
        if line is None:
            return
        away = np.abs(places[left] @ line[:2] - line[2])
        on_it = left[away < ON_PLANE * depths[left]]
        seen_by = np.flatnonzero(np.bincount(views[on_it]) >= LEAST_VIEW_PX)
        if len(seen_by) >= LEAST_VIEWS:
            yield line, on_it, seen_by
        left = left[away >= 2.0 * ON_PLANE * depths[left]]


def some_of(most: int, rng: np.random.Generator, *arrays: Any) -> tuple[Any, ...]:
    """At most so many places of all the arrays alike."""
    if len(arrays[0]) <= most:
        return arrays
    chosen = rng.choice(len(arrays[0]), most, replace=False)
    return tuple(array[chosen] for array in arrays)


def axes_on(normal: Floats) -> Floats:
    """[2, 3], unit: two axes on a plane, at right angles. normal: [3], the plane's."""
    along = np.cross(normal, np.eye(3)[np.abs(normal).argmin()])
    along /= np.linalg.norm(along)
    return np.stack([along, np.cross(normal, along)])
