"""A smooth camera path through captured poses.

Poses are `world_from_camera` [N, 3, 4], OpenGL cameras, world units. The path is parametrised by
arc length `s` in the metric of `pipelines.scene.capture_order`, which counts turning as well as
moving. Rotations are unit quaternions (w, x, y, z).

Where the cameras look at a point, the focus, two things are fitted by themselves beside position
and rotation: the distance to it, and the direction in which each camera sees it. Averages of
positions cut corners, and averages of rotations know nothing of what is looked at. Around a thing
that keeps a gap in the capture from leading through it; between the corners of a room it would lead
out through a wall, so a wall of the mesh ends what is pushed towards it.

This file knows only poses; lenses and rendering are left to who asks for the path.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import minimum_filter1d, uniform_filter1d

from pipelines.exports.paths.flight import Flight
from pipelines.exports.paths.options import PathOptions
from pipelines.exports.paths.walls import Walls
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.capture_order import capture_order, turn_length
from pipelines.scene.focus import find_focus
from pipelines.scene.rotations import quaternions, rotation_between, rotation_matrices

Floats = NDArray[np.float64]

_SMOOTHING_SHARE, _SMOOTHING_TURN_RAD = 1.0 / 30.0, 0.42
"""What is smoothed over: a thirtieth of the way; of a film that looks about no more than that is of
a way that goes round once, in radians of the metric: of a walk through five rooms a thirtieth leads
through walls. Photos from here and there would have the camera jump from one to the next.
"""
_MOST = 0.75
"""Of pictures whose times nobody knows, the share that are no farther from the one before than is
smoothed over in a film, where they are a walk's. Measured at that share: .22 rad for a walk sent as
pictures, .48 to .62 for photos of rooms and a desk."""
_GAP_RAD, _GAP_STEPS = 0.8, 6.0
"""A step between two poses of a film that is longer, in radians of the metric, and than so many of
its median steps, is a gap."""
_STEEP, _LEVEL = 0.2, 0.6
"""Of the world's up, what lies in a picture's plane: up to this it has no upper side, and from this
on it has. Between them a horizon counts by and by."""
_OVERSAMPLING = 8
_CLEARANCE = 0.05
"""Of the distance to the focus: so far a wall stays away from what is pushed towards it, and a push
of less is none to ask about."""
_MIN_AGREEMENT = 1e-3
"""A mean direction shorter than this is none: cameras that see the focus on opposite sides."""


def smooth_flight(
    images: Sequence[PosedImage], options: PathOptions, num_frames: int, mesh: Path | None = None
) -> Flight:
    """World poses along the captured ones, in the order of the walk, on this side of the walls."""
    del options
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    order = capture_order(
        poses, [image.file for image in images], [image.timestamp_s for image in images]
    )
    focus = find_focus(poses)
    walls = None if focus is None or mesh is None else Walls.of(mesh)
    is_film = all(image.timestamp_s is not None for image in images)
    is_walk = focus is None and (is_film or _follow_each_other(poses[order]))
    return Flight(
        smooth_path(poses[order], num_frames, focus, walls, is_walk=is_walk, is_film=is_film)
    )


def smooth_path(
    poses: Floats,
    num_frames: int,
    focus: Floats | None = None,
    walls: Walls | None = None,
    *,
    is_walk: bool = False,
    is_film: bool = False,
) -> Floats:
    """`num_frames` poses along a smooth path through `poses`, at nearly constant speed.

    poses: [N, 3, 4] in walking order, N >= 1. Positions are a local linear fit along the arc
    length with a Gaussian window of a thirtieth of the path (less of a walk, wider where poses are
    sparse), which removes the shake of the hand and keeps the way; rotations are the window's
    mean quaternion, with +Z as far up in the picture as the window's poses have it.
    focus: [3], what the cameras look at, where there is such a point. The distance to it is then
    the window's own, so that a gap in the capture is passed around the subject and not through it;
    and so is its direction in the camera: where all of the window's poses have the focus in their
    pictures, so has the path.
    walls: what a place that the distance pushes away from its neighbours must not lie behind; there
    the distance is kept as far as there is room.
    is_walk: whether poses follow each other as those of a film that looks about do, so that the way
    is theirs.
    is_film: whether they are a film's; where these break off the path jumps to where they go on.
    Returns [num_frames, 3, 4] with exact rotations. Raises ValueError without poses or frames.
    """
    if len(poses) == 0 or num_frames < 1:
        raise ValueError(f"a path needs poses and frames, got {len(poses)} and {num_frames}")
    turn = turn_length(poses)
    s = _arc_length(poses, turn)
    width = s[-1] * _SMOOTHING_SHARE
    if is_walk:
        width = min(width, turn * _SMOOTHING_TURN_RAD)
    if s[-1] <= 1e-9:
        return np.repeat(poses[:1], num_frames, axis=0)
    s_at = np.linspace(0.0, s[-1], _OVERSAMPLING * num_frames)
    dense = _windowed(poses, s, s_at, width, focus)
    pushed = np.ones(len(s_at))
    if focus is not None and walls is not None:
        pushed = _room(poses, s, s_at, width, focus, walls)
        dense = _windowed(poses, s, s_at, width, focus, pushed)
    s_dense = _arc_length(dense, turn)
    if is_film:
        s_dense = _without_gaps(s_dense, s_at, s, turn)
    # Evenly spaced along the smoothed way: constant speed.
    at = np.interp(np.linspace(0.0, s_dense[-1], num_frames), s_dense, s_at)
    return _windowed(poses, s, at, width, focus, np.interp(at, s_at, pushed))


def _follow_each_other(poses: Floats) -> bool:
    """Whether most poses are as near to the one before as a film's: pictures of a walk."""
    turn = turn_length(poses)
    steps = np.diff(_arc_length(poses, turn))
    return len(steps) > 0 and bool(np.quantile(steps, _MOST) <= turn * _SMOOTHING_TURN_RAD)


