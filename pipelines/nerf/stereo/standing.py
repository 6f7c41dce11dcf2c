"""Plain walls, which nothing can match, stood up where the floor ends; and fronts below the edges
of tops (`stereo.fronts`).

A white wall with nothing on it has no known point at all. But it meets the floor, and where it does
every view sees the same line in space: the edge of the floor against a plain patch. (Where a thing
merely hides the floor, each view sees another line on it.) So lines are sought among the places on
floors where plain patches begin; through each goes an upright plane; and in each view a plain patch
is laid on the planes that its border touches, if other views agree. What may be a floor: a plane
about level, below which nothing is known, as the edge of a table is just such a line before a plain
backdrop. No wall has cameras on both of its sides. Walls at right angles to floors: Furukawa,
Curless, Seitz, Szeliski, "Manhattan-world stereo", CVPR 2009.

Who films what hangs on a wall sees no floor. Where surfaces tell of a wall, and it ends the place,
the plain patches around what is known of it are that wall, too.

Symbols as in `stereo.planes`: planes [P, 4] (n, d) with n . X = d, n of length 1, in the world.
Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.borders import (
    Look,
    axes_on,
    ends_on,
    lines_of,
    look_at,
    some_of,
    spread_deg,
)
from pipelines.nerf.stereo.completing import confirmed
from pipelines.nerf.stereo.engines import KERNELS, Engine
from pipelines.nerf.stereo.fronts import Front, find_fronts, laid_on_fronts
from pipelines.nerf.stereo.maps import MapShelf, Progress, depths_of, surface_points
from pipelines.nerf.stereo.neighbours import choose_neighbours
from pipelines.nerf.stereo.patches import even_patches, shelved_patches
from pipelines.nerf.stereo.planes import (
    LEVEL,
    ON_A_LINE,
    ON_PLANE,
    Floats,
    floors_of,
    inverse_depths,
    levels_of,
    planes_and_samples,
    ray_grid,
    roundness,
    up_of,
)
from pipelines.nerf.stereo.shelves import MEMORY, ByView, Shelf, Shelves
from pipelines.nerf.stereo.spreading import (
    refutes,
    replaceable,
    spread,
)
from pipelines.nerf.stereo.views import StereoView

Depths = NDArray[np.float32]
Bools = NDArray[np.bool_]
Numbers = NDArray[np.int64]

_UPRIGHT = 0.1
"""Cosine, up to which planes stand."""
_MOST_LINES, _MOST_ENDS = 12, 20_000
_LEAST_SPREAD_DEG, _LEAST_OF_ENDS_DEG = 1.0, 0.5
"""From how far apart cameras see a wall's foot; the latter where about nothing is known behind."""
_BEHIND = 0.02
_MOST_BEHIND, _BEHIND_OF_WALL = 0.01, 0.3
"""Of what is known, behind a wall that it ends at; or of what lies on the wall, unless it is a
surface: what gleams on a wall, or is seen in a glass, seems to be behind."""
_BEYOND, _MOST_BEYOND, _MOST_PLACES = 0.06, 0.2, 200
"""No more of the floor so far beyond a wall's foot, by its depth, may be known, of what views could
see of it."""
_SAME_DEG = 4.0
_TOUCH_PX, _TOUCH_SHARE, _MOST_TOUCHED = 12, 0.12, 3
_RIM_PX, _LEAST_OF_WALL = 3, 0.01
"""What a wall has around itself reaches the picture's rim and is so much of the picture."""
_BENEATH_WEIGHT = 0.5
_EXTRAPOLATED = 3.0
_MORE_ASKED = 2
"""So many times the neighbours that pictures are matched with are asked about walls: by the places
that are known hardly one of them may show the far end of a plain wall."""
_PLANES_SHARE, _LOOK_SHARE, _LAY_SHARE, _SPREAD_SHARE = 0.1, 0.35, 0.5, 0.75
_MESSAGE = "standing walls up"


@dataclass(frozen=True)
class _Wall:
    """An upright plane [4], the number of the floor that it stands on, and some places [K, 3] where
    that ends, with their depths [K] in the views that show it.
    """

    plane: Floats
    floor: int
    places: Floats
    depths: Floats


