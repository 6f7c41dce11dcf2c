"""Plain fronts, which nothing can match, hung below the near edges of table tops.

The front of a white chest has no known point, but it begins at the edge of the chest's top; and on
it are lines, as its sides, and gaps between drawers. On the upright plane through the edge, each
view sees them in the same places. Lines of what is farther away, seen below a top that has no
front, move over that plane from view to view.

Symbols as in `stereo.planes`: planes [P, 4] (n, d) with n . X = d, n of length 1, in the world.
Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from skimage.morphology import isotropic_dilation

from pipelines.nerf.stereo.borders import (
    LEAST_VIEW_PX,
    LEAST_VIEWS,
    Look,
    axes_on,
    edges_of,
    ends_on,
    lines_of,
    some_of,
    spread_deg,
)
from pipelines.nerf.stereo.planes import (
    LEVEL,
    ON_PLANE,
    Depths,
    Floats,
    inverse_depths,
    levels_of,
    ray_grid,
)
from pipelines.nerf.stereo.shelves import ByView
from pipelines.nerf.stereo.spreading import replaceable

Bools = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_MOST_EDGES, _MOST_LINES, _MOST_PLACES = 4, 8, 20_000
_LEAST_EDGE_DEG, _LEAST_LINE_DEG = 1.0, 2.5
"""How much a top's edge, and a line below it, would move between views if they were elsewhere."""
_LEAST_TOP, _MOST_NEARER = 30, 0.1
"""Of a top so many points are known behind its edge, and before it no more than that share."""
_LEAST_STRAIGHT = 0.6
"""Of the places where its patches begin on the top so much is on the edge. Round tops have .36 to
.49 on a straight line, a chest's .81."""
_ALIKE = 0.97
"""Cosine between fronts that face about the same way."""
_ENDS, _BEHIND = 1.0, 0.1
"""Percent of an edge's places that lie beyond what counts as its end, either way; and how far
behind it, by its depth, the top tells of that, too."""
_CLEAR = 0.05
"""How far above a floor an edge is, by its distance."""
_MOST_BESIDE, _LEAST_BESIDE, _ALIKE_BRIGHT = 0.2, 0.004, 0.03
"""A patch of which more than that lies beside the front is something else; and so is what is as
bright as a plain patch of which so much, of the picture, lies there."""
_CUT_PX = 3
"""Where a picture ends nothing else does: its own border is so far away at least."""
_LEAST_ON = 0.5
"""Of a patch's border below the edge so much lies on the edge or on lines of the front."""


@dataclass(frozen=True)
class Front:
    """An upright plane [4], whose n points to the cameras, below the edge of a top.

    along, up: [3], unit, on it. low, high: where the edge begins and ends along it; level: how high
    it is. lines: [L, 3], (a, b, c) with a s + b h = c of a place's height h over the edge and its
    way s along it.
    """

    plane: Floats
    along: Floats
    up: Floats
    low: float
    high: float
    level: float
    lines: Floats

    def places(self, look: Look, rows: Numbers, columns: Numbers) -> tuple[Floats, Floats, Floats]:
        """Depths [K] of the plane at a view's pixels, 0 where they miss it; s and h there."""
        x, y = ray_grid(look.view)
        inverse = inverse_depths(look.view, self.plane[None], x[columns], y[rows, 0])[0]
        z = np.where(inverse > 1e-9, 1.0 / np.maximum(inverse, 1e-9), 0.0)
        local = np.stack([x[columns] * z, y[rows, 0] * z, z], axis=-1)
        world = local @ look.view.world_from_camera[:, :3].T + look.view.center
        return z, world @ self.along, world @ self.up - self.level

    def is_above(self, planes: Floats, eye: Floats) -> Bools:
        """[P]: which planes lie below the middle of the edge; the top itself, as a rule, does not.

        eye: [3], who looks, for what is too near to tell.
        """
        middle = 0.5 * (self.low + self.high) * self.along
        middle = middle + self.level * self.up + self.plane[3] * self.plane[:3]
        height = (planes[:, :3] @ middle - planes[:, 3]) * np.sign(planes[:, :3] @ self.up)
        above: Bools = height > _CLEAR * float(np.linalg.norm(middle - eye))
        return above

    def is_below(self, z: Floats, s: Floats, h: Floats) -> Bools:
        """Which places lie below the edge, and between its ends."""
        slack = 2.0 * ON_PLANE * z
        below: Bools = (z > 0) & (h < slack) & (s > self.low - slack) & (s < self.high + slack)
        return below


