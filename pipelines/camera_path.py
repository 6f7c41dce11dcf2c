"""A smooth camera path through captured poses, for the video.

Poses are `world_from_camera` [N, 3, 4], OpenGL cameras, world units. The path is parametrised by
arc length `s` in a metric that counts turning as well as moving: turning by one radian is as long
as moving by `turn_length`. Rotations are unit quaternions (w, x, y, z).

This file knows only poses; lenses and rendering are left to the video stage.
"""

from __future__ import annotations

import re
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Indices = NDArray[np.int64]

_UNORDERED_RATIO = 4.0
"""Consecutive steps this much longer than nearest-neighbour steps mean: not in walking order."""
_MAX_UNORDERED = 300
_SMOOTHING_SHARE = 1.0 / 30.0
_OVERSAMPLING = 8


def natural_key(name: str) -> tuple[tuple[int, int | str], ...]:
    """A sorting key that puts `2.jpg` before `10.jpg`."""
    parts = re.split(r"(\d+)", name.lower())
    return tuple((0, int(part)) if part.isdigit() else (1, part) for part in parts if part)


def capture_order(
    poses: Floats, names: Sequence[str], timestamps_s: Sequence[float | None]
) -> Indices:
    """The order in which a person could have walked past the poses.

    poses: [N, 3, 4]. names: paths of the images. timestamps_s: capture times where known.
    By time where every image has one, else by name; where that order jumps about (a photo set
    named at random) by a short tour through neighbouring poses. Returns indices, [M], M <= N.
    """
    if all(time is not None for time in timestamps_s):
        order = sorted(range(len(names)), key=lambda i: (float(timestamps_s[i] or 0.0), names[i]))
    else:
        order = sorted(range(len(names)), key=lambda i: natural_key(names[i]))
    indices = np.asarray(order, dtype=np.int64)
    if len(indices) < 4:
        return indices
    if len(indices) > _MAX_UNORDERED:
        probe = indices[np.linspace(0, len(indices) - 1, _MAX_UNORDERED).astype(np.int64)]
    else:
        probe = indices
    distance = _distances(poses[probe])
    steps = np.diagonal(distance, offset=1)
    apart = distance + np.where(np.eye(len(probe), dtype=bool), np.inf, 0.0)
    nearest = apart.min(axis=1)
    if np.median(steps) <= _UNORDERED_RATIO * max(float(np.median(nearest)), 1e-12):
        return indices
    tour: Indices = probe[short_tour(distance)]
    return tour


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


def _turn_length(poses: Floats) -> float:
    """World units that one radian of turning counts for: the spread of the camera centres."""
    centers = poses[:, :, 3]
    spread = float(np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean()))
    return spread if spread > 1e-9 else 1.0


def _distances(poses: Floats) -> Floats:
    """[N, N] distances between poses in the metric of this file."""
    centers = poses[:, :, 3]
    moved = np.linalg.norm(centers[:, None] - centers[None, :], axis=-1)
    dots = np.abs(quaternions(poses[:, :, :3]) @ quaternions(poses[:, :, :3]).T)
    turned = 2.0 * np.arccos(np.clip(dots, 0.0, 1.0))
    result: Floats = np.hypot(moved, _turn_length(poses) * turned)
    return result


def quaternions(rotations: Floats) -> Floats:
    """Unit quaternions (w, x, y, z) [N, 4] of rotation matrices [N, 3, 3].

    Each is the eigenvector of Bar-Itzhack's symmetric 4x4 matrix, so a matrix that is slightly off
    gives the nearest rotation. The sign is free.
    """
    m = rotations
    k = np.empty((len(m), 4, 4))
    k[:, 0, 0] = m[:, 0, 0] + m[:, 1, 1] + m[:, 2, 2]
    k[:, 1, 1] = m[:, 0, 0] - m[:, 1, 1] - m[:, 2, 2]
    k[:, 2, 2] = m[:, 1, 1] - m[:, 0, 0] - m[:, 2, 2]
    k[:, 3, 3] = m[:, 2, 2] - m[:, 0, 0] - m[:, 1, 1]
    k[:, 0, 1] = k[:, 1, 0] = m[:, 2, 1] - m[:, 1, 2]
    k[:, 0, 2] = k[:, 2, 0] = m[:, 0, 2] - m[:, 2, 0]
    k[:, 0, 3] = k[:, 3, 0] = m[:, 1, 0] - m[:, 0, 1]
    k[:, 1, 2] = k[:, 2, 1] = m[:, 0, 1] + m[:, 1, 0]
    k[:, 1, 3] = k[:, 3, 1] = m[:, 0, 2] + m[:, 2, 0]
    k[:, 2, 3] = k[:, 3, 2] = m[:, 1, 2] + m[:, 2, 1]
    vectors: Floats = np.linalg.eigh(k)[1][:, :, -1]
    return vectors


