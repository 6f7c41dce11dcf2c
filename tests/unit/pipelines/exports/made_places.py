"""Places out of flat sheets, and the cameras that filmed them: for the rule about subjects."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.paths.flight import looking_at
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.gaze import Gaze

Corner = Sequence[float] | np.ndarray
STEP = 0.04
LENS = Pinhole(64, 48, 52.0, 52.0, 32.0, 24.0)


def sheet(corner: Corner, one: Corner, other: Corner) -> TriangleMesh:
    """A parallelogram in small triangles; its front is where one x other points."""
    start, u, v = (np.asarray(side, np.float64) for side in (corner, one, other))
    across = max(2, round(float(np.linalg.norm(u)) / STEP))
    along = max(2, round(float(np.linalg.norm(v)) / STEP))
    x, y = np.meshgrid(np.linspace(0, 1, across + 1), np.linspace(0, 1, along + 1), indexing="ij")
    vertices = start + x.reshape(-1, 1) * u + y.reshape(-1, 1) * v
    first = (np.arange(across)[:, None] * (along + 1) + np.arange(along)).reshape(-1)
    right, up = first + along + 1, first + 1
    faces = np.concatenate(
        [np.stack([first, right, up], axis=1), np.stack([right, right + 1, up], axis=1)]
    )
    normal = np.cross(u, v) / np.linalg.norm(np.cross(u, v))
    plain = np.full_like(vertices, 0.5)
    return TriangleMesh(
        vertices, faces.astype(np.int32), plain, np.broadcast_to(normal, vertices.shape).copy()
    )


def block(low: Corner, high: Corner) -> TriangleMesh:
    """A box, seen from outside."""
    a, b = np.asarray(low, np.float64), np.asarray(high, np.float64)
    x, y, z = np.diag(b - a)
    return joined(
        [
            sheet(a, y, x),
            sheet(a + z, x, y),
            sheet(a, x, z),
            sheet(a + y, z, x),
            sheet(a, z, y),
            sheet(a + x, y, z),
        ]
    )


def table(half: float, height: float = 0.0) -> TriangleMesh:
    """A level square around the origin."""
    return sheet((-half, -half, height), (2 * half, 0, 0), (0, 2 * half, 0))


def seen_from(
    eyes: np.ndarray, target: Callable[[np.ndarray], np.ndarray] | Sequence[float]
) -> Gaze:
    """Cameras at [N, 3] that look at one point each, or all at one."""
    ends = [target(eye) if callable(target) else np.asarray(target, np.float64) for eye in eyes]
    poses = np.concatenate(
        [looking_at(eye[None], end) for eye, end in zip(eyes, ends, strict=True)]
    )
    return Gaze(poses, [LENS] * len(poses))


def around(arc_deg: float, radius: float = 1.0, height: float = 0.5, count: int = 40) -> np.ndarray:
    """Places on a level arc about the origin, its middle at -Y."""
    angle = np.radians(-90.0 + arc_deg * (np.arange(count) / count - 0.5))
    return np.stack(
        [radius * np.cos(angle), radius * np.sin(angle), np.full(count, height)], axis=1
    )
