"""Given poses adjusted to what pictures show, in the frame and at the scale that they came in.

What matched pictures see is put where the given poses have it, as far as they agree at all; poses
and points are adjusted to that; then the same from the better poses with less tolerance. Bundle
adjustment knows neither place nor scale, so each group of images that hang together is moved back
onto its given poses as a whole. Images that see too little take part in the corrections of their
neighbours in the capture: what drifts drifts smoothly. Images whose given pose is wrong altogether,
as of a row mixed up, are placed anew by the points that the others have found.

Symbols: N images; poses [N, 3, 4] world_from_camera, OpenCV axes. Lenses are not changed here, but
in `pipelines.sfm.given_lenses`.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.rotations import quaternions, rotation_matrices
from pipelines.sfm.given_fit import px_scale
from pipelines.sfm.tracks import Bools, Floats, Integers, Observations, thinned, triangulate
from pipelines.tools.colmap_adjustment import Rounds, Run
from pipelines.tools.colmap_posing import Sightings, adjusted, resected
from pipelines.tools.colmap_rays import rays_through

LAST_PX = 4.0
"""How far a match may lie from its point in the end, as COLMAP allows."""
MOST_PX = 48.0
"""And at first, however bad the poses are."""
_SHRINK = 2.5
_EXTRA_ROUNDS = 1
FEW_SEEN = 20
"""Observations of points that others see, too, below which an image says too little of its pose."""
FEW_TOGETHER = 4
"""Images in a group below which it is not moved as a whole."""
PER_IMAGE = 400
"""Observations of an image that are adjusted to, where it has more: time grows with them."""
_QUICK = Rounds(iterations=8, rounds=2, tolerance=1e-4)
LAST = Rounds(iterations=10, rounds=4, tolerance=1e-6)
_OUTLYING = 3.0
WILD = 2.0
_STRAY = 0.6
SLACK = 3.0
"""How far off a pose may be, in what matches of the worse pairs miss it by at the distance of what
they show: matches of one pair see only a part of the error."""

Report = Callable[[float, str], None]


class NothingFits(Exception):
    """No point that pictures show is where the given poses could have seen it."""


@dataclass(frozen=True)
class Refined:
    """poses: [N, 3, 4]. lenses: N, by which they fit. is_seen: [N], whether its own matches say
    where an image is; others were moved with them. is_anew: [N], whether it was placed without heed
    of its given pose. points: [T, 3], and track_lengths: [T], how many images agree about each; 0
    of none that is any good. seen: observations of these. before: the same of the given poses."""

    poses: Floats
    lenses: tuple[Intrinsics, ...]
    is_seen: Bools
    is_anew: Bools
    points: Floats
    track_lengths: Integers
    seen: Observations
    before: Refined | None = None


def refine(
    given: Floats,
    lenses: Sequence[Intrinsics],
    seen: Observations,
    *,
    error_px: float,
    long_side_px: int,
    run: Run,
    num_threads: int,
    seed: int,
    report: Report = lambda share, message: None,
) -> Refined:
    """Poses that fit the tracks `seen`.

    error_px: by how much matches miss the given poses, of the worse pairs; from there tolerance
    goes down. long_side_px: at which features were found. Raises NothingFits.
    """
    num = len(given)
    rays, scales = rays_of(lenses, seen), scales_of(lenses, long_side_px)
    full = [
        max(lens.width, lens.height) / min(long_side_px, max(lens.width, lens.height))
        for lens in lenses
    ]
    loss_px = float(np.median(full))
    poses, anew = given.copy(), np.zeros(num, bool)
    before: Refined | None = None
    limits = tolerances(error_px)
    for turn, limit_px in enumerate(limits):
        report(turn / len(limits), f"adjusting the poses, {turn + 1} of {len(limits)}")
        points, fits = triangulate(seen, rays, poses, limit_px / scales)
        if turn > 0:
            lost = strays(seen, fits, num) & ~anew
            placed = resected(
                lenses,
                points,
                sightings(seen, on_points(seen, fits, lost)),
                2 * loss_px * limit_px,
                seed=seed,
                run=run,
            )
            for image, pose in placed.items():
                poses[image], anew[image] = pose, True
            if placed:
                points, fits = triangulate(seen, rays, poses, limit_px / scales)
            fits = shared(seen, fits & ~(lost & ~anew)[seen.image])
        chosen = thinned(seen, fits, PER_IMAGE)
        if not chosen.any():
            raise NothingFits
        if before is None:
            before = as_found(given, lenses, points, fits, seen)
        slack = SLACK * error_px * depth_of(seen, fits, points, poses) / float(np.median(scales))
        ends = LAST if turn == len(limits) - 1 else _QUICK
        moved, _, _ = adjusted(
            poses,
            lenses,
            points,
            sightings(seen, chosen),
            ends,
            centers={i: given[i, :, 3] for i in range(num) if not anew[i]},
            slack=slack,
            loss_px=loss_px,
            run=run,
            num_threads=num_threads,
        )
        wild = (WILD * slack, WILD * SLACK * error_px / float(np.median(scales)))
        poses, told = settled(given, moved, seen.where(chosen), anew, wild)
    points, fits = triangulate(seen, rays, poses, LAST_PX / scales)
    return replace(
        as_found(poses, lenses, points, fits, seen),
        is_seen=told,
        is_anew=anew & told,
        before=before,
    )


def located(
    poses: Floats, lenses: Sequence[Intrinsics], seen: Observations, long_side_px: int
) -> Refined:
    """The poses as they are, with the points where they have the tracks `seen`."""
    limits = LAST_PX / scales_of(lenses, long_side_px)
    points, fits = triangulate(seen, rays_of(lenses, seen), poses, limits)
    return as_found(poses, lenses, points, fits, seen)


def rays_of(lenses: Sequence[Intrinsics], seen: Observations) -> Floats:
    """[K, 3], unit vectors in camera axes; NaN where a lens shows nothing."""
    rays = np.full((len(seen.track), 3), np.nan)
    for image in np.unique(seen.image).tolist():
        mine = seen.image == image
        rays[mine] = rays_through(lenses[image], seen.xy[mine])
    return rays


def scales_of(lenses: Sequence[Intrinsics], long_side_px: int) -> Floats:
    """[N], pixels of each image, at the size at which features were found, for an angle of 1."""
    return np.array([px_scale([lens], long_side_px) for lens in lenses])


def as_found(
    poses: Floats, lenses: Sequence[Intrinsics], points: Floats, fits: Bools, seen: Observations
) -> Refined:
    """Poses as they are, with the points that they give."""
    none = np.zeros(len(poses), bool)
    lengths = np.bincount(seen.track[fits], minlength=len(points)).astype(np.int64)
    return Refined(poses, tuple(lenses), none, none, points, lengths, seen.where(fits))


def depth_of(seen: Observations, fits: Bools, points: Floats, poses: Floats) -> float:
    """The median distance from an image to what it sees; the cameras' extent of those that see
    nothing."""
    images = seen.image[fits]
    if not len(images):
        return float(np.linalg.norm(np.ptp(poses[:, :, 3], axis=0)))
    return float(np.median(np.linalg.norm(points[seen.track[fits]] - poses[images, :, 3], axis=1)))


def tolerances(error_px: float) -> list[float]:
    """How far matches may miss their points, round after round."""
    limits = [min(max(3.0 * error_px, LAST_PX), MOST_PX)]
    while limits[-1] > LAST_PX:
        limits.append(max(limits[-1] / _SHRINK, LAST_PX))
    return limits + [LAST_PX] * _EXTRA_ROUNDS


def shared(seen: Observations, kept: Bools) -> Bools:
    """Those of the kept observations whose point another one sees, too, [K]."""
    found: Bools = kept & (np.bincount(seen.track[kept], minlength=_count(seen)) >= 2)[seen.track]
    return found


def strays(seen: Observations, fits: Bools, num: int) -> Bools:
    """Images whose observations fit far less often than others', or hardly ever, [N]."""
    fitting = np.bincount(seen.image[fits], minlength=num)
    share = fitting / np.maximum(np.bincount(seen.image, minlength=num), 1)
    few: Bools = (fitting < FEW_SEEN) | (share < _STRAY * np.median(share[fitting > 0]))
    return few


