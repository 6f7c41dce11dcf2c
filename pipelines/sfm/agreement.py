"""Do poses agree with what pictures show? The evidence by which one model is believed over another.

A model can hold all pictures with small reprojection errors and be wrong as a whole: errors count
only the observations that it kept (docs/poses.md has a case of 50 photos). What it had to drop
tells: a verified match is two rays, and under right poses they meet, in front of both cameras.

Symbols: M matches of a pair. Rays are in camera axes of OpenCV (+Z forward), unit length. Whatever
the lens, errors are angles, told in diagonals of the picture as they are near its middle.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipelines.scene.cameras_file import Intrinsics
from pipelines.tools.colmap_rays import px_per_radian, rays_through
from pipelines.tools.colmap_results import SparseModel

Floats = npt.NDArray[np.float64]
Matches = Mapping[tuple[int, int], tuple[Floats, Floats]]
"""Verified matches by pairs of indices: places in pixels in the one and the other, [M, 2] each."""

NEAR = 4e-3
"""In diagonals, how far from its line a match may lie to fit. COLMAP verifies matches up to 4
pixels, which is as much of a picture of 960."""
LITTLE = 0.5
"""Agreement below which poses are in doubt."""
MUCH = 0.8
"""Agreement from which what is left of a model is right, once single images are taken out."""
_FEWEST_OF_IMAGE = 2
"""Pairs of an image below which nothing is said of it alone."""
_MOST_WRONG = 0.25
"""Share of the images that may be wrong in a model that is right."""
MOST_PAIRS, MOST_MATCHES = 2000, 60
"""Looked at, evenly picked."""
FEWEST_PAIRS, FEWEST_MATCHES = 3, 15
_FULL_WEIGHT = 60
"""Matches from which a pair counts as much as any: neighbours have many, and are right in most
wrong models; pairs that see the same from far apart have few, and tell."""
_PARALLEL_RAD = 0.01
"""Rays that differ by less meet too far away to tell before from behind."""


def fitting(
    world_from_camera: tuple[Floats, Floats],
    lenses: tuple[Intrinsics, Intrinsics],
    places: tuple[Floats, Floats],
) -> npt.NDArray[np.bool_]:
    """Which matches of a pair two poses can be right about, [M].

    world_from_camera: [3, 4] each, OpenCV axes. places: [M, 2] each, in pixels. A place that the
    lens cannot show fits nothing; two cameras in one place fit where rays are parallel.
    """
    near_rad = NEAR * min(np.hypot(o.width, o.height) / px_per_radian(o) for o in lenses)
    off_rad, is_before = off_lines(world_from_camera, lenses, places)
    return np.asarray((off_rad <= near_rad) & is_before)


def off_lines(
    world_from_camera: tuple[Floats, Floats],
    lenses: tuple[Intrinsics, Intrinsics],
    places: tuple[Floats, Floats],
) -> tuple[Floats, npt.NDArray[np.bool_]]:
    """By what angle the rays of a pair's matches miss each other, [M] in radians, and whether they
    come nearest in front of both cameras, [M], or too far away to tell.

    The arguments of `fitting`. The angle is NaN for a place that the lens cannot show.
    """
    first, second = (
        rays_through(lens, place) @ pose[:, :3].T
        for pose, lens, place in zip(world_from_camera, lenses, places, strict=True)
    )
    moved = world_from_camera[1][:, 3] - world_from_camera[0][:, 3]
    length = float(np.linalg.norm(moved))
    cross = np.cross(first, second)
    apart = np.linalg.norm(cross, axis=1)
    if not length > 0:
        return apart, np.ones(len(apart), bool)
    base = moved / length
    # The angle of each ray with the plane of the other and the base line, the smaller of the two.
    off = np.abs(cross @ base) / np.maximum(
        np.maximum(_sine(first, base), _sine(second, base)), 1e-9
    )
    # Depths along both rays, of where they are nearest to each other, in base lines.
    dot = (first * second).sum(axis=1)
    along_first, along_second = first @ base, second @ base
    square = np.maximum(apart**2, 1e-12)
    depth_first = (along_first - dot * along_second) / square
    depth_second = (dot * along_first - along_second) / square
    before = (depth_first > 0) & (depth_second > 0)
    parallel = (apart <= _PARALLEL_RAD) & (dot > 0)
    return off, before | parallel


def _sine(rays: Floats, axis: Floats) -> Floats:
    """Of the angle between unit rays [M, 3] and a unit axis [3]."""
    sine: Floats = np.linalg.norm(np.cross(rays, axis), axis=1)
    return sine


def agreement(
    indices: Sequence[int],
    world_from_camera: Floats,
    lenses: Sequence[Intrinsics],
    matches: Matches,
) -> float | None:
    """The share of matches that fit, mean over pairs of images with poses; None of too few pairs.

    indices: [N], the image that each pose is of. world_from_camera: [N, 3, 4], OpenCV axes.
    lenses: [N]. Pairs with few matches count less.
    """
    pairs = _of_pairs(indices, world_from_camera, lenses, matches)
    if len(pairs) < FEWEST_PAIRS:
        return None
    return _mean(pairs)


def agreement_of_model(model: SparseModel, matches: Matches) -> float | None:
    """The same of a model."""
    lenses = [model.cameras[number] for number in model.camera_of]
    return agreement(model.indices, model.world_from_camera, lenses, matches)


def share_that_fits(model: SparseModel, matches: Matches) -> dict[tuple[int, int], float]:
    """Of each pair of the model's images with enough matches, the share of them that fits."""
    lenses = [model.cameras[number] for number in model.camera_of]
    pairs = _of_pairs(model.indices, model.world_from_camera, lenses, matches)
    return {pair.images: pair.share for pair in pairs}


