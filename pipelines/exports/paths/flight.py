"""What a flight along any path needs beside it: a lens, and its most telling moment."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.capture_order import nearest_pose_distance
from pipelines.scene.focus import find_focus


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


def typical_lens(lenses: Sequence[Intrinsics]) -> Intrinsics:
    """The most common size, with the median focal length among its lenses, centred."""
    sizes = [(lens.width, lens.height) for lens in lenses]
    width, height = max(sizes, key=sizes.count)
    same = [lens for lens in lenses if (lens.width, lens.height) == (width, height)]
    return replace(
        same[0],
        fl_x=float(np.median([lens.fl_x for lens in same])),
        fl_y=float(np.median([lens.fl_y for lens in same])),
        cx=width / 2.0,
        cy=height / 2.0,
    )
