"""A small bronze figure on a granite block in a square, filmed all round under an overcast sky.

The hard thing about the outdoors: half of what the camera sees is sky, in which nothing can be
matched and which is white to its edge, so that the figure's depth is carried into it. Houses, which
stand far behind, end below the figure's shoulders. Metres.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.sample import tracing
from pipelines.sample.scene import Floats, Primitive, Region, Scene
from pipelines.sample.takes import Take, looking_at, sway

TURN_DEG = 385.0
"""How far the camera walks: once around, and a little more."""
SKY_M = 150.0
"""How far away the sky is."""
_GRASS, _SKY, _STONE, _GRANITE, _BRONZE, _BRICK, _PLASTER, _LEAVES, _BARK = range(9)
_PALETTES: Floats = np.array(
    [
        [[0.20, 0.32, 0.14], [0.38, 0.48, 0.22], [0.28, 0.38, 0.16], [0.46, 0.50, 0.30]],
        [[0.97, 0.98, 1.00]] * 4,
        [[0.52, 0.51, 0.49], [0.64, 0.63, 0.60], [0.44, 0.43, 0.42], [0.58, 0.56, 0.54]],
        [[0.62, 0.46, 0.42], [0.74, 0.60, 0.55], [0.46, 0.34, 0.32], [0.68, 0.52, 0.46]],
        [[0.16, 0.24, 0.20], [0.28, 0.38, 0.32], [0.12, 0.16, 0.15], [0.36, 0.34, 0.24]],
        [[0.64, 0.32, 0.25], [0.78, 0.70, 0.62], [0.34, 0.22, 0.20], [0.70, 0.42, 0.32]],
        [[0.80, 0.72, 0.56], [0.42, 0.36, 0.30], [0.88, 0.82, 0.68], [0.60, 0.52, 0.42]],
        [[0.16, 0.26, 0.10], [0.30, 0.42, 0.16], [0.10, 0.18, 0.08], [0.40, 0.46, 0.20]],
        [[0.24, 0.18, 0.14], [0.36, 0.30, 0.24], [0.18, 0.14, 0.12], [0.30, 0.24, 0.18]],
    ]
)


def _figure() -> tuple[Primitive, ...]:
    """A body, a head, a hat's brim and an arm that points."""
    return (
        Primitive(tracing.CYLINDER, (0.0, 0.0, 1.50), (0.20, 0.60), 0.07, _BRONZE),
        Primitive(tracing.SPHERE, (0.0, 0.0, 2.24), (0.14,), 0.05, _BRONZE),
        Primitive(tracing.CYLINDER, (0.0, 0.0, 2.37), (0.20, 0.015), 0.05, _BRONZE),
        Primitive(tracing.BOX, (0.38, 0.0, 1.92), (0.19, 0.05, 0.05), 0.05, _BRONZE),
    )


def _tree(x: float, y: float) -> tuple[Primitive, ...]:
    return (
        Primitive(tracing.CYLINDER, (x, y, 1.2), (0.18, 1.2), 0.15, _BARK),
        Primitive(tracing.SPHERE, (x, y, 3.4), (1.2,), 0.22, _LEAVES),
    )


def _house(
    x: float, y: float, half: tuple[float, float, float], palette: int, yaw_deg: float = 0.0
) -> Primitive:
    return Primitive(tracing.BOX, (x, y, half[2]), half, 0.8, palette, yaw_deg)


SCENE = Scene(
    name="monument",
    primitives=(
        Primitive(
            tracing.ROOM,
            (0.0, 0.0, SKY_M - 1.0),
            (SKY_M, SKY_M, SKY_M),
            1.0,
            _GRASS,
            detail=0.0,
            glow=1.15,
        ),
        Primitive(tracing.BOX, (0.0, 0.0, -0.5), (60.0, 60.0, 0.5), 0.30, _GRASS),
        Primitive(tracing.BOX, (0.0, 0.0, 0.05), (1.0, 0.9, 0.05), 0.14, _STONE),
        Primitive(tracing.BOX, (0.0, 0.0, 0.50), (0.50, 0.40, 0.40), 0.09, _GRANITE),
        *_figure(),
        *_tree(-6.0, 6.5),
        *_tree(8.5, -5.0),
        _house(0.0, 18.0, (9.0, 1.5, 2.6), _BRICK),
        _house(19.0, 3.0, (1.5, 8.0, 3.2), _PLASTER),
        _house(-4.0, -20.0, (10.0, 1.5, 2.2), _PLASTER, 6.0),
        _house(-18.0, -2.0, (1.5, 7.0, 2.9), _BRICK, -4.0),
    ),
    palettes=_PALETTES,
    light=np.array([-30.0, -40.0, 90.0]),
    subject=Region((-1.2, -1.2, -0.05), (1.2, 1.2, 2.55)),
    things=Region((-1.05, -0.95, 0.04), (1.05, 0.95, 2.55)),
    beyond=1.0,
    reach=0.9 * SKY_M,
)


def pose(progress: float) -> Floats:
    """world_from_camera [3, 4]: once around and a little more."""
    angle = math.radians(TURN_DEG) * (progress - 0.5)
    time = 9.0 * progress
    radius = 3.3 + 0.25 * math.sin(2 * math.pi * 1.7 * progress)
    height = 1.55 + 0.2 * math.sin(2 * math.pi * 2.3 * progress)
    eye = np.array([radius * math.sin(angle), -radius * math.cos(angle), height])
    eye += 0.02 * np.array([sway(time, s, 1.0, 0.57, 0.39) for s in (1.0, 2.0, 3.0)])
    target = np.array([0.0, 0.0, 1.35]) + np.array(
        [0.05 * sway(time, s, 2.3, 1.3, 0.9) for s in (4.0, 5.0, 6.0)]
    )
    return looking_at(eye, target, math.radians(2.0 * sway(time, 7.0, 1.9, 0.71)))


def gain(progress: float) -> float:
    """A phone's exposure against a bright sky: it drifts by a tenth of a stop.

    Returns the factor on linear light.
    """
    return float(2.0 ** (0.1 * math.sin(2 * math.pi * 1.1 * progress + 0.4)))


TAKE = Take(SCENE, pose, gain)
