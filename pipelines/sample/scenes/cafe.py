"""A white round table with a few things on it, filmed in an arc from above, in a cafe.

The hard thing about lunch: a table top of which nothing but the rim and soft shadows can be
matched, and a white cup that is hardly told from it. All around is enough to see: a wooden floor,
coloured stools and a bench, pictures on the walls. Metres.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.sample import tracing
from pipelines.sample.scene import Floats, Primitive, Region, Scene
from pipelines.sample.takes import Take, looking_at, sway

ARC_DEG = 95.0
TOP_M, RADIUS_M = 0.74, 0.42
_WOOD, _WALL, _WHITE, _YELLOW, _BLUE, _RED, _GREEN, _STEEL = range(8)
_PALETTES: Floats = np.array(
    [
        [[0.36, 0.30, 0.26], [0.58, 0.50, 0.44], [0.46, 0.38, 0.33], [0.68, 0.60, 0.52]],
        [[0.78, 0.78, 0.76]] * 4,
        [[0.97, 0.97, 0.96]] * 4,
        [[0.94, 0.80, 0.16], [0.98, 0.94, 0.80], [0.86, 0.44, 0.10], [0.30, 0.56, 0.22]],
        [[0.10, 0.22, 0.50], [0.20, 0.52, 0.78], [0.90, 0.92, 0.94], [0.08, 0.30, 0.42]],
        [[0.72, 0.12, 0.14], [0.96, 0.76, 0.66], [0.48, 0.06, 0.24], [0.98, 0.54, 0.30]],
        [[0.12, 0.40, 0.20], [0.70, 0.84, 0.36], [0.06, 0.22, 0.20], [0.90, 0.94, 0.70]],
        [[0.30, 0.31, 0.33]] * 4,
    ]
)


def _table() -> tuple[Primitive, ...]:
    """A white top, 3 cm thick, on one steel leg."""
    top = Primitive(
        tracing.CYLINDER, (0.0, 0.0, TOP_M - 0.015), (RADIUS_M, 0.015), 1.0, _WHITE, detail=0.0
    )
    leg = Primitive(tracing.CYLINDER, (0.0, 0.0, 0.36), (0.035, 0.35), 1.0, _STEEL, detail=0.0)
    foot = Primitive(tracing.CYLINDER, (0.0, 0.0, 0.01), (0.24, 0.01), 1.0, _STEEL, detail=0.0)
    return (top, leg, foot)


SCENE = Scene(
    name="cafe",
    primitives=(
        Primitive(tracing.ROOM, (0.0, 0.3, 1.3), (2.6, 2.4, 1.3), 0.3, _WOOD, detail=0.0),
        *_table(),
        # On the table: a carton, a plain white cup, a bottle.
        Primitive(tracing.BOX, (-0.03, 0.04, TOP_M + 0.085), (0.04, 0.03, 0.085), 0.035, _YELLOW),
        Primitive(
            tracing.CYLINDER, (0.17, -0.09, TOP_M + 0.045), (0.04, 0.045), 1.0, _WHITE, detail=0.0
        ),
        Primitive(tracing.CYLINDER, (-0.20, -0.10, TOP_M + 0.10), (0.032, 0.10), 0.03, _GREEN),
        # Stools, a bench and pictures around it.
        Primitive(tracing.CYLINDER, (0.85, 0.55, 0.22), (0.20, 0.22), 0.15, _BLUE),
        Primitive(tracing.CYLINDER, (-0.80, 0.75, 0.22), (0.20, 0.22), 0.15, _RED),
        Primitive(tracing.BOX, (0.0, 2.30, 0.45), (1.5, 0.35, 0.45), 0.25, _BLUE),
        Primitive(tracing.BOX, (-0.6, 2.68, 1.55), (0.35, 0.02, 0.25), 0.12, _YELLOW),
        Primitive(tracing.BOX, (0.7, 2.68, 1.50), (0.30, 0.02, 0.35), 0.12, _RED),
        Primitive(tracing.BOX, (-2.57, 0.8, 1.40), (0.02, 0.40, 0.30), 0.12, _GREEN),
        Primitive(tracing.BOX, (2.57, 0.9, 1.40), (0.02, 0.40, 0.30), 0.12, _BLUE),
    ),
    palettes=_PALETTES,
    light=np.array([-0.5, -0.6, 2.4]),
    subject=Region((-0.60, -0.60, -0.01), (0.60, 0.60, 1.05)),
    things=Region((-0.30, -0.20, TOP_M + 0.015), (0.28, 0.20, TOP_M + 0.25)),
    beyond=1.0,
)


def pose(progress: float) -> Floats:
    """world_from_camera [3, 4]: an arc there, and back from higher up."""
    there = progress < 0.55
    sweep = progress / 0.55 if there else 1.0 - (progress - 0.55) / 0.45
    angle = math.radians(ARC_DEG) * (sweep - 0.5)
    rise = 0.5 - 0.5 * math.cos(2.0 * math.pi * min(max(progress - 0.3, 0.0), 0.7) / 0.7 * 0.5)
    time = 7.0 * progress
    radius = 1.02 + 0.08 * math.sin(2 * math.pi * 1.3 * progress)
    height = 1.12 + 0.42 * rise + 0.03 * math.sin(2 * math.pi * 2.1 * progress)
    eye = np.array([radius * math.sin(angle), -radius * math.cos(angle), height])
    eye += 0.01 * np.array([sway(time, s, 1.0, 0.57, 0.39) for s in (1.0, 2.0, 3.0)])
    target = np.array([0.0, 0.05, TOP_M + 0.02]) + np.array(
        [0.03 * sway(time, s, 2.3, 1.3, 0.9) for s in (4.0, 5.0, 6.0)]
    )
    return looking_at(eye, target, math.radians(2.0 * sway(time, 7.0, 1.9, 0.71)))


def gain(progress: float) -> float:
    """A phone's exposure before much white: it drifts by a fifth of a stop.

    Returns the factor on linear light.
    """
    return float(2.0 ** (0.2 * math.sin(2 * math.pi * 0.9 * progress + 0.4)))


TAKE = Take(SCENE, pose, gain)
