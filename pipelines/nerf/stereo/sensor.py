"""Depth of a sensor beside that of stereo: brought to one scale, cross-examined, merged.

A sensor knows plain surfaces, which stereo cannot match, and smears edges; stereo is the finer one
where there is texture. Maps are [H, W] along the camera's axis, world units, 0 where unknown.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.options.stereo import StereoConfig
from pipelines.nerf.stereo.agreement import AGREE, SEE_THROUGH
from pipelines.nerf.stereo.engines import KERNELS, Engine
from pipelines.nerf.stereo.maps import DepthMap, MapShelf, surface_points, votes_of_others
from pipelines.nerf.stereo.neighbours import choose_neighbours
from pipelines.nerf.stereo.shelves import MEMORY, ByView, Shelves
from pipelines.nerf.stereo.views import StereoView

Depths = NDArray[np.float32]
Floats = NDArray[np.float64]

_WITHIN = 2.0
"""How much farther apart than stereo's depths two of a sensor may be and agree: poses drift."""
_MIN_SHARED = 1000
_MOST_SPREAD = 0.05
_SAME_SCALE = 0.01
_OUTSIDE = 1.5
_SAME_SURFACE = 0.05


@dataclass(frozen=True)
class SensorScale:
    """What a sensor's depths must be multiplied by to be in the cameras' unit.

    factor: 1 where they are, or where too little tells. spread: half the distance of the quartiles
    of depth ratios, relative; None where both know less than 1,000 pixels in common.
    """

    factor: float
    spread: float | None


def sensor_scale(stereo: ByView[DepthMap], sensed: Sequence[Depths | None]) -> SensorScale:
    """Compare the maps of both where both know a pixel.

    Only ratios that hold together count (spread up to 5 %), and only beyond 1 % and one and a half
    times their spread: less may be stereo's own error.
    """
    ratios = [
        np.log(found.z[both] / z[both])
        for found, z in zip(stereo, sensed, strict=True)
        if z is not None and (both := (found.z > 0) & (z > 0)).any()
    ]
    if sum(len(item) for item in ratios) < _MIN_SHARED:
        return SensorScale(1.0, None)
    low, middle, high = np.percentile(np.concatenate(ratios), (25.0, 50.0, 75.0))
    spread = float(high - low) / 2.0
    trusted = spread <= _MOST_SPREAD and abs(middle) > max(_SAME_SCALE, _OUTSIDE * spread)
    return SensorScale(float(np.exp(middle)) if trusted else 1.0, spread)


def sensor_maps(
    views: Sequence[StereoView],
    sensed: Sequence[Depths | None],
    config: StereoConfig,
    engine: Engine = KERNELS,
    shelves: Shelves = MEMORY,
) -> MapShelf:
    """The sensor's maps without what other views' sensors contradict; averaged where they agree.

    A sensor measures, stereo guesses: a depth that nobody else can speak of is kept, as nearly all
    are where somebody walks through a corridor. Else more must agree than see through it. Who sees
    something before it cannot speak of it.
    """
    points = surface_points(views, sensed)
    neighbours = choose_neighbours(views, points, config.num_neighbours, config.best_angle_deg)
    config = replace(config, agree_within=_WITHIN * config.agree_within)
    maps = [
        np.zeros(view.picture.shape, np.float32) if z is None else z
        for view, z in zip(views, sensed, strict=True)
    ]
    kept = MapShelf.kept(shelves, "measured", len(views), fresh=True)
    for index, z in enumerate(maps):
        votes, sums = votes_of_others(z, index, views, maps, neighbours[index], config, engine)
        agreeing = votes[AGREE]
        believed = (z > 0) & (
            (agreeing > votes[SEE_THROUGH]) | (votes[[AGREE, SEE_THROUGH]].sum(axis=0) == 0)
        )
        mean = np.where(believed, (z + sums) / (1.0 + agreeing), 0.0).astype(np.float32)
        kept[index] = DepthMap(mean, np.where(believed, agreeing, 0).astype(np.uint8))
    return kept


def merged_maps(
    stereo: ByView[DepthMap], measured: ByView[DepthMap], shelves: Shelves = MEMORY
) -> MapShelf:
    """Both maps of each view as one; see `merged`."""
    both = MapShelf.kept(shelves, "merged", len(stereo), fresh=True)
    for index, (one, other) in enumerate(zip(stereo, measured, strict=True)):
        both[index] = merged(one, other)
    return both


def merged(stereo: DepthMap, sensor: DepthMap) -> DepthMap:
    """Stereo's depths where the sensor says about the same or nothing, else the sensor's.

    Stereo is the finer one, and it is the one that errs by much: on reflections and plain surfaces.
    """
    both = (stereo.z > 0) & (sensor.z > 0)
    far_off = both & (np.abs(stereo.z - sensor.z) > _SAME_SURFACE * sensor.z)
    by_stereo = (stereo.z > 0) & ~far_off
    return DepthMap(
        np.where(by_stereo, stereo.z, sensor.z),
        np.where(by_stereo, stereo.votes, sensor.votes),
    )