def _without_gaps(length: Floats, at: Floats, s: Floats, turn: float) -> Floats:
    """The length [M] of a way at `at` [M], where gaps between poses at `s` [N] have next to none.

    A film's poses are near each other, unless some were not found: what it saw there is not known.
    """
    steps = np.diff(s)
    gaps = steps > max(turn * _GAP_RAD, _GAP_STEPS * float(np.median(steps)))
    inside = gaps[np.clip(np.searchsorted(s, 0.5 * (at[1:] + at[:-1])) - 1, 0, len(steps) - 1)]
    short: Floats = np.concatenate(([0.0], np.cumsum(np.diff(length) * np.where(inside, 1e-3, 1))))
    return short


def _arc_length(poses: Floats, turn: float) -> Floats:
    """[N] length of the way up to each pose; `turn`: that of one radian."""
    moved = np.linalg.norm(np.diff(poses[:, :, 3], axis=0), axis=1)
    q = quaternions(poses[:, :, :3])
    turned = 2.0 * np.arccos(np.clip(np.abs((q[1:] * q[:-1]).sum(axis=1)), 0.0, 1.0))
    length: Floats = np.concatenate(([0.0], np.cumsum(np.hypot(moved, turn * turned))))
    return length


def _room(
    poses: Floats, s: Floats, at: Floats, width: float, focus: Floats, walls: Walls
) -> Floats:
    """[M] how much of its push to the focus's distance a place at `at` can have, 0 to 1.

    All, where the captured poses on both sides of it see it, or where the way to it, from between
    them, meets no wall. It changes as slowly along the path as the path does.
    """
    start = _windowed(poses, s, at, width, focus, np.zeros(len(at)))[:, :, 3]
    end = _windowed(poses, s, at, width, focus)[:, :, 3]
    length = np.linalg.norm(end - start, axis=1)
    clearance = _CLEARANCE * np.linalg.norm(end - focus, axis=1)
    asked = np.flatnonzero(length > clearance)
    way = (end - start)[asked] / length[asked, None]
    beyond = end[asked] + clearance[asked, None] * way
    after = np.clip(np.searchsorted(s, at[asked]), 1, len(s) - 1)
    hidden = walls.hide(poses[after - 1, :, 3], beyond) | walls.hide(poses[after, :, 3], beyond)
    asked, way = asked[hidden], way[hidden]
    share = np.ones(len(at))
    free = walls.distance(start[asked], way) - clearance[asked]
    share[asked] = np.clip(free / length[asked], 0.0, 1.0)
    window = 1 + 2 * round(_SMOOTHING_SHARE * len(at) / 2.0)
    lowest = minimum_filter1d(share, window, mode="nearest")
    room: Floats = uniform_filter1d(lowest, window, mode="nearest")
    return room