def find_fronts(
    looks: Sequence[Look],
    maps: ByView[Depths],
    up: Floats,
    planes: Floats,
    points: Floats,
    depths: Floats,
    on_edge: Callable[[], None] = lambda: None,
) -> list[Front]:
    """The fronts below edges of level planes that have a line of their own.

    maps: [H, W] each, the views'. up: [3]. points: [K, 3] that are known, with their depths [K].
    on_edge: called before each edge is sought; may raise.
    """
    rng = np.random.default_rng(0)
    found = []
    for number, level in enumerate(levels_of(up, planes)):
        if abs(level) < LEVEL:
            continue
        top = planes[number] * np.sign(level)
        on_top = np.abs(points @ top[:3] - top[3]) < ON_PLANE * depths
        for front, seen_by in _edges_of_top(number, top, looks, points[on_top], rng, on_edge):
            lines = _lines_on(front, looks, maps, seen_by, rng)
            if len(lines):
                found.append(replace(front, lines=lines))
    return found


def _edges_of_top(
    number: int,
    top: Floats,
    looks: Sequence[Look],
    known: Floats,
    rng: np.random.Generator,
    on_edge: Callable[[], None],
) -> list[tuple[Front, Numbers]]:
    """Fronts below a top's near edges, without lines, with the views that see them from before.

    known: [K, 3], some points of the top.
    """
    places, depths, views, pieces = some_of(_MOST_PLACES, rng, *ends_on(number, looks))
    normal, centers = top[:3], np.stack([look.view.center for look in looks])
    axes = axes_on(normal)
    flat = places @ axes.T
    found: list[tuple[Front, Numbers]] = []
    for line, on_it, seen_by in lines_of(_MOST_EDGES, rng, flat, depths, views, pieces, on_edge):
        plane = np.append(line[:2] @ axes, line[2])
        plane *= np.sign(np.median(centers[seen_by] @ plane[:3]) - plane[3]) or 1.0
        along = np.cross(normal, plane[:3])
        depth = float(np.median(depths[on_it]))
        away = known @ plane[:3] - plane[3]
        behind = known[(away < 0.0) & (away > -_BEHIND * depth)]
        ends = _ends(places[on_it] @ along, views[on_it], behind @ along)
        front = Front(plane, along, normal, *ends, float(top[3]), np.zeros((0, 3)))
        before = np.flatnonzero(centers @ plane[:3] > plane[3])
        if (
            len(np.intersect1d(seen_by, before)) >= LEAST_VIEWS
            and _is_straight(line, pieces[on_it], flat, depths, pieces)
            and spread_deg(centers[seen_by] - places[on_it[0]], along) >= _LEAST_EDGE_DEG
            and _is_near_edge(front, known, depth)
            and not any(_overlap(front, other) for other, _ in found)
        ):
            found.append((front, before))
    return found


def _is_straight(
    line: Floats, own: Numbers, places: Floats, depths: Floats, pieces: Numbers
) -> bool:
    """Whether the patches that begin on a line begin there and hardly elsewhere on the top.

    own: of each place on the line the patch. places: [K, 2], all on the top, with their depths and
    patches.
    """
    patches, count = np.unique(own, return_counts=True)
    theirs = np.isin(pieces, patches[count >= LEAST_VIEW_PX])
    away = np.abs(places[theirs] @ line[:2] - line[2])
    return bool((away < 2.0 * ON_PLANE * depths[theirs]).mean() >= _LEAST_STRAIGHT)


