"""A small ruin on a plinth before black, filmed all round.

The hard thing about black cloth: three quarters of each picture are black to their edge, in which
nothing can be matched, so that the ruin's depth is carried into them. One looks past it between its
columns and through a ring. Metres.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.sample import tracing
from pipelines.sample.scene import PALETTES, Floats, Primitive, Region, Scene
from pipelines.sample.takes import Take, looking_at, sway

PLINTH_M, TURN_DEG = 0.70, 372.0
BLACK_M = 6.0
"""How far away the black is."""
_MARBLE, _SLATE, _BLACK = range(len(PALETTES), len(PALETTES) + 3)
"""The room's walls take the row behind its floor's: black twice."""
_PALETTES: Floats = np.concatenate(
    [
        PALETTES,
        [
            [[0.86, 0.78, 0.62], [0.70, 0.58, 0.42], [0.94, 0.88, 0.76], [0.58, 0.46, 0.34]],
            [[0.42, 0.46, 0.50], [0.58, 0.60, 0.58], [0.34, 0.36, 0.42], [0.66, 0.62, 0.56]],
            *[[[0.015, 0.015, 0.02]] * 4] * 2,
        ],
    ]
)
_STEP, _COLUMN = (0.24, 0.15, 0.02), (0.026, 0.11)
"""Half sides of the lower step; radius and half height of a column."""


def _ruin(ground: float) -> tuple[Primitive, ...]:
    """Two steps, four columns, one of them broken, a beam, a ball and an upright ring."""
    floor = ground + 2 * _STEP[2] + 0.03
    columns = [(-0.15, 1.0), (-0.05, 1.0), (0.05, 1.0), (0.15, 0.55)]
    lower = Primitive(tracing.BOX, (0.0, 0.0, ground + _STEP[2]), _STEP, 0.06, _MARBLE)
    upper = Primitive(tracing.BOX, (0.0, 0.0, floor - 0.015), (0.20, 0.11, 0.015), 0.06, _MARBLE)
    standing = [
        Primitive(
            tracing.CYLINDER,
            (x, 0.04, floor + share * _COLUMN[1]),
            (_COLUMN[0], share * _COLUMN[1]),
            0.05,
            _MARBLE,
        )
        for x, share in columns
    ]
    beam = (-0.05, 0.04, floor + 2 * _COLUMN[1] + 0.02)
    return (
        lower,
        upper,
        *standing,
        Primitive(tracing.BOX, beam, (0.15, 0.04, 0.02), 0.05, _MARBLE),
        Primitive(tracing.SPHERE, (-0.10, -0.06, floor + 0.035), (0.035,), 0.04, 4),
        Primitive(tracing.TORUS, (0.08, -0.06, floor + 0.06), (0.05, 0.010), 0.04, 5),
    )


SCENE = Scene(
    name="exhibit",
    primitives=(
        Primitive(
            tracing.ROOM,
            (0.0, 0.0, 0.5),
            (BLACK_M, BLACK_M, BLACK_M),
            1.0,
            _BLACK,
            detail=0.0,
            glow=1.0,
        ),
        Primitive(tracing.BOX, (0.0, 0.0, PLINTH_M - 0.6), (0.32, 0.24, 0.6), 0.10, _SLATE, 8.0),
        *_ruin(PLINTH_M),
    ),
    palettes=_PALETTES,
    light=np.array([1.2, -1.8, 3.0]),
    subject=Region((-0.36, -0.30, 0.55), (0.36, 0.30, 1.05)),
    things=Region((-0.30, -0.25, PLINTH_M + 0.01), (0.30, 0.25, 1.05)),
    beyond=0.5,
    reach=0.8 * BLACK_M,
)


def pose(progress: float) -> Floats:
    """world_from_camera [3, 4]: once around, up and down, looking at the columns."""
    angle = math.radians(-90.0 + TURN_DEG * progress)
    radius = 0.95 + 0.08 * math.sin(2 * math.pi * 1.6 * progress + 0.4)
    height = 1.15 + 0.20 * math.sin(2 * math.pi * 2.2 * progress - 0.9)
    time = 6.0 * progress
    eye = np.array([radius * math.cos(angle), radius * math.sin(angle), height])
    eye += 0.01 * np.array([sway(time, s, 0.9, 0.53, 0.37) for s in (1.0, 2.0, 3.0)])
    target = np.array([0.0, 0.0, 0.82]) + np.array(
        [0.02 * sway(time, s, 1.7, 0.83, 0.41) for s in (4.0, 5.0, 6.0)]
    )
    return looking_at(eye, target, math.radians(2.0 * sway(time, 7.0, 1.9, 0.71)))


TAKE = Take(SCENE, pose)
