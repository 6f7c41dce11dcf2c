"""A level circle around what the cameras look at: from the captured side first.

Height and distance are the medians of the captured cameras', unless they are given, so that the
circle passes where most of them stood; what none of them saw is shown as badly as it is known.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ExportError
from pipelines.exports.paths.flight import Flight, looking_at
from pipelines.exports.paths.options import PathOptions
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.focus import find_focus

Floats = NDArray[np.float64]

_STEEPEST = np.sin(np.radians(80.0))
"""Cameras that look down more steeply have no level circle: the sideways axis would spin."""


def orbit(
    images: Sequence[PosedImage], options: PathOptions, num_frames: int, mesh: Path | None = None
) -> Flight:
    """Poses that look at the focus, or so far above it; the last is one step before the first.

    Raises ExportError (no_focus) where the cameras look at no common point.
    """
    del mesh
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    focus = find_focus(poses)
    if focus is None:
        raise ExportError(
            "The cameras look at no common point, so there is nothing to circle.",
            code="no_focus",
            hint="Set video.path to smooth.",
        )
    away = poses[:, :, 3] - focus
    captured = float(np.median(np.linalg.norm(away, axis=1)))
    share = float(np.clip(np.median(away[:, 2]) / captured, -_STEEPEST, _STEEPEST))
    if options.orbit.height is not None:
        share = options.orbit.height
    distance = options.orbit.distance * captured
    radius = distance * np.sqrt(1.0 - share**2)
    middle = away[:, :2].mean(axis=0)
    first = np.arctan2(middle[1], middle[0])
    angles = first + 2.0 * np.pi * options.orbit.turns * np.arange(num_frames) / num_frames
    height = np.full(num_frames, share * distance)
    offsets = np.stack([radius * np.cos(angles), radius * np.sin(angles), height], axis=-1)
    path = looking_at(focus + offsets, focus)
    return Flight(
        np.concatenate((path[:, :, :3] @ _tilt(options.orbit.tilt_deg), path[:, :, 3:]), 2)
    )


def _tilt(degrees: float) -> Floats:
    """[3, 3] a turn of a camera about its own X axis: its gaze goes up."""
    angle = np.radians(degrees)
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]])
