"""Exact depth views of a coloured sphere on a floor, for tests of fusion and point clouds."""

from __future__ import annotations

import numpy as np

from pipelines.scene.depth_views import DepthView, Floats, Pinhole

RADIUS = 1.0


def look_at(position: Floats, target: Floats) -> Floats:
    """An OpenGL camera [3, 4] at `position` that looks at `target`, +Z up."""
    back = position - target
    back = back / np.linalg.norm(back)
    right = np.cross([0.0, 0.0, 1.0], back)
    right /= np.linalg.norm(right)
    return np.column_stack((right, np.cross(back, right), back, position))


def ring(num: int, center: Floats, distance: float = 3.0) -> Floats:
    """[N, 3, 4] cameras on three rings around `center`, all looking at it."""
    poses = []
    for index in range(num):
        angle = 2.0 * np.pi * index * 3 / num
        height = (-0.6, 0.2, 0.9)[index % 3]
        flat = np.sqrt(1.0 - height**2)
        away = np.array([flat * np.cos(angle), flat * np.sin(angle), height])
        poses.append(look_at(center + distance * away, center))
    return np.stack(poses)


def arc(num: int, shake: float = 0.0, seed: int = 0) -> Floats:
    """Cameras on 120 degrees of a circle of radius 3 around the origin."""
    rng = np.random.default_rng(seed)
    angles = np.linspace(0.0, 2.0 * np.pi / 3.0, num)
    poses = []
    for angle in angles:
        place = 3.0 * np.array([np.cos(angle), np.sin(angle), 0.3])
        poses.append(look_at(place + shake * rng.normal(size=3), shake * rng.normal(size=3)))
    return np.stack(poses)


def sphere_color(points: Floats, center: Floats) -> Floats:
    """Red grows with x, green with y, blue with z: 0.2 to 0.8."""
    return np.asarray(0.5 + 0.3 * (points - center) / RADIUS)


def sphere_view(lens: Pinhole, pose: Floats, center: Floats) -> DepthView:
    """The unit sphere around `center`, seen exactly; nothing around it."""
    rays = lens.directions()
    world = rays @ pose[:, :3].T
    start = pose[:, 3] - center
    a = (world**2).sum(axis=-1)
    b = (world * start).sum(axis=-1)
    c = (start**2).sum() - RADIUS**2
    inside = b * b - a * c
    z = np.where(inside > 0, (-b - np.sqrt(np.maximum(inside, 0.0))) / a, 0.0)
    points = pose[:, 3] + world * z[..., None]
    color = np.where(z[..., None] > 0, sphere_color(points, center), 0.0)
    return DepthView(
        lens, pose, np.rint(255.0 * np.clip(color, 0, 1)).astype(np.uint8), z.astype(np.float32)
    )
