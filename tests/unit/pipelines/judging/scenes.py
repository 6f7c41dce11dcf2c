"""A wall with a square hole, a camera before it, and a lens that bends."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.nerf.space.cameras import Cameras, SceneTransform
from pipelines.scene.cameras_file import Intrinsics
from pipelines.scene.trained_scene import nerf_cameras

DISTANCE = 2.0
SIDE = 64
PINHOLE = Intrinsics(SIDE, SIDE, 64.0, 64.0, 32.0, 32.0)
BENT = Intrinsics(SIDE, SIDE, 64.0, 64.0, 32.0, 32.0, model="OPENCV", k1=-0.25, k2=0.05)
UNMOVED = SceneTransform((0.0, 0.0, 0.0), 1.0)
LEVEL = np.concatenate([np.eye(3), np.zeros((3, 1))], axis=1)
"""A camera in the origin that looks along -Z."""


def camera(lens: Intrinsics = PINHOLE) -> Cameras:
    return nerf_cameras([lens], LEVEL[None], UNMOVED)


def wall(
    half: float = 2.0, hole: float = 0.0, distance: float = DISTANCE, cells: int = 80
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64]]:
    """Vertices, faces and colours (linear in x and y) of a wall across -Z with a hole amid it."""
    steps = np.linspace(-half, half, cells + 1)
    x, y = np.meshgrid(steps, steps)
    vertices = np.stack([x.ravel(), y.ravel(), np.full(x.size, -distance)], axis=1)
    index = np.arange(x.size).reshape(x.shape)
    corners = np.stack([index[:-1, :-1], index[:-1, 1:], index[1:, 1:], index[1:, :-1]], -1)
    middles = vertices[corners].mean(axis=2)[..., :2]
    kept = corners[(np.abs(middles) > hole).any(axis=-1)]
    faces = np.concatenate([kept[:, [0, 1, 2]], kept[:, [0, 2, 3]]])
    return vertices, faces, color_at(vertices[:, 0], vertices[:, 1])


def color_at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.stack([0.5 + 0.2 * x, 0.5 + 0.2 * y, np.full_like(x, 0.25)], axis=-1)