def stood_up(
    views: Sequence[StereoView],
    maps: MapShelf,
    config: StereoConfig,
    on_progress: Progress = lambda fraction, message: None,
    engine: Engine = KERNELS,
    shelves: Shelves = MEMORY,
    patches: Shelf | None = None,
    *,
    up: Floats | None = None,
) -> MapShelf:
    """The maps with plain patches on the walls that their borders with the floor tell of, on known
    walls that end the place, and on fronts below tops.

    Pixels of plain patches change that are unknown, or seem to be nearer than the wall: they get
    its depth where a neighbour agrees and none sees through it, or twice as many agree, unless more
    of the patch is seen through than agreed on. patches: a shelf for the pictures' `patches_of`, or
    with them. up: [3], unit, where it is known better than pictures tell.
    """
    planes, points, depths = planes_and_samples(
        views, maps, lambda done: on_progress(_PLANES_SHARE * done, _MESSAGE)
    )
    up = up_of(views) if up is None else up
    planes = planes[_is_level_or_upright(levels_of(up, planes))]
    floors = floors_of(up, planes, points, depths)
    levels = np.abs(levels_of(up, planes))
    centers = np.stack([view.center for view in views])
    ends = np.array(
        [
            level <= _UPRIGHT and _ends_all(plane, centers, points, depths, planes)
            for plane, level in zip(planes, levels, strict=True)
        ],
        np.bool_,
    )
    has_tops = config.hanging_fronts and bool((levels >= LEVEL).any())
    if not (floors or has_tops or ends.any()):
        return maps

    def look(index: int) -> Look:
        view = views[index]
        parts = even_patches(view.picture, shelved_patches(view, index, patches))
        return look_at(view, maps[index].z, planes, parts)

    looks = []
    for index, found in enumerate(each_ahead(look, range(len(views)))):
        looks.append(found)
        share = (_LOOK_SHARE - _PLANES_SHARE) * (index + 1) / len(views)
        on_progress(_PLANES_SHARE + share, _MESSAGE)
    on_line = partial(on_progress, _LOOK_SHARE, _MESSAGE)
    walls = _find_walls(looks, planes, floors, points, depths, on_line)
    walls = [wall for wall in walls if not _goes_on(views, depths_of(maps), wall)]
    fronts: list[Front] = []
    if config.hanging_fronts:
        known = planes, points, depths
        on_edge = partial(on_progress, _LOOK_SHARE, _MESSAGE)
        fronts = find_fronts(looks, depths_of(maps), up, *known, on_edge)
    if not (walls or fronts or ends.any()):
        return maps
    every, stands_on = _with_walls(planes, walls, float(np.median(depths)))
    ending = np.pad(ends, (0, len(every) - len(ends)))
    handed_on = ending | (np.array(stands_on) >= 0)
    filled = shelves.scratch("on walls", len(views))

    def lay(index: int) -> None:
        z = maps[index].z
        laid = _laid(looks[index], z, every, stands_on, ending) if handed_on.any() else z
        filled[index] = laid_on_fronts(looks[index], laid, fronts, planes[floors])

    for index, _ in enumerate(each_ahead(lay, range(len(views)))):
        share = (_LAY_SHARE - _LOOK_SHARE) * (index + 1) / len(views)
        on_progress(_LOOK_SHARE + share, _MESSAGE)
    seen = surface_points(views, depths_of(maps))
    count = _MORE_ASKED * config.num_neighbours
    neighbours = choose_neighbours(views, seen, count, config.best_angle_deg)
    laid = confirmed(
        views,
        maps,
        filled,
        neighbours,
        config,
        refutes,
        lambda done: on_progress(_LAY_SHARE + (_SPREAD_SHARE - _LAY_SHARE) * done, _MESSAGE),
        engine,
        MapShelf.kept(shelves, "walls", len(views), fresh=True),
        lambda index: looks[index].patches,
    )
    if not handed_on.any():  # of a front nobody else learns: it has ends
        return laid
    return spread(
        looks,
        maps,
        laid,
        every[handed_on],
        neighbours,
        config,
        lambda done: on_progress(_SPREAD_SHARE + (1.0 - _SPREAD_SHARE) * done, _MESSAGE),
        engine,
    )


def _is_level_or_upright(levels: Floats) -> Bools:
    """[P]: of planes with those cosines to up, what a plain patch may be laid on by its border
    alone. A small surface gives a plane of no use, aslant as a rule, and somewhere it is touched.
    """
    steep: Bools = (np.abs(levels) >= LEVEL) | (np.abs(levels) <= _UPRIGHT)
    return steep


