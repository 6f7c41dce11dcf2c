"""Points off the surface that all views made, judged by that surface and by the photos.

What a trained scene has floating in the air its views agree on, so `scene.consistency` lets it
pass. But the photos do not have it where their cameras should see it. And the surface is fused with
votes and carved: where many cameras see it behind a point, the air before it was found to be free,
or holds something too thin for it, of which only colours tell.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.surface.sight import Sight
from pipelines.exports.surface.surface_file import KeptSurface
from pipelines.scene.stereo_views import ColorView

Floats = NDArray[np.floating[Any]]

_BEFORE = 1.05
"""Of its distance: the surface is behind a point from there on; short of 1 / that it hides it."""
_FEWEST, _FEW = 2, 0.1
"""Photos, and of those that see a point, before whose surface it hangs."""
_ALIKE = 38
"""Of 255, in each channel: a point's colour and a photo's are of the same thing."""
_LEAST_ALIKE, _LEAST_ALIKE_BEFORE = 0.5, 0.8
"""Of the photos that see a point: so many have its colour, and so many if it hangs."""


def strays(
    points: Floats,
    colors: NDArray[np.uint8],
    surface: KeptSurface,
    photos: Iterable[ColorView],
) -> NDArray[np.bool_]:
    """Which points [P, 3], world, with colours [P, 3], no photos support: [P].

    A photo sees a point if it lies in it and the surface is not before it by more than 5 % of its
    distance. Points stay where half of the photos that see them have their colour there; of those
    that hang before the surface in more than a tenth of them, where four fifths do. What no
    photo sees goes.
    """
    sight = Sight(surface.vertices, surface.faces)
    local = np.asarray(points, np.float64) - surface.origin
    seen, alike, before = (np.zeros(len(points), np.int32) for _ in range(3))
    for photo in photos:
        eye = photo.world_from_camera[:, 3] - surface.origin
        which, row, column = _shown(photo, local - eye)
        if len(which) == 0:
            continue
        distance, _, _ = sight.met(eye, local[which] - eye)
        in_sight = distance >= 1.0 / _BEFORE
        which, behind = which[in_sight], distance[in_sight]
        there = photo.picture[row[in_sight], column[in_sight]].astype(np.int16)
        seen[which] += 1
        alike[which] += (np.abs(there - colors[which]) <= _ALIKE).all(axis=1)
        before[which] += (behind > _BEFORE) & np.isfinite(behind)
    hang = (before >= _FEWEST) & (before > _FEW * seen)
    least = np.where(hang, _LEAST_ALIKE_BEFORE, _LEAST_ALIKE)
    lost: NDArray[np.bool_] = (seen == 0) | (alike < least * seen)
    return lost


def _shown(
    photo: ColorView, ways: Floats
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """What of directions [P, 3] from its camera a photo shows: which, rows, columns, [S] each."""
    lens = photo.lens
    x, y, z = (ways @ photo.world_from_camera[:, :3]).T
    depth = np.where(z < 0.0, -z, np.inf)
    u, v = lens.cx + lens.fl_x * x / depth, lens.cy - lens.fl_y * y / depth
    inside = (z < 0.0) & (u >= 0) & (u < lens.width) & (v >= 0) & (v < lens.height)
    which = np.flatnonzero(inside)
    row, column = v[which].astype(np.int64), u[which].astype(np.int64)
    usable = photo.usable[row, column]
    return which[usable], row[usable], column[usable]