def _ends(along: Floats, views: Numbers, behind: Floats) -> tuple[float, float]:
    """From where to where an edge goes: as far as any view has it, or the top is known behind it.

    along: [K], of the places on it, of those views. behind: [M], of what is known of the top there.
    """
    seen = [along[views == view] for view in np.unique(views)]
    parts = [part for part in (*seen, behind) if len(part) >= LEAST_VIEW_PX]
    each = np.array([np.percentile(part, (_ENDS, 100.0 - _ENDS)) for part in parts])
    return float(each[:, 0].min()), float(each[:, 1].max())


def _overlap(one: Front, other: Front) -> bool:
    """Whether a top would have two near edges one before the other: lines below its edge look as if
    they lay on it, where few views see them."""
    alike = float(one.plane[:3] @ other.plane[:3]) > _ALIKE
    return alike and one.low < other.high and other.low < one.high


def _is_near_edge(front: Front, known: Floats, depth: float) -> bool:
    """Whether the top is known behind the edge alone. known: [K, 3], of the top."""
    s = known @ front.along
    away = (known @ front.plane[:3] - front.plane[3])[(s > front.low) & (s < front.high)]
    slack = 2.0 * ON_PLANE * depth
    behind, nearer = (away < -slack).sum(), (away > slack).sum()
    return bool(behind >= _LEAST_TOP and nearer <= _MOST_NEARER * behind)


@dataclass(frozen=True)
class _Border:
    """Border pixels [K] of a view's plain patches that may lie on a front, by their patch; where on
    it: s, h and the depth."""

    patch: Numbers
    s: Floats
    h: Floats
    depth: Floats


def _border_on(front: Front, look: Look, z: Depths) -> _Border:
    """Those between the edge's ends below it, but for borders with what stands before the front."""
    plain = np.zeros(int(look.patches.max()) + 1, bool)
    plain[look.plain] = True
    nothing = np.pad(look.view.picture < 0.0, 1, constant_values=True)
    widened: Any = isotropic_dilation
    cut = widened(nothing, _CUT_PX)
    at = edges_of(look.patches) & plain[look.patches] & ~cut[1:-1, 1:-1]
    rows, columns = np.nonzero(at)
    depth, s, h = front.places(look, rows, columns)
    nearest = np.zeros(len(rows))
    for row, column in ((-1, 0), (1, 0), (0, -1), (0, 1)):
        beside = z[rows + row, columns + column]
        nearest = np.where((beside > 0) & ((nearest == 0) | (beside < nearest)), beside, nearest)
    hides = (nearest > 0) & (nearest < (1.0 - 2.0 * ON_PLANE) * depth)
    own = front.is_below(depth, s, h) & ~hides
    patch = look.patches[rows, columns].astype(np.int64)
    return _Border(patch[own], s[own], h[own], depth[own])


def _lines_on(
    front: Front,
    looks: Sequence[Look],
    maps: ByView[Depths],
    before: Numbers,
    rng: np.random.Generator,
) -> Floats:
    """[L, 3]: lines below the edge that views see in the same place, though from apart.

    before: the numbers of the views that see the front from before it.
    """
    seen = [looks[number] for number in before]
    borders = [_border_on(front, looks[number], maps[number]) for number in before]
    below = [border.h < -2.0 * ON_PLANE * border.depth for border in borders]
    flat = np.concatenate(
        [np.stack([b.s, b.h], axis=-1)[at] for b, at in zip(borders, below, strict=True)]
    )
    depths = np.concatenate([b.depth[at] for b, at in zip(borders, below, strict=True)])
    views = np.repeat(np.arange(len(seen)), [int(at.sum()) for at in below])
    begun = np.cumsum([0, *(int(look.patches.max()) + 1 for look in seen)])
    pieces = np.concatenate([b.patch[at] for b, at in zip(borders, below, strict=True)])
    pieces = pieces + begun[views]
    flat, depths, views, pieces = some_of(_MOST_PLACES, rng, flat, depths, views, pieces)
    centers = np.stack([look.view.center for look in seen])
    found, apart = [], [0.0]
    for line, on_it, seen_by in lines_of(_MOST_LINES, rng, flat, depths, views, pieces):
        s, h = flat[on_it[0]]
        point = s * front.along + (h + front.level) * front.up
        point += front.plane[3] * front.plane[:3]
        direction = -line[1] * front.along + line[0] * front.up
        spread = spread_deg(centers[seen_by] - point, direction)
        if spread >= _LEAST_EDGE_DEG:
            found.append(line)
            apart.append(spread)
    return np.array(found if max(apart) >= _LEAST_LINE_DEG else []).reshape(-1, 3)


