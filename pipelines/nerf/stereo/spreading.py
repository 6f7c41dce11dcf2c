"""Walls that stand in some views, handed on to the views that do not show their foot.

Things stand before a wall: in some views its line with the floor is hidden, and its plain patch
there touches nothing that tells where it is. The views that do show the line know the wall, and see
the same place. So each plain patch asks its neighbours which wall they have where it would be.

Symbols as in `stereo.planes`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.agreement import AGREE, SEE_THROUGH
from pipelines.nerf.stereo.engines import KERNELS, Engine
from pipelines.nerf.stereo.maps import DepthMap, MapShelf, votes_of_others
from pipelines.nerf.stereo.patches import Labels
from pipelines.nerf.stereo.planes import ON_PLANE, Floats, inverse_depths, ray_grid
from pipelines.nerf.stereo.shelves import ByView
from pipelines.nerf.stereo.views import StereoView

Depths = NDArray[np.float32]
Bools = NDArray[np.bool_]
Votes = NDArray[np.int32]

MOST_KNOWN = 0.5
"""A plain patch is open while no more of it is known."""
_PER_REFUSAL = 2
_LEAST_LAID, _LEAST_VIEWS, _SAME_PLACE = 0.03, 3, 1e-3
"""A wall is handed on where it was laid on so much of so many pictures. A line that was taken for
a wall's by mistake lays a few pixels in a few views, and would be handed on to many times more."""
_LEAST_SEEN, _LEAST_VOTES, _KNOWS, _STEP = 0.5, 0.25, 0.05, 2
"""Of a patch that is laid, half has to be wall for the neighbours that see the place, and a quarter
of a vote a pixel be cast. Whoever sees less of the wall there than a twentieth is not asked. Every
other pixel is asked for.

Films of the analytic rooms get the same maps without that half; it is what keeps a board
that hangs before a wall off it."""


@dataclass(frozen=True)
class PlainPatches:
    """A view with its patches [H, W], and the numbers of those that are plain."""

    view: StereoView
    patches: Labels
    plain: NDArray[np.int64]


def refutes(agree: Votes, through: Votes) -> Bools:
    """[H, W]: whether neighbours refuse a guess: none agrees, or too many see through it."""
    refused: Bools = agree < np.maximum(1, _PER_REFUSAL * through)
    return refused


def replaceable(z: Depths, inverse: Floats) -> Bools:
    """[H, W]: where a plain patch on a wall, 1 / z of which is `inverse`, may be laid.

    Where nothing is known, and where something nearer is: what stands before a wall seems to be a
    little larger than it is, as matching takes squares of pixels. Of plain pixels nothing else can
    be known.
    """
    # An unknown pixel has z = 0.
    may: Bools = z * inverse < 1.0 - 2.0 * ON_PLANE
    return may


def spread(
    looks: Sequence[PlainPatches],
    before: ByView[DepthMap],
    maps: MapShelf,
    walls: Floats,
    neighbours: Sequence[Sequence[int]],
    config: StereoConfig,
    on_progress: Callable[[float], None] = lambda fraction: None,
    engine: Engine = KERNELS,
) -> MapShelf:
    """The maps with plain patches on the walls that their neighbours see there, on their shelf.

    before: the maps without walls. walls: [P, 4]. Each view is asked twice, there and back, so that
    a wall goes all the way along a film. on_progress: told the share that is done; may raise.
    """
    walls = walls[_well_laid(looks, before, maps, walls)]
    views = [look.view for look in looks]
    order = [*range(len(looks)), *reversed(range(len(looks)))] if len(walls) else []
    for done, index in enumerate(order, start=1):
        look, z = looks[index], maps.z[index]
        num = int(look.patches.max()) + 1
        known = np.bincount(look.patches[z > 0], minlength=num)
        left = np.zeros(num, np.bool_)
        left[look.plain] = True
        left &= known < MOST_KNOWN * np.bincount(look.patches.ravel(), minlength=num)
        laid = _on_walls(index, views, look, maps.z, walls, left, neighbours[index], config, engine)
        if laid is not None:
            new, votes = laid
            votes = np.where(new != z, votes, maps.votes[index])
            maps[index] = DepthMap(new, votes.astype(np.uint8))
        on_progress(done / len(order))
    on_progress(1.0)
    return maps


