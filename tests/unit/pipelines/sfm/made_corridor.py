"""Sightings along a straight way past a wall, which leave the path loose: it bends unless held."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from pipelines.scene.cameras_file import Intrinsics
from pipelines.tools.colmap_posing import Floats, Sightings

NUM, LENGTH = 40, 12.0
LENS = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)


def at_once(_what: str, call: Callable[[Any], Any]) -> Any:
    return call(None)


def corridor() -> tuple[Floats, Floats, Sightings]:
    """True poses [N, 3, 4], OpenCV axes, points on a wall 3 away, and what is seen of them, half a
    pixel off; a point is seen from two or three places only."""
    random = np.random.default_rng(5)
    poses = np.tile(np.eye(3, 4), (NUM, 1, 1))
    poses[:, 0, 3] = np.linspace(0.0, LENGTH, NUM)
    places = random.uniform((-1.0, -1.0, 2.6), (LENGTH + 1.0, 1.0, 3.4), (700, 3))
    point, image, xy = [], [], []
    for number, place in enumerate(places):
        near = np.argsort(np.abs(poses[:, 0, 3] - place[0]))[: 2 + number % 2]
        for index in near.tolist():
            local = place - poses[index, :, 3]
            pixel = LENS.fl_x * local[:2] / local[2] + (LENS.cx, LENS.cy)
            point.append(number)
            image.append(index)
            xy.append(pixel + random.normal(0.0, 0.5, 2))
    return poses, places, Sightings(np.array(point), np.array(image), np.array(xy))


def wavering(poses: Floats, size: float) -> Floats:
    """The same poses with centres that waver by about `size` along the way."""
    along = np.linspace(0.0, 2 * np.pi, NUM)
    waves = np.stack([np.sin(3 * along), np.cos(2 * along), np.sin(4 * along + 1)], axis=1)
    moved = poses.copy()
    moved[:, :, 3] += size * (waves - waves.mean(axis=0))
    return moved