def laid_on_fronts(look: Look, z: Depths, fronts: Sequence[Front], floors: Floats) -> Depths:
    """The map [H, W] with its plain patches on the fronts that their borders are lines of.

    floors: planes [P, 4] that fronts end at.
    """
    laid = z.copy()
    for front in fronts:
        if look.view.center @ front.plane[:3] <= front.plane[3]:
            continue
        border = _border_on(front, look, z)
        num = int(look.patches.max()) + 1
        places = np.stack([border.s, border.h], axis=-1)
        within = 2.0 * ON_PLANE * border.depth
        on_line = np.zeros(len(within), bool)
        for line in front.lines:
            on_line |= np.abs(places @ line[:2] - line[2]) < within
        on_edge = np.abs(border.h) < within
        size = np.bincount(border.patch, minlength=num)
        lined = np.bincount(border.patch[on_line], minlength=num)
        agree = np.bincount(border.patch[on_line | on_edge], minlength=num)
        taken = (lined >= LEAST_VIEW_PX) & (agree >= _LEAST_ON * size)
        if taken.any():
            taken &= ~_goes_on_beside(front, look)
        if not taken.any():
            continue
        rows, columns = np.nonzero(taken[look.patches] & (look.view.picture >= 0.0))
        depth, s, h = front.places(look, rows, columns)
        inverse = np.where(depth > 0, 1.0 / np.where(depth > 0, depth, 1.0), 0.0)
        may = front.is_below(depth, s, h) & replaceable(z[rows, columns], inverse)
        x, y = ray_grid(look.view)
        for floor in floors[front.is_above(floors, look.view.center)]:
            ground = inverse_depths(look.view, floor[None], x[columns], y[rows, 0])[0]
            may &= (ground <= 1e-9) | (inverse >= (1.0 - 2.0 * ON_PLANE) * ground)
        laid[rows[may], columns[may]] = depth[may].astype(np.float32)
    return laid


def _goes_on_beside(front: Front, look: Look) -> Bools:
    """[N]: patches that are as bright as a plain one beside the front: what is seen between the
    legs of a table is seen beside them, too."""
    usable = look.view.picture >= 0.0
    rows, columns = np.nonzero(usable)
    patch = look.patches[rows, columns]
    depth, s, h = front.places(look, rows, columns)
    below = front.is_below(depth, s, h)
    beside = (depth > 0) & (h < 0.0) & ~below
    num = int(look.patches.max()) + 1
    size = np.maximum(np.bincount(patch, minlength=num), 1)
    brightness = np.bincount(patch, look.view.picture[usable], num) / size
    there = np.bincount(patch[beside], minlength=num)
    is_other = np.bincount(patch[below], minlength=num) < 0.5 * size
    is_other &= there > _LEAST_BESIDE * patch.size
    others = look.plain[is_other[look.plain]]
    alike = np.abs(brightness[:, None] - brightness[others]) < _ALIKE_BRIGHT
    goes_on: Bools = (there > _MOST_BESIDE * size) | alike.any(axis=1)
    return goes_on
