"""The order in which a capture was walked, and how far its poses are from each other.

Poses are `world_from_camera` [N, 3, 4], OpenGL cameras, world units. The metric counts turning as
well as moving: turning by one radian is as long as moving by `turn_length`.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.natural_order import natural_key
from pipelines.scene.rotations import quaternions

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_UNORDERED_RATIO = 4.0
"""Consecutive steps this much longer than nearest-neighbour steps mean: not in walking order."""
_MAX_UNORDERED = 300


def capture_order(
    poses: Floats, names: Sequence[str], timestamps_s: Sequence[float | None]
) -> Indices:
    """The order in which a person could have walked past the poses.

    poses: [N, 3, 4]. names: paths of the images. timestamps_s: capture times where known.
    By time where every image has one, else by name; where that order jumps about (a photo set
    named at random) by a short tour through neighbouring poses. Of the views of a panorama, which
    were taken in one place, the first is in the order. Returns indices, [M], M <= N.
    """
    if all(time is not None for time in timestamps_s):
        order = sorted(range(len(names)), key=lambda i: (float(timestamps_s[i] or 0.0), names[i]))
    else:
        order = sorted(range(len(names)), key=lambda i: natural_key(names[i]))
    indices = _first_in_each_place(np.asarray(order, dtype=np.int64), poses)
    if len(indices) < 4:
        return indices
    if len(indices) > _MAX_UNORDERED:
        probe = indices[np.linspace(0, len(indices) - 1, _MAX_UNORDERED).astype(np.int64)]
    else:
        probe = indices
    distance = pose_distances(poses[probe])
    steps = np.diagonal(distance, offset=1)
    apart = distance + np.where(np.eye(len(probe), dtype=bool), np.inf, 0.0)
    nearest = apart.min(axis=1)
    if np.median(steps) <= _UNORDERED_RATIO * max(float(np.median(nearest)), 1e-12):
        return indices
    tour: Indices = probe[short_tour(distance)]
    return tour


def _first_in_each_place(order: Indices, poses: Floats) -> Indices:
    """The order without images that were taken exactly where the one before them was."""
    centers = poses[order, :, 3]
    moved = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    reach = np.abs(centers - centers.mean(axis=0)).max(initial=0.0)
    kept: Indices = order[np.concatenate([[True], moved > 1e-9 * reach])] if reach > 0 else order
    return kept


def short_tour(distance: Floats) -> Indices:
    """A short open path through all points: nearest neighbours, then 2-opt.

    distance: symmetric [N, N]. Returns a permutation [N].
    """
    num = len(distance)
    start = int(np.argmax(distance[int(np.argmax(distance[0]))]))
    tour = [start]
    left = np.ones(num, dtype=bool)
    left[start] = False
    while left.any():
        candidates = np.where(left, distance[tour[-1]], np.inf)
        tour.append(int(np.argmin(candidates)))
        left[tour[-1]] = False
    path = np.asarray(tour, dtype=np.int64)
    for _ in range(4 * num):
        gain, i, j = _best_reversal(distance, path)
        if gain <= 1e-9:
            break
        path[i : j + 1] = path[i : j + 1][::-1]
    return path


def _best_reversal(distance: Floats, path: Indices) -> tuple[float, int, int]:
    """The reversal path[i..j] that shortens an open path most: (gain, i, j)."""
    num = len(path)
    d = distance[np.ix_(path, path)]
    before = np.concatenate(([0.0], np.diagonal(d, offset=1)))
    after = np.concatenate((np.diagonal(d, offset=1), [0.0]))
    # Edges (i-1, i) and (j, j+1) become (i-1, j) and (i, j+1); a missing end costs nothing.
    joined_start = np.vstack((np.zeros(num), d[:-1, :]))
    joined_end = np.hstack((d[:, 1:], np.zeros((num, 1))))
    gain = before[:, None] + after[None, :] - joined_start - joined_end
    gain[np.tril_indices(num)] = -np.inf
    i, j = np.unravel_index(int(np.argmax(gain)), gain.shape)
    return float(gain[i, j]), int(i), int(j)


def turn_length(poses: Floats) -> float:
    """World units that one radian of turning counts for: the spread of the camera centres."""
    centers = poses[:, :, 3]
    spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return spread if spread > 1e-9 else 1.0


def pose_distances(poses: Floats) -> Floats:
    """[N, N] distances between poses in the metric of this file."""
    centers = poses[:, :, 3]
    moved = np.linalg.norm(centers[:, None] - centers[None, :], axis=-1)
    dots = np.abs(quaternions(poses[:, :, :3]) @ quaternions(poses[:, :, :3]).T)
    turned = 2.0 * np.arccos(np.clip(dots, 0.0, 1.0))
    result: Floats = np.hypot(moved, turn_length(poses) * turned)
    return result


def nearest_pose_distance(path: Floats, poses: Floats) -> Floats:
    """[M] how far each pose of a path [M, 3, 4] is from the nearest of `poses` [N, 3, 4]."""
    distance: Floats = pose_distances(np.concatenate((path, poses)))[: len(path), len(path) :].min(
        1
    )
    return distance
