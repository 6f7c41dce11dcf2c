"""Pictures of a painted wall with a box before it, whose depth is known exactly."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.stereo.views import StereoView

Floats = NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 96, 72, 90.0
WALL, SLOPE = 4.0, 0.25
"""The wall: z = 4 + x / 4. The box's front: z = 2.5 for |x|, |y| < 0.4."""
BOX, HALF_SIDE = 2.5, 0.4
_CELL = 0.05


def paint(x: Floats, y: Floats, seed: int) -> Floats:
    """A smooth random picture of infinite size: [..., ] in [0.2, 0.8]."""
    grid = np.random.default_rng(seed).random((256, 256))
    u, v = x / _CELL, y / _CELL
    i, j = np.floor(u).astype(int), np.floor(v).astype(int)
    a, b = u - i, v - j
    at = lambda p, q: grid[p % 256, q % 256]  # noqa: E731
    low = at(i, j) * (1 - a) + at(i + 1, j) * a
    high = at(i, j + 1) * (1 - a) + at(i + 1, j + 1) * a
    value: Floats = 0.2 + 0.6 * (low * (1 - b) + high * b)
    return value


def look(
    x: float, y: float = 0.0, *, with_box: bool = True, size: int = 1
) -> tuple[StereoView, Floats]:
    """What a camera at (x, y, 0) sees that looks along +Z, and its depth [H, W]; size: of it, in
    units of WIDTH and HEIGHT.
    """
    width, height = size * WIDTH, size * HEIGHT
    lens = (size * FOCAL, size * FOCAL, width / 2, height / 2)
    pose = np.column_stack([np.eye(3), [x, y, 0.0]])
    view = StereoView(np.zeros((height, width), np.float32), lens, pose)
    columns, rows = (item.astype(np.float64) for item in view.rays())
    dx, dy = np.meshgrid(columns, rows)
    z = (WALL + SLOPE * x) / (1.0 - SLOPE * dx)
    picture = paint(x + dx * z, y + dy * z, 1)
    if with_box:
        box_x, box_y = x + dx * BOX, y + dy * BOX
        hit = (np.abs(box_x) < HALF_SIDE) & (np.abs(box_y) < HALF_SIDE)
        picture = np.where(hit, paint(box_x, box_y, 2), picture)
        z = np.where(hit, BOX, z)
    return StereoView(picture.astype(np.float32), lens, pose), z


def row_of_cameras(
    count: int = 7, step: float = 0.12, size: int = 1
) -> tuple[list[StereoView], list[Floats]]:
    """Cameras side by side, and their depths."""
    seen = [look(step * (k - (count - 1) / 2), 0.03 * (k % 2), size=size) for k in range(count)]
    return [view for view, _ in seen], [depth for _, depth in seen]
