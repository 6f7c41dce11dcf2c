"""White furniture before a white wall, filmed in an arc from the front.

The hard things about a home: a chest of drawers, a shelf, a stool and a wall that are all white and
plain, and meet each other where only shading tells; nothing is seen from behind. What has texture
is small: some books, a vase, a picture, a cushion, a wooden floor. Metres.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.sample import tracing
from pipelines.sample.scene import Floats, Primitive, Region, Scene
from pipelines.sample.takes import Take, looking_at, sway

ARC_DEG = 80.0
_WALL_Y_M = 2.0
_WOOD, _WALL, _WHITE, _INK, _BLUE, _RED, _GREEN, _STEEL = range(8)
_PALETTES: Floats = np.array(
    [
        [[0.46, 0.35, 0.25], [0.78, 0.64, 0.46], [0.58, 0.44, 0.32], [0.86, 0.75, 0.58]],
        [[0.94, 0.94, 0.93]] * 4,
        [[0.97, 0.97, 0.96]] * 4,
        [[0.14, 0.12, 0.11], [0.86, 0.80, 0.66], [0.30, 0.24, 0.20], [0.64, 0.30, 0.20]],
        [[0.10, 0.22, 0.50], [0.20, 0.52, 0.78], [0.90, 0.92, 0.94], [0.08, 0.30, 0.42]],
        [[0.72, 0.12, 0.14], [0.96, 0.76, 0.66], [0.48, 0.06, 0.24], [0.98, 0.54, 0.30]],
        [[0.12, 0.40, 0.20], [0.70, 0.84, 0.36], [0.06, 0.22, 0.20], [0.90, 0.94, 0.70]],
        [[0.30, 0.31, 0.33]] * 4,
    ]
)


def _plain(kind: int, center: tuple[float, float, float], size: tuple[float, ...]) -> Primitive:
    """A white thing without texture."""
    return Primitive(kind, center, size, 1.0, _WHITE, detail=0.0)


def _chest() -> tuple[Primitive, ...]:
    """A white chest, its top 90 cm high, with three drawers whose fronts stand out by 2 cm."""
    x, depth, front = -0.25, 0.24, _WALL_Y_M - 0.48
    drawers = tuple(
        _plain(tracing.BOX, (x, front - 0.01, z), (0.56, 0.01, 0.125)) for z in (0.19, 0.46, 0.73)
    )
    knobs = tuple(
        Primitive(tracing.SPHERE, (x + dx, front - 0.045, z), (0.025,), 1.0, _STEEL, detail=0.0)
        for dx in (-0.3, 0.3)
        for z in (0.19, 0.46, 0.73)
    )
    body = _plain(tracing.BOX, (x, _WALL_Y_M - depth, 0.45), (0.60, depth, 0.45))
    return (body, *drawers, *knobs)


def _stool() -> tuple[Primitive, ...]:
    """A white stool with a cushion on it, in front of the wall."""
    x, y = 0.95, 1.15
    legs = tuple(
        _plain(tracing.CYLINDER, (x + dx, y + dy, 0.21), (0.02, 0.21))
        for dx in (-0.15, 0.15)
        for dy in (-0.15, 0.15)
    )
    seat = _plain(tracing.BOX, (x, y, 0.435), (0.20, 0.20, 0.015))
    return (seat, *legs, Primitive(tracing.BOX, (x, y, 0.475), (0.16, 0.16, 0.025), 0.1, _BLUE))


SCENE = Scene(
    name="furniture",
    primitives=(
        Primitive(tracing.ROOM, (0.0, 0.0, 1.25), (2.4, _WALL_Y_M, 1.25), 0.3, _WOOD, detail=0.0),
        *_chest(),
        *_stool(),
        # What stands on the chest: a vase, books, a ball.
        Primitive(tracing.CYLINDER, (-0.60, 1.72, 1.02), (0.06, 0.12), 0.06, _GREEN),
        Primitive(tracing.BOX, (-0.10, 1.74, 0.96), (0.13, 0.09, 0.06), 0.05, _RED, 15.0),
        Primitive(tracing.SPHERE, (0.18, 1.66, 0.97), (0.07,), 0.06, _BLUE),
        # A white shelf on the wall with books on it, and a picture without a frame.
        _plain(tracing.BOX, (0.85, _WALL_Y_M - 0.11, 1.25), (0.42, 0.11, 0.014)),
        Primitive(tracing.BOX, (0.66, _WALL_Y_M - 0.10, 1.364), (0.12, 0.08, 0.10), 0.05, _INK),
        Primitive(tracing.BOX, (1.00, _WALL_Y_M - 0.10, 1.344), (0.07, 0.07, 0.08), 0.05, _RED),
        Primitive(tracing.BOX, (-0.30, _WALL_Y_M - 0.012, 1.55), (0.24, 0.012, 0.17), 0.1, _INK),
    ),
    palettes=_PALETTES,
    light=np.array([-0.9, -0.8, 2.3]),
    subject=Region((-2.0, 0.5, -0.01), (2.0, _WALL_Y_M + 0.01, 2.3)),
    things=Region((-0.9, 0.9, 0.06), (1.3, _WALL_Y_M - 0.03, 1.75)),
    beyond=1.0,
)


def pose(progress: float) -> Floats:
    """world_from_camera [3, 4]: an arc from the left to the right and half the way back, higher."""
    sweep = 2.0 * progress if progress < 0.6 else 1.2 - 1.5 * (progress - 0.6)
    angle = math.radians(ARC_DEG) * (sweep / 1.2 - 0.5)
    time = 7.0 * progress
    radius = 2.25 + 0.15 * math.sin(2 * math.pi * 1.3 * progress)
    height = 1.15 + 0.25 * math.sin(2 * math.pi * 0.9 * progress - 1.2)
    eye = np.array([radius * math.sin(angle), 1.5 - radius * math.cos(angle), height])
    eye += 0.015 * np.array([sway(time, s, 1.0, 0.57, 0.39) for s in (1.0, 2.0, 3.0)])
    target = np.array([0.15, 1.6, 0.78]) + np.array(
        [0.12 * sway(time, s, 2.3, 1.3, 0.9) for s in (4.0, 5.0, 6.0)]
    )
    return looking_at(eye, target, math.radians(2.0 * sway(time, 7.0, 1.9, 0.71)))


def gain(progress: float) -> float:
    """A phone's exposure before much white: it drifts by a quarter of a stop.

    Returns the factor on linear light.
    """
    return float(2.0 ** (0.25 * math.sin(2 * math.pi * 1.1 * progress + 0.9)))


TAKE = Take(SCENE, pose, gain)
