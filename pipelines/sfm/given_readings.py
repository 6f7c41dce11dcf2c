"""How else given poses may be read: files are written by other conventions than their format's."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from pipelines.sfm.tracks import Floats


@dataclass(frozen=True)
class Reading:
    """What poses would be if they had been written by another convention: its words; poses
    [N, 3, 4], OpenCV axes. is_whole: whether each picture has one so."""

    words: str
    poses: Floats
    is_whole: bool = True


def other_readings(poses: Floats) -> list[Reading]:
    """How else poses may be read. poses: [N, 3, 4] as they were sent, OpenGL axes."""
    flip = np.diag([1.0, -1.0, -1.0])

    def flipped(all_poses: Floats) -> Floats:
        return np.concatenate([all_poses[:, :, :3] @ flip, all_poses[:, :, 3:]], axis=2)

    def inverted(all_poses: Floats) -> Floats:
        turned = all_poses[:, :, :3].transpose(0, 2, 1)
        return np.concatenate([turned, -turned @ all_poses[:, :, 3:]], axis=2)

    axes = "their cameras' axes are the others of OpenCV's (Y down, looking along +Z) and OpenGL's"
    inverse = "they lead from the world to the camera, not from the camera to the world"
    after, before = (flipped(np.roll(poses, shift, axis=0)) for shift in (-1, 1))
    return [
        Reading(axes, poses),
        Reading(inverse, flipped(inverted(poses))),
        Reading(inverse, inverted(flipped(poses))),
        Reading("each belongs to the picture after", after, is_whole=False),
        Reading("each belongs to the picture before", before, is_whole=False),
    ]
