"""A small object on a plain stand, filmed all round.

A bowl, concave and with a thin handle (24 mm), a dark glossy ball that mirrors the room, and a box,
on a white stand without any texture. The room around is painted, as the stand alone would not tell
where the cameras are. Metres.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.sample import tracing
from pipelines.sample.scene import PALETTES, Floats, Primitive, Region, Scene
from pipelines.sample.takes import Take, looking_at, sway

STAND_HEIGHT_M = 0.70
HANDLE_TUBE_M = 0.012
TURN_DEG = 372.0

_CROCKERY, _STONE, _WHITE = range(len(PALETTES), len(PALETTES) + 3)
_PALETTES: Floats = np.concatenate(
    [
        PALETTES,
        [
            [[0.80, 0.36, 0.22], [0.88, 0.50, 0.32], [0.74, 0.30, 0.20], [0.92, 0.60, 0.42]],
            [[0.10, 0.16, 0.30], [0.14, 0.22, 0.38], [0.08, 0.12, 0.24], [0.18, 0.26, 0.44]],
            [[0.95, 0.95, 0.94]] * 4,
        ],
    ]
)

SCENE = Scene(
    name="object",
    primitives=(
        Primitive(tracing.ROOM, (0.0, 0.0, 1.4), (3.0, 2.8, 1.4), 0.45, 0),
        Primitive(
            tracing.CYLINDER, (0.0, 0.0, STAND_HEIGHT_M / 2), (0.45, 0.35), 1.0, _WHITE, detail=0.0
        ),
        # The bowl stands on the plate; its inside takes the palette of the ball's stone.
        Primitive(tracing.BOWL, (0.0, 0.0, 0.90), (0.20, 0.172), 0.12, _CROCKERY, detail=0.7),
        Primitive(
            tracing.TORUS,
            (0.253, 0.0, 0.83),
            (0.07, HANDLE_TUBE_M),
            0.12,
            _CROCKERY,
            detail=0.7,
        ),
        Primitive(tracing.SPHERE, (-0.07, -0.31, 0.79), (0.09,), 0.15, _STONE, gloss=0.12),
        Primitive(tracing.BOX, (-0.06, 0.31, 0.745), (0.11, 0.07, 0.045), 0.07, 5, 15.0),
        # Around: things on the floor, for the cameras' poses.
        Primitive(tracing.BOX, (1.9, 1.3, 0.5), (0.35, 0.45, 0.5), 0.3, 6, 30.0),
        Primitive(tracing.CYLINDER, (-2.1, 1.0, 0.8), (0.3, 0.8), 0.3, 3),
        Primitive(tracing.SPHERE, (-1.7, -1.8, 0.5), (0.5,), 0.28, 5),
        Primitive(tracing.BOX, (1.6, -1.9, 0.4), (0.4, 0.3, 0.4), 0.3, 7, -12.0),
    ),
    palettes=_PALETTES,
    light=np.array([0.9, -1.4, 2.6]),
    subject=Region((-0.5, -0.5, 0.55), (0.5, 0.5, 1.0)),
    things=Region((-0.5, -0.5, STAND_HEIGHT_M + 0.015), (0.5, 0.5, 1.0)),
)


def pose(progress: float) -> Floats:
    """world_from_camera [3, 4]: once around the stand, up and down, looking at the bowl."""
    angle = math.radians(-90.0 + TURN_DEG * progress)
    radius = 1.02 + 0.10 * math.sin(2 * math.pi * 1.5 * progress + 0.4)
    height = 1.28 + 0.24 * math.sin(2 * math.pi * 2.2 * progress - 0.9)
    time = 6.0 * progress
    eye = np.array([radius * math.cos(angle), radius * math.sin(angle), height])
    eye += 0.01 * np.array([sway(time, s, 0.9, 0.53, 0.37) for s in (1.0, 2.0, 3.0)])
    target = np.array([0.0, 0.0, 0.80]) + np.array(
        [0.03 * sway(time, s, 1.7, 0.83, 0.41) for s in (4.0, 5.0, 6.0)]
    )
    return looking_at(eye, target, math.radians(2.5 * sway(time, 7.0, 1.9, 0.71)))


TAKE = Take(SCENE, pose)
