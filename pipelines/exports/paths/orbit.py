"""A level circle around what the cameras look at: once round, from the captured side first.

Height and distance are the medians of the captured cameras', so that the circle passes where most
of them stood; what none of them saw is shown as badly as it is known.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ExportError
from pipelines.scene.cameras_file import PosedImage
from pipelines.scene.focus import find_focus

_STEEPEST = np.sin(np.radians(80.0))
"""Cameras that look down more steeply have no level circle: the sideways axis would spin."""


def orbit(images: Sequence[PosedImage], num_frames: int) -> NDArray[np.float64]:
    """[num_frames, 3, 4] poses that look at the focus; the last is one step before the first.

    Raises ExportError (no_focus) where the cameras look at no common point.
    """
    poses = np.asarray([image.world_from_camera for image in images], np.float64)
    focus = find_focus(poses)
    if focus is None:
        raise ExportError(
            "The cameras look at no common point, so there is nothing to circle.",
            code="no_focus",
            hint="Set video.path to smooth.",
        )
    away = poses[:, :, 3] - focus
    distance = float(np.median(np.linalg.norm(away, axis=1)))
    height = float(np.median(away[:, 2]))
    height = float(np.clip(height, -_STEEPEST * distance, _STEEPEST * distance))
    radius = np.sqrt(distance**2 - height**2)
    middle = away[:, :2].mean(axis=0)
    first = np.arctan2(middle[1], middle[0])
    angles = first + 2.0 * np.pi * np.arange(num_frames) / num_frames
    offsets = np.stack(
        [radius * np.cos(angles), radius * np.sin(angles), np.full(num_frames, height)], axis=-1
    )
    back = offsets / np.linalg.norm(offsets, axis=1, keepdims=True)
    right = np.stack([-np.sin(angles), np.cos(angles), np.zeros(num_frames)], axis=-1)
    up = np.cross(back, right)
    return np.stack([right, up, back, focus + offsets], axis=-1)
