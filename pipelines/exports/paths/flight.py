"""A flight along a path, and what it needs beside: a lens, and its most telling moment."""

from __future__ import annotations

import importlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.flight_options import FlightOptions
from pipelines.exports.paths.catalogue import PATHS
from pipelines.exports.paths.options import PathOptions
from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.capture_order import nearest_pose_distance
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.focus import find_focus

Floats = NDArray[np.float64]

_UP = np.array([0.0, 0.0, 1.0])
_STEEP = 1e-4
_JUMP_DEG, _JUMP_STEPS = 8.0, 6.0
"""A turn between two frames that is larger, and than so many of the median ones, is a jump."""
_TRIED_FRAMES = 240
"""In which a path's turning is measured, before it has its own number."""
_ON_THEIR_SIDE, _CLEARLY = 0.3, 2.0
"""Median height of cameras' X axes, and how many times that of their Y axes it is, from which
pictures are turned for who watches: from steeply above both are low."""


@dataclass(frozen=True)
class Flight:
    """poses: [N, 3, 4] world_from_camera, OpenGL cameras, world units.

    fov_deg: [N], vertical, where the path has its own; else that of the capture is used.
    """

    poses: Floats
    fov_deg: Floats | None = None

    def __len__(self) -> int:
        return len(self.poses)

    def turned_deg(self) -> float:
        """How far the cameras turn on the way, degrees, but for where the way jumps."""
        axes = self.poses[:, :, :3]
        trace = np.einsum("nij,nij->n", axes[1:], axes[:-1])
        steps = np.degrees(np.arccos(np.clip((trace - 1.0) / 2.0, -1.0, 1.0)))
        if len(steps) == 0:
            return 0.0
        jumps = steps > max(_JUMP_DEG, _JUMP_STEPS * float(np.median(steps)))
        return float(steps[~jumps].sum())

    def lens(self, index: int, lens: Pinhole) -> Pinhole:
        """The lens of one frame, from that of the video."""
        if self.fov_deg is None:
            return lens
        focal = 0.5 * lens.height / float(np.tan(np.radians(self.fov_deg[index]) / 2.0))
        return replace(lens, fl_x=focal, fl_y=focal, cx=lens.width / 2.0, cy=lens.height / 2.0)


def make_path(
    options: PathOptions,
    images: Sequence[PosedImage],
    num_frames: int,
    mesh: Path | None = None,
) -> Flight:
    """The path that options name, in so many frames; a file's own number counts for more.

    mesh: the folder of the job's mesh: what a path makes up for itself stays within its walls,
    where there is one.
    """
    module_name, _, function_name = PATHS[options.path].partition(":")
    path: Callable[..., Flight] = getattr(importlib.import_module(module_name), function_name)
    return path(images, options, num_frames, mesh)


def filmed_path(
    options: FlightOptions, images: Sequence[PosedImage], mesh: Path | None = None
) -> Flight:
    """The path that options name, in as many frames as they say or as it turns.

    mesh: as for `make_path`.
    """
    count = options.frames()
    if count is None:
        # Walls hardly change how far it turns, and take long to read.
        count = options.frames_for(make_path(options, images, _TRIED_FRAMES).turned_deg())
    return make_path(options, images, count, mesh)


