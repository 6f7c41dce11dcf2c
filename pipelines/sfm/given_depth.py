"""Points of matched features beside the depth that a sensor measured: its scale, and how well both
agree.

Only places count where both can be right: where the sensor sees one surface (at the edges of things
it mixes the near and the far one into depths that nothing has), and where pictures see a point from
directions that tell how far away it is.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from scipy.ndimage import maximum_filter, minimum_filter

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.lens_places import rays_of, through
from pipelines.scene.sensor_depth import Depths, load_sensor_depth
from pipelines.sfm.given_refinement import Refined
from pipelines.sfm.tracks import Floats, apart_deg

ShownBy = Literal["picture", "given", "own"]

FEWEST = 100
"""Places compared, for the result to mean anything."""
FEWEST_IMAGES = 5
_OF_IMAGE = 5
_ONE_SURFACE = 0.05
"""By how much depths of a pixel and its eight neighbours may differ, as a share, where they are
taken for one surface's: one that is seen from 70 degrees aside changes by less from pixel to pixel
of 256 across."""
_APART_DEG = 0.75


@dataclass(frozen=True)
class Beside:
    """Points beside measured depth.

    ratio: how many times as far away as measured points are, the median. spread: the median
    deviation from that, as a share. depth: of the places, median, world units. num_images: in which
    such places are. shown_by: which lens measured depth was taken to be seen through: the image's,
    the one that came along with it, where that is another by now, or one of its own.
    """

    ratio: float
    spread: float
    depth: float
    num_places: int
    num_images: int
    shown_by: ShownBy = "picture"


def points_beside(
    found: Refined,
    given: Sequence[Intrinsics],
    depths: Sequence[Path | None],
    stated: Sequence[Intrinsics | None] = (),
) -> Beside | None:
    """What the sensor says of points; None where too few places have both.

    given: N lenses, as they came. Where others fit by now, measured depth may be what either shows:
    what agrees better is taken. depths: N, the maps of `pipelines.scene.sensor_depth`; those that
    cannot be read count as none. stated: N lenses of these maps, where the capture tells them; None
    for what its image's lens shows.
    """
    if any(stated):
        lenses = [own or lens for own, lens in zip(stated, found.lenses, strict=True)]
        ways: dict[ShownBy, Floats] = {"own": _places_by(lenses, found)}
    else:
        ways = {"picture": found.seen.xy}
        if tuple(given) != found.lenses:
            ways["given"] = _places_by(given, found)
    told = [beside for beside in _beside(found, ways, depths) if beside is not None]
    return min(told, key=lambda beside: beside.spread, default=None)


def _places_by(given: Sequence[Intrinsics], found: Refined) -> Floats:
    """Where the given lenses would show what is seen, [K, 2]."""
    places = np.full((len(found.seen.track), 2), np.nan)
    for image in np.unique(found.seen.image).tolist():
        mine = found.seen.image == image
        rays = rays_of(found.lenses[image], found.seen.xy[mine])
        places[mine] = through(given[image], rays)
    return places


def _beside(
    found: Refined, ways: Mapping[ShownBy, Floats], depths: Sequence[Path | None]
) -> list[Beside | None]:
    """Points beside depth, by each way to read it: the places of what is seen, [K, 2], pixels."""
    apart = apart_deg(found.seen, found.points, found.poses)
    read: dict[ShownBy, list[tuple[Floats, Floats]]] = {shown_by: [] for shown_by in ways}
    for image, path in enumerate(depths):
        mine = np.flatnonzero(found.seen.image == image)
        mine = mine[apart[found.seen.track[mine]] >= _APART_DEG]
        if path is None or not len(mine):
            continue
        try:
            measured = one_surface(load_sensor_depth(path))
        except ValueError:
            continue
        pose, lens = found.poses[image], found.lenses[image]
        z = (found.points[found.seen.track[mine]] - pose[:, 3]) @ pose[:, 2]
        height, width = measured.shape
        for shown_by, places in ways.items():
            there = np.zeros(len(mine))
            inside = ((places[mine] >= 0) & (places[mine] < (lens.width, lens.height))).all(axis=1)
            scaled = places[mine[inside]] * (width / lens.width, height / lens.height)
            there[inside] = between(measured, scaled)
            known = (there > 0) & (z > 0)
            read[shown_by].append((z[known], there[known]))
    return [_told(shown_by, rows) for shown_by, rows in read.items()]


def _told(shown_by: ShownBy, rows: Sequence[tuple[Floats, Floats]]) -> Beside | None:
    """What depth of points and measured depth, image by image, say."""
    num_images = sum(len(there) >= _OF_IMAGE for _, there in rows)
    if sum(len(there) for _, there in rows) < FEWEST or num_images < FEWEST_IMAGES:
        return None
    z, there = (np.concatenate(values) for values in zip(*rows, strict=True))
    ratios = np.log(z / there)
    middle = float(np.median(ratios))
    return Beside(
        ratio=float(np.exp(middle)),
        spread=float(np.median(np.abs(ratios - middle))),
        depth=float(np.median(there)),
        num_places=len(ratios),
        num_images=num_images,
        shown_by=shown_by,
    )


def one_surface(z: Depths) -> Depths:
    """The depths [h, w] that all eight neighbours share, as far as one surface may slope; 0 of
    others, of those without a neighbour that is known, and at the border."""
    far = maximum_filter(z, 3, mode="constant", cval=0.0)
    near = minimum_filter(z, 3, mode="constant", cval=0.0)
    return np.where((near > 0) & (far <= (1.0 + _ONE_SURFACE) * near), z, np.float32(0.0))


def between(z: Depths, xy: Floats) -> Floats:
    """Depths [K] at places xy [K, 2] of the map, pixel centres at halves, interpolated between the
    four pixels around; 0 where one of them is not known. Inverse depths are interpolated, which
    are linear in the picture of a plane."""
    height, width = z.shape
    with np.errstate(divide="ignore"):
        inverse = np.where(z > 0, 1.0 / z.astype(np.float64), np.nan)
    x, y = (xy - 0.5).T
    left = np.clip(np.floor(x).astype(np.int64), 0, max(width - 2, 0))
    top = np.clip(np.floor(y).astype(np.int64), 0, max(height - 2, 0))
    right, below = np.minimum(left + 1, width - 1), np.minimum(top + 1, height - 1)
    u, v = np.clip(x - left, 0.0, 1.0), np.clip(y - top, 0.0, 1.0)
    mixed = (1 - v) * ((1 - u) * inverse[top, left] + u * inverse[top, right]) + v * (
        (1 - u) * inverse[below, left] + u * inverse[below, right]
    )
    found: Floats = np.where(np.isfinite(mixed) & (mixed > 0), 1.0 / mixed, 0.0)
    return found