def on_points(seen: Observations, fits: Bools, lost: Bools) -> Bools:
    """Observations by lost images of points that others agree on, [K]."""
    firm = np.bincount(seen.track[fits & ~lost[seen.image]], minlength=_count(seen)) >= 2
    found: Bools = lost[seen.image] & firm[seen.track]
    return found


def _count(seen: Observations) -> int:
    return int(seen.track.max()) + 1 if len(seen.track) else 0


def sightings(seen: Observations, which: Bools) -> Sightings:
    return Sightings(seen.track[which], seen.image[which], seen.xy[which])


def settled(
    given: Floats, moved: Floats, seen: Observations, anew: Bools, wild: tuple[float, float]
) -> tuple[Floats, Bools]:
    """Adjusted poses in the given frame, and which of them are told by what the images see, [N].

    Each group of images that points connect is moved onto its given poses as a whole; images
    without a group, or that see too little, get the corrections of their neighbours; so do those
    whose own correction is off these by more than `wild`, world units and radians: little holds
    their turn. anew: [N], images whose given pose says nothing of where the group belongs.
    """
    num = len(given)
    result, told = given.copy(), np.zeros(num, bool)
    counts = np.bincount(seen.image, minlength=num)
    for members in groups(seen, num):
        strong = members[counts[members] >= FEW_SEEN]
        trusted = strong[~anew[strong]]
        if len(trusted) >= FEW_TOGETHER:
            result[strong] = onto(given[trusted], moved[trusted], moved[strong])
            told[strong] = True
    sure = np.flatnonzero(told & ~anew)
    for _ in range(len(sure) // 3):
        # The worst alone: it makes its neighbours look wrong, too.
        excess = [_excess(given, result, sure, place, wild) for place in range(len(sure))]
        worst = int(np.argmax(excess))
        if excess[worst] <= 1.0:
            break
        told[sure[worst]] = False
        sure = np.delete(sure, worst)
    if len(sure):
        for image in np.flatnonzero(~told).tolist():
            result[image] = carried(given, result, sure, image)
    return result, told


def _excess(
    given: Floats, result: Floats, sure: Integers, place: int, wild: tuple[float, float]
) -> float:
    """How far a pose is from what its neighbours' corrections make of it, in parts of `wild`."""
    image = int(sure[place])
    expected = carried(given, result, np.delete(sure, place), image)
    off = float(np.linalg.norm(result[image, :, 3] - expected[:, 3]))
    cosine = (np.trace(result[image, :, :3].T @ expected[:, :3]) - 1.0) / 2.0
    return max(off / wild[0], float(np.arccos(np.clip(cosine, -1.0, 1.0))) / wild[1])


def groups(seen: Observations, num: int) -> list[Integers]:
    """Images that points connect, as numbers, in groups."""
    size = num + _count(seen)
    links = coo_array(
        (np.ones(len(seen.track), np.int8), (seen.image, num + seen.track)), shape=(size, size)
    )
    group_of = connected_components(links, directed=False)[1][:num]
    return [np.flatnonzero(group_of == group) for group in np.unique(group_of)]


def onto(given: Floats, moved: Floats, all_moved: Floats) -> Floats:
    """`all_moved` under the similarity that brings the poses `moved` onto `given` best.

    The turn is the mean of what each pose says, so that gravity stays where it was, and the path's
    shape says nothing of it; scale and place are those of the centres. Poses far off the others,
    as wrong ones are, have no say.
    """
    use = np.ones(len(given), bool)
    for _ in range(3):
        turns = given[use, :, :3] @ moved[use, :, :3].transpose(0, 2, 1)
        u, _, vt = np.linalg.svd(turns.mean(axis=0))
        rotation = u @ np.diag([1.0, 1.0, np.linalg.det(u @ vt)]) @ vt
        source, target = moved[use, :, 3] @ rotation.T, given[use, :, 3]
        source_mean, target_mean = source.mean(axis=0), target.mean(axis=0)
        spread = float(((source - source_mean) ** 2).sum())
        both = float(((source - source_mean) * (target - target_mean)).sum())
        scale = both / spread if spread > 0 and both > 0 else 1.0
        shift = target_mean - scale * source_mean
        off = np.linalg.norm(scale * moved[:, :, 3] @ rotation.T + shift - given[:, :, 3], axis=1)
        near = off <= _OUTLYING * max(float(np.median(off)), 1e-12)
        if near.sum() < FEW_TOGETHER or (near == use).all():
            break
        use = near
    result = np.empty_like(all_moved)
    result[:, :, :3] = rotation @ all_moved[:, :, :3]
    result[:, :, 3] = scale * all_moved[:, :, 3] @ rotation.T + shift
    return result


def carried(given: Floats, result: Floats, sure: Integers, image: int) -> Floats:
    """The pose of an image by the corrections of its neighbours in the capture, [3, 4].

    sure: [S] ascending, the images with corrections of their own. Between two of them it is
    interpolated, beyond the last it stays what it is.
    """
    place = int(np.searchsorted(sure, image))
    before, after = sure[max(place - 1, 0)], sure[min(place, len(sure) - 1)]
    share = 0.0 if before == after else (image - before) / (after - before)
    turns = [result[i, :, :3] @ given[i, :, :3].T for i in (before, after)]
    q = quaternions(np.stack(turns))
    q[1] *= 1.0 if q[0] @ q[1] >= 0 else -1.0
    turn = rotation_matrices(((1 - share) * q[0] + share * q[1])[None])[0]
    shifts = [result[i, :, 3] - given[i, :, 3] for i in (before, after)]
    center = given[image, :, 3] + (1 - share) * shifts[0] + share * shifts[1]
    pose: Floats = np.column_stack([turn @ given[image, :, :3], center])
    return pose
