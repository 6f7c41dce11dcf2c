"""Flights through poses that somebody chose, or through the captured ones."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.paths.flight import Flight, looking_at
from pipelines.exports.paths.options import Keyframe, PathOptions
from pipelines.exports.paths.spline import through
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.capture_order import capture_order
from pipelines.scene.rotations import rotation_matrices

Floats = NDArray[np.float64]


def through_keyframes(
    images: Sequence[PosedImage], options: PathOptions, num_frames: int, mesh: Path | None = None
) -> Flight:
    """A flight through `video.keyframes`."""
    del images, mesh
    frames = options.keyframes
    told = [one.fov_deg for one in frames if one.fov_deg is not None]
    ways = len(frames) - (0 if options.loop else 1)
    return through(
        np.stack([_pose(one) for one in frames]),
        np.asarray(told) if told else None,
        np.asarray(options.durations_s() or np.ones(ways)),
        num_frames,
        tension=options.tension,
        loop=options.loop,
    )


def _pose(frame: Keyframe) -> Floats:
    position = np.asarray(frame.position, np.float64)
    if frame.rotation is not None:
        rotation = rotation_matrices(np.asarray([frame.rotation], np.float64))[0]
        return np.column_stack((rotation, position))
    pose: Floats = looking_at(position[None], np.asarray(frame.look_at, np.float64))[0]
    return pose


def through_captured(
    images: Sequence[PosedImage], options: PathOptions, num_frames: int, mesh: Path | None = None
) -> Flight:
    """A flight that passes every captured pose, in the order of the walk, as long at each."""
    del mesh
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    if len(poses) < 2:
        return Flight(np.repeat(poses, num_frames, axis=0))
    order = capture_order(
        poses, [image.file for image in images], [image.timestamp_s for image in images]
    )
    return through(poses[order], None, np.ones(len(poses) - 1), num_frames, tension=options.tension)