def held_upright(
    images: Sequence[PosedImage], lens: Intrinsics
) -> tuple[Sequence[PosedImage], Intrinsics]:
    """The cameras and their typical lens, those turned whose photos lie on their side, or stand on
    their head: as apps store them of a phone that is held so, and as they lie once EXIF is lost.

    Each has its own quarter; the lens, and cameras that look straight down, that of most. lens:
    without tangential distortion, as `typical_lens` gives it.
    """
    if not images:
        return images, lens
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    right, top = poses[:, 2, 0], poses[:, 2, 1]
    lies = np.abs(right) >= np.maximum(_ON_THEIR_SIDE, _CLEARLY * np.abs(top))
    stands = np.abs(top) >= np.maximum(_ON_THEIR_SIDE, _CLEARLY * np.abs(right))
    # Quarters: what was at the right, below or at the left is above then.
    own = np.where(lies, np.where(right > 0.0, 1, 3), np.where(top > 0.0, 0, 2))
    usual = int(np.bincount(own[lies | stands], minlength=4).argmax())
    quarters = np.where(lies | stands, own, usual)
    if not quarters.any():
        return images, lens
    turn = np.array([[0.0, 1.0], [-1.0, 0.0]])
    turns = np.array([np.linalg.matrix_power(turn, quarter) for quarter in range(4)])
    poses[:, :, :2] = poses[:, :, :2] @ turns[quarters]
    turned = [
        replace(image, world_from_camera=tuple(tuple(row) for row in pose.tolist()))
        for image, pose in zip(images, poses, strict=True)
    ]
    if usual % 2 == 0:
        return turned, lens
    return turned, replace(
        lens,
        width=lens.height,
        height=lens.width,
        fl_x=lens.fl_y,
        fl_y=lens.fl_x,
        cx=lens.height / 2.0,
        cy=lens.width / 2.0,
    )


def looking_at(places: Floats, target: Floats, up: Floats = _UP) -> Floats:
    """[N, 3, 4] cameras at places [N, 3] that look at a target [3], level as to `up` [3].

    Where one looks along `up`, +Y takes its place, or +X.
    """
    back = places - target
    back /= np.linalg.norm(back, axis=1, keepdims=True)
    right = np.cross(up, back)
    for instead in ([0.0, 1.0, 0.0], [1.0, 0.0, 0.0]):
        steep = np.linalg.norm(right, axis=1) < _STEEP
        right[steep] = np.cross(instead, back[steep])
    right /= np.linalg.norm(right, axis=1, keepdims=True)
    poses: Floats = np.stack([right, np.cross(back, right), back, places], axis=-1)
    return poses


def preview_index(path: NDArray[np.float64], images: Sequence[PosedImage]) -> int:
    """A telling moment of the path for the picture that stands for the job.

    Of the middle two thirds, the half that is nearest to captured poses; of these the one that
    has what the cameras look at most in its middle, or where there is no such point, the nearest.
    """
    first, last = len(path) // 6, len(path) - len(path) // 6
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    candidates = path[first:last]
    distance = nearest_pose_distance(candidates, poses)
    focus = find_focus(poses)
    if focus is None:
        return first + int(np.argmin(distance))
    to_focus = focus - candidates[:, :, 3]
    centred = -(candidates[:, :, 2] * to_focus).sum(axis=1) / np.linalg.norm(to_focus, axis=1)
    return first + int(np.argmax(np.where(distance <= np.median(distance), centred, -np.inf)))


def lens_of_size(lens: Intrinsics, width: int, height: int) -> Pinhole:
    """The lens without its distortion, its picture filling this size; what is too much is cut."""
    whole = Pinhole.of(lens, max(lens.width, lens.height))
    grown = max(width / whole.width, height / whole.height)
    return Pinhole(width, height, whole.fl_x * grown, whole.fl_y * grown, width / 2.0, height / 2.0)


def typical_lens(lenses: Sequence[Intrinsics]) -> Intrinsics:
    """The most common size, with the median focal length among its lenses, centred and without
    tangential distortion."""
    sizes = [(lens.width, lens.height) for lens in lenses]
    width, height = max(sizes, key=sizes.count)
    same = [lens for lens in lenses if (lens.width, lens.height) == (width, height)]
    return replace(
        same[0],
        fl_x=float(np.median([lens.fl_x for lens in same])),
        fl_y=float(np.median([lens.fl_y for lens in same])),
        cx=width / 2.0,
        cy=height / 2.0,
        p1=0.0,
        p2=0.0,
    )