def _windowed(
    poses: Floats,
    s: Floats,
    at: Floats,
    usual: float,
    focus: Floats | None,
    pushed: Floats | None = None,
) -> Floats:
    """Poses [M, 3, 4] at arc lengths `at` [M], from `poses` at `s` [N].

    usual: the window's width, where poses are no sparser.
    pushed: [M] how far each goes from the mean of places, 0, to the mean distance from the focus,
    1; None for all the way.
    """
    offset = s[None, :] - at[:, None]
    # The window reaches the third nearest pose, so that a gap never leaves it empty.
    third = np.partition(np.abs(offset), min(2, len(s) - 1), axis=1)[:, min(2, len(s) - 1)]
    width = np.maximum(usual, third)[:, None]
    weight = np.exp(-0.5 * (offset / width) ** 2)
    weight /= weight.sum(axis=1, keepdims=True)
    centers = poses[:, :, 3]
    position = _local_line(weight, offset, centers)
    q = quaternions(poses[:, :, :3])
    outer = np.einsum("mn,ni,nj->mij", weight, q, q)
    rotation = rotation_matrices(np.linalg.eigh(outer)[1][:, :, -1])
    if focus is not None:
        wanted = _local_line(weight, offset, np.linalg.norm(centers - focus, axis=1)[:, None])
        away = position - focus
        length = np.linalg.norm(away, axis=1, keepdims=True)
        factor = np.where(length > 1e-9, wanted / np.maximum(length, 1e-9), 1.0)
        if pushed is not None:
            factor = 1.0 + pushed[:, None] * (factor - 1.0)
        position = focus + away * factor
        rotation = _aimed(rotation, position, weight @ _directions_to(focus, poses), focus)
    rotation = _levelled(rotation, weight @ poses[:, 2, :2])
    path: Floats = np.concatenate((rotation, position[:, :, None]), axis=2)
    return path


def _directions_to(focus: Floats, poses: Floats) -> Floats:
    """[N, 3] unit directions to the focus in each camera's own axes; 0 for a camera in it."""
    local = np.einsum("nji,nj->ni", poses[:, :, :3], focus - poses[:, :, 3])
    length = np.linalg.norm(local, axis=1, keepdims=True)
    directions: Floats = np.where(length > 1e-9, local / np.maximum(length, 1e-9), 0.0)
    return directions


def _aimed(rotation: Floats, position: Floats, wanted: Floats, focus: Floats) -> Floats:
    """Rotations [M, 3, 3], turned the least way that brings the focus to the wanted directions.

    wanted: [M, 3] in camera axes, means of unit vectors. A picture is a convex cone of directions,
    so a mean over cameras that have the focus in theirs lies in it too. Where the mean is no
    direction the rotation stays as it is.
    """
    length = np.linalg.norm(wanted, axis=1)
    seen = _directions_to(focus, np.concatenate((rotation, position[:, :, None]), axis=2))
    known = (length > _MIN_AGREEMENT) & (np.linalg.norm(seen, axis=1) > 0.5)
    aimed = rotation.copy()
    unit = wanted[known] / length[known, None]
    aimed[known] = rotation[known] @ rotation_between(unit, seen[known])
    return aimed


def _levelled(rotation: Floats, wanted: Floats) -> Floats:
    """Rotations [M, 3, 3], rolled about their gaze until +Z lies in the picture where it lies in
    the captured ones.

    A mean of cameras that look from several sides is rolled, though none of them is. wanted:
    [M, 2], the mean place of +Z in their picture planes. Where that is short, or a camera looks
    nearly straight up or down, its rotation stays as it is.
    """
    found = rotation[:, 2, :2]
    angle = np.arctan2(found[:, 1], found[:, 0]) - np.arctan2(wanted[:, 1], wanted[:, 0])
    angle = np.remainder(angle + np.pi, 2.0 * np.pi) - np.pi
    length = np.minimum(np.hypot(*wanted.T), np.hypot(*found.T))
    angle *= np.clip((length - _STEEP) / (_LEVEL - _STEEP), 0.0, 1.0)
    cosine, sine = np.cos(angle)[:, None], np.sin(angle)[:, None]
    right, top, back = (rotation[:, :, axis] for axis in range(3))
    rolled: Floats = np.stack([cosine * right + sine * top, cosine * top - sine * right, back], -1)
    return rolled


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