def _find_walls(
    looks: Sequence[Look],
    planes: Floats,
    floors: Sequence[int],
    points: Floats,
    depths: Floats,
    on_line: Callable[[], None] = lambda: None,
) -> list[_Wall]:
    """Walls on the lines that floors end at.

    points: [N, 3], samples of what is known, with their depths [N]. on_line: called before each
    line is sought; may raise.
    """
    rng = np.random.default_rng(0)
    centers = np.stack([look.view.center for look in looks])
    walls = []
    for floor in floors:
        places, far, views, pieces = some_of(_MOST_ENDS, rng, *ends_on(floor, looks))
        normal = planes[floor, :3]
        axes = axes_on(normal)
        begun = places @ axes.T, far, views, pieces
        for line, on_it, seen_by in lines_of(_MOST_LINES, rng, *begun, on_line):
            facing = line[:2] @ axes
            plane = np.append(facing, line[2])
            if _share_behind(centers, plane) > _BEHIND:
                continue
            along = np.cross(normal, facing)
            apart = spread_deg(centers[seen_by] - places[on_it[0]], along)
            if apart >= _LEAST_SPREAD_DEG or (
                apart >= _LEAST_OF_ENDS_DEG and _ends_all(plane, centers, points, depths, planes)
            ):
                some = on_it[:: max(1, len(on_it) // _MOST_PLACES)]
                walls.append(_Wall(plane, floor, places[some], far[some]))
    return walls


def _ends_all(
    plane: Floats, centers: Floats, points: Floats, depths: Floats, planes: Floats
) -> bool:
    """Whether hardly anything is known behind an upright plane with cameras on one side alone.

    points: [N, 3], samples of what is known, with their depths [N]. planes: [P, 4], those known.
    """
    if _share_behind(centers, plane) > _BEHIND:
        return False
    side = np.sign(np.median(centers @ plane[:3] - plane[3]))
    before = side * (points @ plane[:3] - plane[3]) / depths
    behind, on_it = before < -2.0 * ON_PLANE, float((np.abs(before) < ON_PLANE).mean())
    if float(behind.mean()) > max(_MOST_BEHIND, _BEHIND_OF_WALL * on_it):
        return False
    away = np.abs(points[behind] @ planes[:, :3].T - planes[:, 3]) / depths[behind, None]
    on_surface = (away < ON_PLANE).any(axis=1)
    return float(on_surface.sum()) <= _MOST_BEHIND * len(points)


def _share_behind(centers: Floats, plane: Floats) -> float:
    """How many of the cameras are on the side of a wall where fewer are, [0, 0.5]."""
    before = float((centers @ plane[:3] > plane[3]).mean())
    return min(before, 1.0 - before)


def _goes_on(views: Sequence[StereoView], depths: ByView[Depths], wall: _Wall) -> bool:
    """Whether views know the floor beyond a wall's foot: then something merely hid it from others.

    depths: the views' maps.
    """
    centers = np.stack([view.center for view in views])
    away = -np.sign(np.median(centers @ wall.plane[:3] - wall.plane[3]))
    beyond = wall.places + away * _BEYOND * wall.depths[:, None] * wall.plane[:3]
    num_seen = num_floor = 0
    for view, depth in zip(views, depths, strict=True):
        z, row, column = view.seen_at(beyond)
        num_seen += len(z)
        num_floor += int((np.abs(depth[row, column] / z - 1.0) < 2.0 * ON_PLANE).sum())
    return num_floor > _MOST_BEYOND * num_seen


def _with_walls(planes: Floats, walls: Sequence[_Wall], depth: float) -> tuple[Floats, list[int]]:
    """The planes and the walls that are none of them; and of each on which floor it stands, or -1.

    depth: how far away planes and walls may differ by a hundredth to be the same.
    """
    every, stands_on = list(planes), [-1] * len(planes)
    for wall in walls:
        turn = planes[:, :3] @ wall.plane[:3]
        aligned = np.abs(turn) > np.cos(np.radians(_SAME_DEG))
        close = np.abs(planes[:, 3] * np.sign(turn) - wall.plane[3]) < ON_PLANE * depth
        same = np.flatnonzero(aligned & close)
        if len(same):
            stands_on[same[0]] = wall.floor
        else:
            every.append(wall.plane)
            stands_on.append(wall.floor)
    return np.array(every), stands_on


def _laid(look: Look, z: Depths, planes: Floats, stands_on: Sequence[int], ending: Bools) -> Depths:
    """The map [H, W] with its open patches on the planes that their borders touch.

    planes: [P, 4], those known and the walls. stands_on: of each the floor, or -1. ending: [P],
    known walls that end the place. A border touches a plane where the depth that is known next to
    it is the plane's; next to the plane itself that says nothing, as plain things before a floor
    have floor all around them, but of a patch that a wall that ends the place has around itself.
    Where no wall stands on a floor only these are laid.
    Where several planes are touched the patch is a corner: the nearer of them all over, as inside
    of a room, or the farther, as outside of a box, whichever more of the border agrees with.
    """
    laid = z.copy()
    pixels = ray_grid(look.view)
    is_large = np.bincount(look.patches.ravel()) >= _LEAST_OF_WALL * look.patches.size
    at_rim = np.unique(look.patches[_is_rim(look.view.picture >= 0.0)])
    for patch in np.intersect1d(look.plain, look.patch):
        at = look.patch == patch
        depth, own = look.z[at], look.plane[at]
        relative = inverse_depths(look.view, planes, look.x[at], look.y[at]) * depth
        touches = np.abs(relative - 1.0) < 2.0 * ON_PLANE
        around = _goes_around(look.x[at], look.y[at], own, ending)
        around &= bool(is_large[patch]) and patch in at_rim
        if max(stands_on) < 0 and not around.any():
            continue
        says_nothing = (own >= 0) & ~around[own]
        touches[own[says_nothing], np.flatnonzero(says_nothing)] = False
        beneath = (relative < 1.0 - 2.0 * ON_PLANE) & (own == np.array(stands_on)[:, None])
        beneath &= own >= 0
        chosen = _touched(touches, relative, beneath)
        if not chosen:
            continue
        inverse = inverse_depths(look.view, planes[chosen], *pixels)
        found = inverse.max(axis=0)
        if _agreeing(_farther(relative[chosen])) > _agreeing(relative[chosen].max(axis=0)):
            found = _farther(inverse)
        fits = (look.patches == patch) & (look.view.picture >= 0.0)
        fits &= replaceable(z, found)
        fits &= (found > (1.0 / depth).min() / _EXTRAPOLATED) & (
            found < _EXTRAPOLATED * (1.0 / depth).max()
        )
        for floor in {stands_on[plane] for plane in chosen} - {-1}:
            ground = inverse_depths(look.view, planes[[floor]], *pixels)[0]
            fits &= (ground <= 1e-9) | (found >= (1.0 - 2.0 * ON_PLANE) * ground)
        laid[fits] = (1.0 / found[fits]).astype(np.float32)
    return laid


def _is_rim(usable: Bools) -> Bools:
    """[H, W]: the usable pixels that have one beyond the picture or of no use some pixels away."""
    reach = _RIM_PX
    padded = np.pad(usable, reach)
    inner = padded[reach:-reach, 2 * reach :] & padded[reach:-reach, : -2 * reach]
    inner &= padded[2 * reach :, reach:-reach] & padded[: -2 * reach, reach:-reach]
    return usable & ~inner


def _goes_around(x: Floats, y: Floats, own: Numbers, ending: Bools) -> Bools:
    """[P]: of walls that end the place, those that a border is next to not along one line alone,
    as the border of the next wall is.

    x, y, own: [K], places of the border, and the planes that are next to them, or -1.
    """
    on = own >= 0
    enough = np.bincount(own[on], minlength=len(ending)) >= _TOUCH_PX
    around: Bools = ending & enough & (roundness(own[on], x[on], y[on], len(ending)) > ON_A_LINE)
    return around


def _farther(inverse: Floats) -> Floats:
    """Of planes [C, ...] the one behind the others, as far as all are before the camera."""
    least: Floats = inverse.min(axis=0)
    return np.where(least > 0.0, least, inverse.max(axis=0))


def _touched(touches: Bools, relative: Floats, beneath: Bools) -> list[int]:
    """The planes that explain the border of a patch, at most three.

    touches: [P, K]. relative: [P, K], the known depth next to the border by the plane's; where it
    is above 1 the patch would hide what is known, which walls rarely do. beneath: [P, K], whether
    it would be below the floor that it stands on, as walls are, in corners, beyond the next one.
    """
    left = np.ones(touches.shape[1], bool)
    least = max(_TOUCH_PX, _TOUCH_SHARE * touches.shape[1])
    chosen: list[int] = []
    refused = np.zeros(len(touches), bool)
    while len(chosen) < _MOST_TOUCHED:
        count = np.where(refused, 0, (touches & left).sum(axis=1))
        plane = int(count.argmax())
        if count[plane] < least:
            break
        hides = int(((relative[plane] > 1.0 + 2.0 * ON_PLANE) & left).sum())
        if count[plane] < max(hides, _BENEATH_WEIGHT * (beneath[plane] & left).sum()):
            refused[plane] = True
            continue
        chosen.append(plane)
        left &= ~touches[plane]
    return chosen


def _agreeing(relative: Floats) -> int:
    return int((np.abs(relative - 1.0) < 2.0 * ON_PLANE).sum())
