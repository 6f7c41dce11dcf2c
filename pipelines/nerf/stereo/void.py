"""Where pictures show that nothing stands: the sky, the dark.

Depth is along the camera's axis (z), 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.agreement import AGREE, SEE_THROUGH
from pipelines.nerf.stereo.engines import KERNELS, Engine
from pipelines.nerf.stereo.maps import VOID, DepthMap, MapShelf, surface_points, votes_of_others
from pipelines.nerf.stereo.neighbours import choose_neighbours
from pipelines.nerf.stereo.patch_colors import Bools, shrunk
from pipelines.nerf.stereo.shelves import MEMORY, Shelves
from pipelines.nerf.stereo.views import StereoView

_MOST_MEASURED = 0.2
"""A sensor measures no more of it."""
RIM_PX = 1
"""Pixels of a mask so near to its border may show what stands before it."""
_BEHIND_ALL = 1e3
"""How far what is nothing is to be thought of, in the largest depth that is known."""


def is_measured(
    masks: Sequence[Bools], measured: Sequence[NDArray[np.float32] | None] | None
) -> bool:
    """Whether a sensor sees too much there for it to be nothing. measured: its depths, by view."""
    if measured is None:
        return False
    seen = [z[mask] > 0 for mask, z in zip(masks, measured, strict=True) if z is not None]
    known = np.concatenate([np.zeros(0, np.bool_), *seen])
    return len(known) > 0 and bool(known.mean() > _MOST_MEASURED)


def without(
    masks: Sequence[Bools],
    views: Sequence[StereoView],
    maps: MapShelf,
    config: StereoConfig,
    on_share: Callable[[float], None] = lambda done: None,
    engine: Engine = KERNELS,
    shelves: Shelves = MEMORY,
) -> MapShelf:
    """The maps with nothing where the masks are, nor where more neighbours look through a depth
    at what is masked in them than agree with it.

    masks: [H, W] of each view. Their pixels, but for those at their rims, have `VOID` for votes.
    on_share: told the share that is done; may raise.
    """
    void = [shrunk(mask, RIM_PX) for mask in masks]
    cleared = shelves.scratch("without void", len(views))
    beyond = shelves.scratch("void alone", len(views))
    farthest = np.float32(_BEHIND_ALL * max(float(z.max(initial=0.0)) for z in maps.z))
    for index, z in enumerate(maps.z):
        cleared[index] = np.where(masks[index], np.float32(0.0), z)
        beyond[index] = np.where(void[index], farthest, np.float32(0.0))
    seen = surface_points(views, cleared)
    neighbours = choose_neighbours(views, seen, config.num_neighbours, config.best_angle_deg)
    kept = MapShelf.kept(shelves, "void", len(views), fresh=True)
    for index in range(len(views)):
        given = index, views, cleared, neighbours[index], config, engine
        agree = votes_of_others(cleared[index], *given)[0][AGREE]
        given = index, views, beyond, neighbours[index], config, engine
        through = votes_of_others(cleared[index], *given)[0][SEE_THROUGH]
        stays = (cleared[index] > 0) & (through <= agree)
        told = np.where(stays, maps[index].votes, 0)
        kept[index] = DepthMap(
            np.where(stays, cleared[index], np.float32(0.0)),
            np.where(void[index], VOID, told).astype(np.uint8),
        )
        on_share((index + 1) / len(views))
    return kept
