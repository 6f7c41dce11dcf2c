"""What cameras alone say of how something was filmed: whether they stand around what they look at.

OpenGL axes, world units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.focus import find_focus, usual_distance

Floats = NDArray[np.float64]

LEAST_LOOKING = 0.75
"""Of the cameras, that have the focus within 30 degrees of their axis."""
LEAST_ARC_DEG = 40.0
"""Between the two cameras that see the focus from the most different directions."""

MIDDLE_SHARE = 0.8
"""Of a picture's sides, within which a place is looked at."""
_LONG_SIDE_PX = 64


@dataclass(frozen=True)
class Gaze:
    """Who looked. poses: [N, 3, 4] world_from_camera, OpenGL axes. lenses: N, undistorted."""

    poses: Floats
    lenses: Sequence[Pinhole]

    def attention(self, points: Floats) -> Floats:
        """[P] in [0, 1], the share of cameras with points [P, 3] amid their pictures."""
        count = np.zeros(len(points))
        for pose, lens in zip(self.poses, self.lenses, strict=True):
            local = (points - pose[:, 3]) @ pose[:, :3]
            before = -local[:, 2] > 0.0
            depth = np.where(before, -local[:, 2], 1.0)
            x = np.abs(lens.fl_x * local[:, 0]) / depth / (0.5 * lens.width)
            y = np.abs(lens.fl_y * local[:, 1]) / depth / (0.5 * lens.height)
            count += before & (x < MIDDLE_SHARE) & (y < MIDDLE_SHARE)
        return count / max(len(self.poses), 1)


@dataclass(frozen=True)
class Told:
    """What cameras alone say. why: they did not walk round anything; None where they may have.
    where: the focus [3] and their mean distance to it, if they have one."""

    why: str | None
    measures: dict[str, Any] = field(default_factory=dict)
    where: tuple[Floats, float] | None = None

    @property
    def at_one_place(self) -> bool:
        """Whether most look at one place, be it from one side only."""
        return bool(self.measures.get("looking", 0.0) >= LEAST_LOOKING)


def gaze_of(images: list[PosedImage], lenses: list[Intrinsics]) -> Gaze:
    """The cameras of a capture as the rule wants them."""
    poses = np.asarray([image.world_from_camera for image in images], np.float64).reshape(-1, 3, 4)
    return Gaze(poses, [Pinhole.of(lens, _LONG_SIDE_PX) for lens in lenses])


def told_by_cameras(gaze: Gaze) -> Told:
    """What cameras alone say, before anything is known of what they saw."""
    focus = find_focus(gaze.poses) if len(gaze.poses) >= 3 else None
    if focus is None:
        return Told("The cameras do not look at one point: they face one way, or look about.")
    away = gaze.poses[:, :, 3] - focus
    far = np.linalg.norm(away, axis=1)
    toward = -away / np.maximum(far[:, None], 1e-300)
    cosine = -(gaze.poses[:, :, 2] * toward).sum(axis=1)
    looking = float((cosine > np.cos(np.radians(30.0))).mean())
    arc = float(np.degrees(np.arccos(np.clip((toward @ toward.T).min(), -1.0, 1.0))))
    where = focus, usual_distance(gaze.poses, focus)
    measures = {
        "looking": round(looking, 3),
        "arc_deg": round(arc, 1),
        "distance": round(where[1], 6),
    }
    why = None
    if looking < LEAST_LOOKING:
        why = f"Only {looking:.0%} of the cameras look at what the others do."
    elif arc < LEAST_ARC_DEG:
        why = f"The cameras see it from directions within {arc:.0f} degrees."
    return Told(why, measures, where)