def rotation_matrices(q: Floats) -> Floats:
    """Rotation matrices [N, 3, 3] of unit quaternions (w, x, y, z) [N, 4]."""
    w, x, y, z = np.moveaxis(q / np.linalg.norm(q, axis=1, keepdims=True), -1, 0)
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    stacked: Floats = np.stack([np.stack(row, axis=-1) for row in rows], axis=-2)
    return stacked


def smooth_path(poses: Floats, num_frames: int, focus: Floats | None = None) -> Floats:
    """`num_frames` poses along a smooth path through `poses`, at nearly constant speed.

    poses: [N, 3, 4] in walking order, N >= 1. Positions are a local linear fit along the arc
    length with a Gaussian window of a thirtieth of the path (wider where poses are sparse), which
    removes the shake of the hand and keeps the way; rotations are the window's mean quaternion.
    focus: [3], what the cameras look at, where there is such a point: the distance to it is then
    fitted by itself, so that a gap in the capture is passed around the subject and not through it.
    Returns [num_frames, 3, 4] with exact rotations. Raises ValueError without poses or frames.
    """
    if len(poses) == 0 or num_frames < 1:
        raise ValueError(f"a path needs poses and frames, got {len(poses)} and {num_frames}")
    turn_length = _turn_length(poses)
    s = _arc_length(poses, turn_length)
    if s[-1] <= 1e-9:
        return np.repeat(poses[:1], num_frames, axis=0)
    dense = _windowed(poses, s, np.linspace(0.0, s[-1], _OVERSAMPLING * num_frames), focus)
    s_dense = _arc_length(dense, turn_length)
    # Evenly spaced along the smoothed way: constant speed.
    at = np.interp(
        np.linspace(0.0, s_dense[-1], num_frames), s_dense, np.linspace(0.0, s[-1], len(dense))
    )
    return _windowed(poses, s, at, focus)


def _arc_length(poses: Floats, turn_length: float) -> Floats:
    """[N] length of the way up to each pose."""
    moved = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    q = quaternions(poses[:, :, :3])
    turned = 2.0 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=1)), 0.0, 1.0))
    length: Floats = np.concatenate(([0.0], np.cumsum(np.hypot(moved, turn_length * turned))))
    return length


def _windowed(poses: Floats, s: Floats, at: Floats, focus: Floats | None) -> Floats:
    """Poses [M, 3, 4] at arc lengths `at` [M], from `poses` at `s` [N]."""
    offset = s[None, :] - at[:, None]
    # The window reaches the third nearest pose, so that a gap never leaves it empty.
    third = np.partition(np.abs(offset), min(2, len(s) - 1), axis=1)[:, min(2, len(s) - 1)]
    width = np.maximum(s[-1] * _SMOOTHING_SHARE, third)[:, None]
    weight = np.exp(-0.5 * (offset / width) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    centers = poses[:, :, 3]
    position = _local_line(weight, offset, centers)
    if focus is not None:
        wanted = _local_line(weight, offset, np.linalg.norm(centers - focus, axis=1)[:, None])
        away = position - focus
        length = np.linalg.norm(away, axis=1, keepdims=True)
        position = focus + away * np.where(length > 1e-9, wanted / np.maximum(length, 1e-9), 1.0)
    q = quaternions(poses[:, :, :3])
    outer = np.einsum("mn,ni,nj->mij", weight, q, q)
    rotation = rotation_matrices(np.linalg.eigh(outer)[1][:, :, -1])
    path: Floats = np.concatenate((rotation, position[:, :, None]), axis=2)
    return path


def _local_line(weight: Floats, offset: Floats, values: Floats) -> Floats:
    """[M, D]: at offset 0, the weighted least-squares line through values [N, D].

    weight: [M, N], rows sum to 1. offset: [M, N].
    """
    mean_offset = (weight * offset).sum(axis=1, keepdims=True)
    centred = offset - mean_offset
    variance = (weight * centred**2).sum(axis=1, keepdims=True)
    slope = (weight * centred) @ values / np.maximum(variance, 1e-18)
    line: Floats = weight @ values - slope * mean_offset
    return line


def nearest_pose_distance(path: Floats, poses: Floats) -> Floats:
    """[M] how far each pose of a path [M, 3, 4] is from the nearest of `poses` [N, 3, 4]."""
    distance: Floats = _distances(np.concatenate((path, poses)))[: len(path), len(path) :].min(1)
    return distance
