"""Tracks: what matches of pairs say is one point, seen by several images; and where it is.

Symbols: K observations, each of a track by an image; T tracks, numbered from 0. Poses [N, 3, 4] are
world_from_camera, OpenCV axes; rays are unit vectors in camera axes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.tools.colmap_results import Correspondences, VerifiedMatches

Floats = npt.NDArray[np.float64]
Integers = npt.NDArray[np.int64]
Bools = npt.NDArray[np.bool_]

_SINGULAR = 1e-8
"""Least eigenvalue, of a mean over rays, below which their track's depth is not determined."""
_PEEL = 3
"""How often the worst observation of a track is taken away, until all fit."""


@dataclass(frozen=True)
class Observations:
    """K rows in order of their tracks. track, image: [K]. xy: [K, 2], pixels."""

    track: Integers
    image: Integers
    xy: Floats

    def where(self, kept: Bools) -> Observations:
        """Some of the rows, under the same numbers of tracks."""
        return Observations(self.track[kept], self.image[kept], self.xy[kept])


def build_tracks(
    found: Correspondences, held_share: float, seed: int
) -> tuple[Observations, VerifiedMatches]:
    """The tracks to adjust to, and the matches of others that are held out, to judge by.

    held_share: of all tracks. Matches that say that two features of one image are one are wrong
    somewhere: those observations are left out.
    """
    starts = np.concatenate([[0], np.cumsum([len(places) for places in found.places])])
    num = int(starts[-1])
    edges = [rows + np.array([starts[i], starts[j]]) for (i, j), rows in found.matches.items()]
    first, second = (np.concatenate(edges) if edges else np.zeros((0, 2), np.int64)).T
    links = coo_array((np.ones(len(first), np.int8), (first, second)), shape=(num, num))
    count, track_of = connected_components(links, directed=False)
    held = np.random.default_rng(seed).random(count) < held_share
    held_matches = {}
    for (i, j), rows in found.matches.items():
        kept = rows[held[track_of[rows[:, 0] + starts[i]]]]
        held_matches[i, j] = found.places[i][kept[:, 0]], found.places[j][kept[:, 1]]
    image_of = np.repeat(np.arange(len(found.places)), np.diff(starts))
    both = track_of.astype(np.int64) * len(found.places) + image_of
    times = np.unique(both, return_inverse=True, return_counts=True)
    single = times[2][times[1]] == 1
    usable = single & ~held[track_of]
    rows = np.flatnonzero(usable & (np.bincount(track_of[usable], minlength=count) >= 2)[track_of])
    rows = rows[np.argsort(track_of[rows], kind="stable")]
    xy = np.concatenate(found.places) if num else np.zeros((0, 2))
    numbers = np.unique(track_of[rows], return_inverse=True)[1]
    return Observations(numbers.astype(np.int64), image_of[rows].astype(np.int64), xy[rows]), (
        held_matches
    )


def triangulate(
    seen: Observations, rays: Floats, poses: Floats, limit_rad: Floats
) -> tuple[Floats, Bools]:
    """Where tracks lie, [T, 3], and which observations agree with that, [K].

    rays: [K, 3]. limit_rad: [N], how far a ray of each image may miss its point. Tracks of fewer
    than two agreeing observations have none. A point is nearest to its rays in the sense of least
    squares (midpoint method); then the worst observation of each track that misses is taken away.
    """
    count = int(seen.track.max()) + 1 if len(seen.track) else 0
    world = np.einsum("kij,kj->ki", poses[seen.image][:, :, :3], rays)
    centers = poses[seen.image][:, :, 3]
    kept = np.isfinite(world).all(axis=1)
    points = np.zeros((count, 3))
    for turn in range(_PEEL + 1):
        points, solid = _meeting_points(seen.track, world, centers, kept, count)
        away = points[seen.track] - centers
        length = np.linalg.norm(away, axis=1)
        cosine = (away * world).sum(axis=1) / np.maximum(length, 1e-12)
        sine = np.linalg.norm(np.cross(away, world), axis=1) / np.maximum(length, 1e-12)
        off = np.where(kept, np.arctan2(sine, cosine), 0.0)
        misses = off > limit_rad[seen.image]
        fine = kept & ~misses & solid[seen.track]
        if turn == _PEEL or not (misses & kept).any():
            break
        worst = np.zeros(count)
        np.maximum.at(worst, seen.track, off / limit_rad[seen.image])
        kept &= ~(misses & (off / limit_rad[seen.image] >= worst[seen.track]))
    fine &= (np.bincount(seen.track[fine], minlength=count) >= 2)[seen.track]
    return points, fine


def _meeting_points(
    track: Integers, rays: Floats, centers: Floats, kept: Bools, count: int
) -> tuple[Floats, Bools]:
    """Points [T, 3] nearest to their rays, and whether rays of different directions say so, [T]."""
    use = np.flatnonzero(kept)
    across: Floats = np.eye(3) - rays[use, :, None] * rays[use, None, :]
    sums, ends = np.zeros((count, 3, 3)), np.zeros((count, 3))
    np.add.at(sums, track[use], across)
    np.add.at(ends, track[use], np.einsum("kij,kj->ki", across, centers[use]))
    numbers = np.maximum(np.bincount(track[use], minlength=count), 1)
    least = np.linalg.eigvalsh(sums / numbers[:, None, None])[:, 0]
    solid = (least > _SINGULAR) & (numbers >= 2)
    sums[~solid] = np.eye(3)
    points = np.linalg.solve(sums, ends[:, :, None])[:, :, 0]
    return np.asarray(points, np.float64), solid


def apart_deg(seen: Observations, points: Floats, poses: Floats) -> Floats:
    """How far the directions that each track is seen from are from their mean, root mean square in
    degrees, [T]; half the angle, where there are two."""
    away = points[seen.track] - poses[seen.image, :, 3]
    away /= np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-12)
    sums = [np.bincount(seen.track, weights=part, minlength=len(points)) for part in away.T]
    numbers = np.maximum(np.bincount(seen.track, minlength=len(points)), 1)
    mean = np.linalg.norm(np.stack(sums, axis=1), axis=1) / numbers
    found: Floats = np.degrees(np.sqrt(np.maximum(2.0 * (1.0 - mean), 0.0)))
    return found


def thinned(seen: Observations, kept: Bools, per_image: int) -> Bools:
    """Fewer of the kept observations, [K]: whole tracks, the longest first, until every image that
    has so many has `per_image` of them."""
    count = int(seen.track.max()) + 1 if len(seen.track) else 0
    lengths = np.bincount(seen.track[kept], minlength=count)
    wanted = np.zeros(count, bool)
    num_images = int(seen.image.max()) + 1 if len(seen.image) else 0
    for image in range(num_images):
        mine = np.unique(seen.track[kept & (seen.image == image)])
        best = mine[np.argsort(-lengths[mine], kind="stable")[:per_image]]
        wanted[best] = True
    chosen: Bools = kept & wanted[seen.track]
    return chosen
