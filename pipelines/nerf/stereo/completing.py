"""Plain surfaces, which nothing can match, completed by what the whole scene shows.

Planes that many known points lie on (`stereo.planes`), then table tops of which hardly more than
the rim is known (`stereo.tops`). Symbols as in `stereo.planes`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.ahead import each_ahead
from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.agreement import AGREE, SEE_THROUGH
from pipelines.nerf.stereo.engines import KERNELS, Engine
from pipelines.nerf.stereo.maps import (
    DepthMap,
    MapShelf,
    Progress,
    depths_of,
    surface_points,
    votes_of_others,
)
from pipelines.nerf.stereo.neighbours import choose_neighbours
from pipelines.nerf.stereo.patches import Labels, even_patches, shelved_patches
from pipelines.nerf.stereo.planes import (
    ON_PLANE,
    Depths,
    Floats,
    floors_of,
    laid_on_planes,
    planes_and_samples,
    up_of,
)
from pipelines.nerf.stereo.shelves import MEMORY, ByView, Shelf, Shelves
from pipelines.nerf.stereo.tops import Rims, laid_on_tops, upwards
from pipelines.nerf.stereo.views import StereoView

_SAMPLES_SHARE, _LAID_SHARE, _TOPS_SHARE = 0.2, 0.55, 0.7
"""Of the progress, at the end of each part; the votes come last."""
_MESSAGE = "completing plain surfaces"


def completed(
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
    """The maps with their plain patches on the planes and table tops of the scene.

    Depths within 1 % of their patch's plane move onto it; unknown pixels of the patch get its depth
    unless more neighbours see through it than agree. All others stay as they are, but for those on
    table tops that are their surroundings' (`laid_on_tops`). patches: a shelf for the pictures'
    `patches_of`, or with them. up: [3], unit, where it is known better than pictures tell.
    """
    planes, points, depths = planes_and_samples(
        views, maps, lambda f: on_progress(_SAMPLES_SHARE * f, _MESSAGE)
    )
    if len(planes) == 0:
        return maps

    def share_done(begin: float, end: float, share: float) -> None:
        on_progress(begin + (end - begin) * share, _MESSAGE)

    filled = shelves.scratch("on planes", len(views))

    def lay(index: int) -> None:
        parts = shelved_patches(views[index], index, patches)
        filled[index] = laid_on_planes(views[index], maps[index].z, planes, parts)

    for index, _ in enumerate(each_ahead(lay, range(len(views)))):
        share_done(_SAMPLES_SHARE, _LAID_SHARE, (index + 1) / len(views))
    up = up_of(views) if up is None else up
    normal = upwards(up, planes) if config.level_tops else None
    if normal is not None:
        on_share = partial(share_done, _LAID_SHARE, _TOPS_SHARE)
        floors = planes[floors_of(up, planes, points, depths)]
        _lay_on_tops(views, depths_of(maps), (normal, floors), filled, patches, on_share)
    seen = surface_points(views, depths_of(maps))
    neighbours = choose_neighbours(views, seen, config.num_neighbours, config.best_angle_deg)
    return confirmed(
        views,
        maps,
        filled,
        neighbours,
        config,
        lambda agree, through: agree < through,
        partial(share_done, _TOPS_SHARE, 1.0),
        engine,
        MapShelf.kept(shelves, "planes", len(views), fresh=True),
    )


def confirmed(
    views: Sequence[StereoView],
    maps: ByView[DepthMap],
    filled: ByView[Depths],
    neighbours: Sequence[Sequence[int]],
    config: StereoConfig,
    refutes: Callable[[NDArray[np.int32], NDArray[np.int32]], NDArray[np.bool_]],
    on_progress: Callable[[float], None],
    engine: Engine,
    kept: MapShelf,
    patches: Callable[[int], Labels] | None = None,
) -> MapShelf:
    """The filled maps, as the maps were where neighbours refute a depth that is new, on `kept`.

    refutes: of the numbers of neighbours, [H, W] each, that agree and that see through.
    on_progress: told the share that is done; may raise. patches: of each view, [H, W], those that
    are refuted as a whole where neighbours see through more of one than they agree on: beyond what
    these show it would hang as a rag.
    """
    for index, found in enumerate(maps):
        votes, _ = votes_of_others(
            filled[index], index, views, filled, neighbours[index], config, engine
        )
        moved = np.abs(filled[index] - found.z) > 2.0 * ON_PLANE * found.z
        guessed = (filled[index] > 0) & moved
        refuted = guessed & refutes(votes[AGREE], votes[SEE_THROUGH])
        if patches is not None:
            labels = patches(index)
            num = int(labels.max()) + 1
            through = np.bincount(labels[refuted & (votes[SEE_THROUGH] > 0)], minlength=num)
            agreed = np.bincount(labels[guessed & ~refuted], minlength=num)
            refuted |= guessed & (through > agreed)[labels]
        kept[index] = DepthMap(
            np.where(refuted, found.z, filled[index]),
            np.where(guessed & ~refuted, votes[AGREE], found.votes).astype(np.uint8),
        )
        on_progress((index + 1) / len(views))
    return kept


def _lay_on_tops(
    views: Sequence[StereoView],
    depths: ByView[Depths],
    floor: tuple[Floats, Floats],
    filled: Shelf,
    patches: Shelf | None,
    on_share: Callable[[float], None],
) -> None:
    """Lay maps on table tops, if there are any; what changes goes onto the shelf `filled`.

    floor: what `Rims.tops` is told of it.
    """

    def even(index: int) -> Labels:
        return even_patches(views[index].picture, shelved_patches(views[index], index, patches))

    rims = Rims()
    parts = each_ahead(even, range(len(views)))
    for index, (view, z, labels) in enumerate(zip(views, depths, parts, strict=True)):
        rims.add(view, z, labels)
        on_share(0.5 * (index + 1) / len(views))
    tops = rims.tops(*floor)
    if len(tops) == 0:
        return

    def lay(index: int) -> None:
        z = depths[index]
        laid = laid_on_tops(views[index], z, tops, even(index))
        filled[index] = np.where(laid != z, laid, filled[index])

    for index, _ in enumerate(each_ahead(lay, range(len(views)))):
        on_share(0.5 + 0.5 * (index + 1) / len(views))