def contradicted_images(model: SparseModel, matches: Matches) -> tuple[int, ...]:
    """Those of a model's images, ascending, whose own matches say that they stand elsewhere.

    The worst is taken out first: its pairs speak against its neighbours, too. None where they would
    be many, or where matches contradict the model without them: nobody knows which are right.
    """
    lenses = [model.cameras[number] for number in model.camera_of]
    pairs = _of_pairs(model.indices, model.world_from_camera, lenses, matches)
    wrong: list[int] = []
    while len(wrong) <= _MOST_WRONG * len(model.indices):
        own: dict[int, list[_Pair]] = {}
        for pair in pairs:
            for image in pair.images:
                own.setdefault(image, []).append(pair)
        known = {o: _mean(found) for o, found in own.items() if len(found) >= _FEWEST_OF_IMAGE}
        worst = min(known, key=lambda image: (known[image], image), default=None)
        if worst is None or known[worst] >= LITTLE:
            is_right = len(pairs) >= FEWEST_PAIRS and _mean(pairs) >= MUCH
            return tuple(sorted(wrong)) if is_right else ()
        wrong.append(worst)
        pairs = [pair for pair in pairs if worst not in pair.images]
    return ()


@dataclass(frozen=True)
class _Pair:
    """Two images with poses. share: of their matches, those that fit. weight: what they count."""

    images: tuple[int, int]
    share: float
    weight: int


def _of_pairs(
    indices: Sequence[int],
    world_from_camera: Floats,
    lenses: Sequence[Intrinsics],
    matches: Matches,
) -> list[_Pair]:
    row = {index: number for number, index in enumerate(indices)}
    found = []
    for (i, j), places in matches.items():
        if i not in row or j not in row or len(places[0]) < FEWEST_MATCHES:
            continue
        a, b = row[i], row[j]
        fits = fitting((world_from_camera[a], world_from_camera[b]), (lenses[a], lenses[b]), places)
        found.append(_Pair((i, j), float(fits.mean()), min(len(fits), _FULL_WEIGHT)))
    return found


def _mean(pairs: Sequence[_Pair]) -> float:
    """The share of matches that fit."""
    return float(np.average([o.share for o in pairs], weights=[o.weight for o in pairs]))
