"""A jar on a turntable, filmed from a tripod: it turns, and the room behind it stands still."""

from __future__ import annotations

import functools

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from tests.unit.pipelines.sfm.synthetic_room import (
    HEIGHT,
    WIDTH,
    blobs,
    picked,
    pose_looking_at,
    rays_of,
)

RADIUS, TALL, PLATE = 0.45, 0.9, 0.75
_LABEL, _PLATE, _ROOM = blobs(20), blobs(21), blobs(22)
_TEXTURE_PER_UNIT = 200.0
SAND = np.array([190.0, 160.0, 120.0])
"""The jar's shoulder, plain all around."""
NUM = 18


def turned_poses(num: int, turn_deg: float = 360.0) -> np.ndarray:
    """[num, 3, 4], OpenGL axes: where the camera stands seen from the jar, in level steps."""
    angles = np.radians(np.arange(num) * turn_deg / num)
    centers = np.stack([1.9 * np.cos(angles), 1.9 * np.sin(angles), np.full(num, 1.15)], axis=1)
    return np.stack([pose_looking_at(center, np.array([0.0, 0.0, 0.4])) for center in centers])


def render(pose: np.ndarray) -> tuple[Image.Image, np.ndarray]:
    """The picture, and [H, W], where it shows what turns."""
    u, v = np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5)
    rays, center = rays_of(pose), pose[:, 3]
    picture = picked(_ROOM, 2.0 * u.ravel(), 2.0 * v.ravel()).reshape(HEIGHT, WIDTH, 3)
    plate = _met(rays, center, 0.0, PLATE)
    spots = (center + rays * plate[..., None])[np.isfinite(plate)]
    picture[np.isfinite(plate)] = picked(_PLATE, *(spots[:, :2].T * _TEXTURE_PER_UNIT))
    # Where rays meet the wall: |center + t ray| = RADIUS in x and y.
    square = (rays[..., :2] ** 2).sum(axis=-1)
    half = (rays[..., :2] * center[:2]).sum(axis=-1)
    inside = half**2 - square * (center[:2] @ center[:2] - RADIUS**2)
    reach = (-half - np.sqrt(np.maximum(inside, 0.0))) / square
    wall = center + rays * reach[..., None]
    is_wall = (inside > 0) & (wall[..., 2] >= 0) & (wall[..., 2] <= TALL)
    x, y, z = wall[is_wall].T
    along = np.arctan2(y, x) * RADIUS * _TEXTURE_PER_UNIT
    label = picked(_LABEL, along, z * _TEXTURE_PER_UNIT)
    picture[is_wall] = np.where((z > 0.75)[:, None], SAND, label)
    top = _met(rays, center, TALL, RADIUS)
    spots = (center + rays * top[..., None])[np.isfinite(top)]
    picture[np.isfinite(top)] = picked(_PLATE, *(spots[:, :2].T * _TEXTURE_PER_UNIT + 300.0))
    turns = is_wall | np.isfinite(top) | np.isfinite(plate)
    return Image.fromarray(np.clip(picture, 0, 255).round().astype(np.uint8)), turns


def _met(rays: np.ndarray, center: np.ndarray, height: float, radius: float) -> np.ndarray:
    """[H, W], how far along rays a level disc is; NaN where they miss it."""
    down = (height - center[2]) / np.where(rays[..., 2] < 0, rays[..., 2], np.nan)
    spot = center[:2] + rays[..., :2] * down[..., None]
    return np.where(np.hypot(spot[..., 0], spot[..., 1]) < radius, down, np.nan)


@functools.cache
def made() -> tuple[tuple[NDArray[np.uint8], ...], tuple[NDArray[np.bool_], ...]]:
    """The pictures of a whole turn, and where the thing is in each."""
    shot = [render(pose) for pose in turned_poses(NUM)]
    return tuple(np.asarray(one) for one, _ in shot), tuple(thing for _, thing in shot)
