"""A can with its label on it twice, front and back, and hardly anything else to hold on to."""

from __future__ import annotations

import numpy as np
from PIL import Image

from tests.unit.pipelines.sfm.synthetic_room import (
    HEIGHT,
    WIDTH,
    blobs,
    picked,
    pose_looking_at,
    rays_of,
)

RADIUS, TALL = 0.45, 1.0
SEAM_DEG = 25.0
"""Half the width of the two seams between the labels, at 90 and 270 degrees."""
_LABEL, _SEAMS, _FLOOR = blobs(10), blobs(11), blobs(12)
_TEXTURE_PER_UNIT = 200.0


def around_poses(num: int, turn_deg: float) -> np.ndarray:
    """[num, 3, 4], OpenGL axes: level steps around the can, `turn_deg` from the first to the last.

    The first looks at the middle of a label.
    """
    angles = np.radians(np.linspace(0.0, turn_deg, num))
    centers = np.stack(
        [1.7 * np.cos(angles), 1.7 * np.sin(angles), 1.0 + 0.08 * np.cos(5 * angles)], axis=1
    )
    return np.stack([pose_looking_at(c, np.array([0.0, 0.0, 0.45])) for c in centers])


def render(pose: np.ndarray) -> Image.Image:
    """The can z in [0, TALL] around the z axis, on a floor of one faint pattern."""
    rays, center = rays_of(pose), pose[:, 3]
    # Where rays meet the wall of the can: |center + t ray| = RADIUS in x and y.
    square = (rays[..., :2] ** 2).sum(axis=-1)
    half = (rays[..., :2] * center[:2]).sum(axis=-1)
    inside = half**2 - square * (center[:2] @ center[:2] - RADIUS**2)
    reach = (-half - np.sqrt(np.maximum(inside, 0.0))) / square
    wall = center + rays * reach[..., None]
    is_wall = (inside > 0) & (reach > 0) & (wall[..., 2] >= 0) & (wall[..., 2] <= TALL)
    down = -center[2] / np.where(rays[..., 2] < 0, rays[..., 2], np.nan)
    floor = center + rays * down[..., None]
    is_floor = ~is_wall & np.isfinite(down) & (np.hypot(floor[..., 0], floor[..., 1]) < 4.0)
    picture = np.full((HEIGHT, WIDTH, 3), 200.0)
    spots = floor[is_floor][:, :2] * _TEXTURE_PER_UNIT
    picture[is_floor] = 150.0 + 0.05 * (picked(_FLOOR, spots[:, 0], spots[:, 1]) - 128.0)
    x, y, z = wall[is_wall].T
    turn = np.degrees(np.arctan2(y, x))
    along = np.radians(turn) * RADIUS * _TEXTURE_PER_UNIT
    # The label begins anew half way round; the seams go on.
    of_label = np.radians((turn + 90.0) % 180.0) * RADIUS * _TEXTURE_PER_UNIT
    is_seam = (np.abs(np.abs(turn) - 90.0) < SEAM_DEG)[:, None]
    label = picked(_LABEL, of_label, z * _TEXTURE_PER_UNIT)
    seam = 128.0 + 0.35 * (picked(_SEAMS, along, z * _TEXTURE_PER_UNIT) - 128.0)
    picture[is_wall] = np.where(is_seam, seam, label)
    return Image.fromarray(np.clip(picture, 0, 255).round().astype(np.uint8))