def _well_laid(
    looks: Sequence[PlainPatches],
    before: ByView[DepthMap],
    maps: ByView[DepthMap],
    walls: Floats,
) -> Bools:
    """[P]: which walls were laid on a good part of some pictures."""
    num_views = np.zeros(len(walls), np.int64)
    for look, old, new in zip(looks, before, maps, strict=True):
        off = np.abs(inverse_depths(look.view, walls, *ray_grid(look.view)) * new.z - 1.0)
        laid = (new.z > 0) & (new.z != old.z) & (off < _SAME_PLACE)
        num_views += laid.mean(axis=(1, 2)) >= _LEAST_LAID
    well: Bools = num_views >= _LEAST_VIEWS
    return well


def _on_walls(
    index: int,
    views: Sequence[StereoView],
    look: PlainPatches,
    depths: ByView[Depths],
    walls: Floats,
    left: Bools,
    neighbours: Sequence[int],
    config: StereoConfig,
    engine: Engine,
) -> tuple[Depths, Votes] | None:
    """A view's map with the patches `left` [N] on walls that neighbours see, and how many of them.

    None where there are none.
    """
    if not left.any():
        return None
    z, free = depths[index], left[look.patches] & (look.view.picture >= 0.0)
    inverses = inverse_depths(look.view, walls, *ray_grid(look.view))
    others = [(views[other], depths[other]) for other in neighbours]
    shares = [_share_seen(look, free, len(left), one, others, config) for one in inverses]
    best, most = np.argmax(shares, axis=0), np.max(shares, axis=0)
    wanted = left & (most >= _LEAST_SEEN)
    if not wanted.any():
        return None
    inverse = np.take_along_axis(inverses, best[look.patches][None], axis=0)[0]
    at = free & wanted[look.patches] & (inverse > 1e-9) & replaceable(z, inverse)
    guess = np.where(at, 1.0 / np.where(at, inverse, 1.0), 0.0).astype(np.float32)
    votes, _ = votes_of_others(guess, index, views, depths, neighbours, config, engine)
    taken = at & ~refutes(votes[AGREE], votes[SEE_THROUGH])
    laid: Depths = np.where(taken, guess, z)
    return laid, votes[AGREE]


def _share_seen(
    look: PlainPatches,
    free: Bools,
    num: int,
    inverse: Floats,
    others: Sequence[tuple[StereoView, Depths]],
    config: StereoConfig,
) -> Floats:
    """[N]: how much of each patch, were it on a wall, is that wall for those who see the place.

    free: [H, W], the pixels that count. inverse: [H, W], 1 / z of the wall. others: neighbours with
    their maps. What something hides from a neighbour does not count; what it does not know does, or
    a plain thing before the wall would be laid on it, as neighbours look past it on one side.
    """
    rows, columns = np.nonzero(free[::_STEP, ::_STEP] & (inverse[::_STEP, ::_STEP] > 1e-9))
    rows, columns = rows * _STEP, columns * _STEP
    x, y = ray_grid(look.view)
    rays = np.stack([x[columns], y[rows, 0], np.ones(len(rows))])
    place, patch = rays / inverse[rows, columns], look.patches[rows, columns]
    seen, agreeing = np.zeros(num), np.zeros(num)
    for view, depth in others:
        pose = view.from_other(look.view)
        there = pose[:, :3] @ place + pose[:, 3:]
        fx, fy, cx, cy = view.lens
        height, width = depth.shape
        ahead = there[2] > 1e-9
        z = np.where(ahead, there[2], 1.0)
        u, v = fx * there[0] / z + cx, fy * there[1] / z + cy
        ahead &= (u >= 0) & (v >= 0) & (u < width) & (v < height)
        known = depth[np.where(ahead, v, 0).astype(int), np.where(ahead, u, 0).astype(int)]
        gap = known / z - 1.0
        agrees = ahead & (np.abs(gap) <= config.agree_within)
        hidden = (known > 0) & (gap < -config.agree_within)
        asked = np.bincount(patch[ahead & ~hidden], minlength=num)
        agreed = np.bincount(patch[agrees], minlength=num)
        knows = agreed > _KNOWS * asked
        seen += np.where(knows, asked, 0)
        agreeing += np.where(knows, agreed, 0)
    size = np.bincount(patch, minlength=num)
    enough = agreeing >= _LEAST_VOTES * np.maximum(size, 1)
    share: Floats = np.where(enough, agreeing / np.maximum(seen, 1.0), 0.0)
    return share
