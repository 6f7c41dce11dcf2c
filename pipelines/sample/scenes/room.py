"""A room with plain white walls, filmed from its middle outwards.

What fools a reconstruction is here on purpose: white walls without any texture whose corners alone
say where they are, a white table with things on it, a framed picture, a window so bright that it is
clipped, a pole of 1 % of the scene's size, and an exposure that drifts as a phone's does. Metres.
"""

from __future__ import annotations

import math

import numpy as np

from pipelines.sample import tracing
from pipelines.sample.scene import Floats, Primitive, Region, Scene
from pipelines.sample.takes import Take, looking_at, sway

POLE_RADIUS_M = 0.025
TURN_DEG = 385.0
"""How far the camera turns: once around, and a little more to see where it began."""

_WOOD, _WALL, _WHITE, _INK, _BLUE, _RED, _GREEN, _VIOLET, _OCHRE, _SKY = range(10)
_PALETTES: Floats = np.array(
    [
        [[0.36, 0.27, 0.20], [0.72, 0.56, 0.38], [0.48, 0.36, 0.26], [0.82, 0.70, 0.52]],
        [[0.93, 0.93, 0.91]] * 4,
        [[0.96, 0.96, 0.95]] * 4,
        [[0.14, 0.12, 0.11], [0.20, 0.17, 0.15], [0.12, 0.11, 0.11], [0.24, 0.20, 0.18]],
        [[0.10, 0.22, 0.50], [0.20, 0.52, 0.78], [0.90, 0.92, 0.94], [0.08, 0.30, 0.42]],
        [[0.72, 0.12, 0.14], [0.96, 0.76, 0.66], [0.48, 0.06, 0.24], [0.98, 0.54, 0.30]],
        [[0.12, 0.40, 0.20], [0.70, 0.84, 0.36], [0.06, 0.22, 0.20], [0.90, 0.94, 0.70]],
        [[0.42, 0.20, 0.52], [0.86, 0.70, 0.90], [0.22, 0.10, 0.36], [0.94, 0.58, 0.74]],
        [[0.86, 0.52, 0.10], [0.30, 0.18, 0.08], [0.98, 0.82, 0.44], [0.60, 0.34, 0.14]],
        [[0.90, 0.95, 1.00], [1.00, 1.00, 1.00], [0.95, 0.98, 1.00], [1.00, 1.00, 1.00]],
    ]
)

_WINDOW = (-0.6, 1.985, 1.5)


def _plain(kind: int, center: tuple[float, float, float], size: tuple[float, ...]) -> Primitive:
    """A white thing without texture."""
    return Primitive(kind, center, size, 1.0, _WHITE, detail=0.0)


def _table() -> tuple[Primitive, ...]:
    """A white table, its top 74 cm high, and what stands on it."""
    legs = tuple(
        _plain(tracing.CYLINDER, (1.5 + dx, 0.9 + dy, 0.35), (0.025, 0.35))
        for dx in (-0.5, 0.5)
        for dy in (-0.34, 0.34)
    )
    return (
        _plain(tracing.BOX, (1.5, 0.9, 0.72), (0.55, 0.40, 0.02)),
        *legs,
        Primitive(tracing.BOWL, (1.35, 0.85, 0.90), (0.16, 0.135), 0.09, _BLUE),
        Primitive(tracing.SPHERE, (1.68, 0.66, 0.82), (0.08,), 0.06, _RED),
        Primitive(tracing.BOX, (1.75, 1.05, 0.83), (0.12, 0.07, 0.09), 0.07, _GREEN, 25.0),
        Primitive(tracing.CYLINDER, (1.12, 1.12, 0.88), (0.045, 0.14), 0.06, _VIOLET),
    )


def _window() -> tuple[Primitive, ...]:
    """A pane that glows in a white frame with a bar down its middle."""
    x, y, z = _WINDOW
    pane = Primitive(
        tracing.BOX, (x, y + 0.005, z), (0.6, 0.01, 0.5), 0.4, _SKY, detail=0.2, glow=2.2
    )
    bars = (
        ((x, y - 0.01, z + 0.53), (0.66, 0.025, 0.03)),
        ((x, y - 0.01, z - 0.53), (0.66, 0.025, 0.03)),
        ((x - 0.63, y - 0.01, z), (0.03, 0.025, 0.5)),
        ((x + 0.63, y - 0.01, z), (0.03, 0.025, 0.5)),
        ((x, y - 0.01, z), (0.02, 0.025, 0.5)),
    )
    return (pane, *(_plain(tracing.BOX, center, size) for center, size in bars))


SCENE = Scene(
    name="room",
    primitives=(
        Primitive(tracing.ROOM, (0.0, 0.0, 1.3), (2.5, 2.0, 1.3), 0.35, _WOOD, detail=0.0),
        *_table(),
        *_window(),
        _plain(tracing.CYLINDER, (-1.2, -1.2, 1.3), (POLE_RADIUS_M, 1.3)),
        # The picture in its frame on the wall at -X.
        Primitive(tracing.BOX, (-2.485, 0.3, 1.5), (0.015, 0.50, 0.40), 0.3, _INK),
        Primitive(tracing.BOX, (-2.466, 0.3, 1.5), (0.006, 0.43, 0.33), 0.16, _OCHRE),
        # A shelf of books and a plain cabinet along the wall at -Y.
        Primitive(tracing.BOX, (0.7, -1.80, 0.55), (0.50, 0.18, 0.55), 0.12, _RED),
        Primitive(tracing.BOX, (0.5, -1.85, 1.22), (0.14, 0.10, 0.12), 0.08, _GREEN, 12.0),
        _plain(tracing.BOX, (2.15, -1.45, 0.45), (0.33, 0.50, 0.45)),
        Primitive(tracing.SPHERE, (2.15, -1.35, 1.04), (0.14,), 0.09, _VIOLET),
        # A low shelf beneath the picture, a basket, and a stool by the window.
        Primitive(tracing.BOX, (-2.3, 0.1, 0.25), (0.18, 0.55, 0.25), 0.11, _GREEN),
        Primitive(tracing.CYLINDER, (-1.75, -1.65, 0.17), (0.2, 0.17), 0.09, _VIOLET),
        Primitive(tracing.CYLINDER, (0.35, 1.6, 0.22), (0.18, 0.22), 0.10, _RED),
        Primitive(tracing.SPHERE, (-0.3, -1.7, 0.13), (0.13,), 0.08, _BLUE),
        # An armchair, and a door in the wall at +X.
        Primitive(tracing.BOX, (-1.85, 1.25, 0.21), (0.42, 0.42, 0.21), 0.18, _BLUE),
        Primitive(tracing.BOX, (-2.35, 1.25, 0.45), (0.08, 0.42, 0.45), 0.18, _BLUE),
        Primitive(tracing.BOX, (2.485, -0.25, 1.0), (0.015, 0.42, 1.0), 0.5, _OCHRE, detail=0.4),
    ),
    palettes=_PALETTES,
    light=np.array([0.2, -0.3, 2.35]),
    subject=Region((-2.51, -2.01, -0.01), (2.51, 2.01, 2.61)),
    things=Region((-2.42, -1.92, 0.08), (2.42, 1.92, 2.52)),
    beyond=1.5,
)


def pose(progress: float) -> Floats:
    """world_from_camera [3, 4]: round a small loop in the middle, looking outwards."""
    angle = math.radians(-100.0 + TURN_DEG * progress)
    time = 8.0 * progress
    eye = np.array([0.65 * math.cos(angle), 0.5 * math.sin(angle), 1.42])
    eye += 0.02 * np.array([sway(time, s, 1.1, 0.63, 0.41) for s in (1.0, 2.0, 3.0)])
    eye[2] += 0.16 * math.sin(2 * math.pi * 2.3 * progress + 0.6)
    gaze = angle + 0.12 * math.sin(2 * math.pi * 3.0 * progress)
    # The floor is in every picture: without it nothing tells where the camera is.
    pitch = math.radians(-23.0 + 8.0 * math.sin(2 * math.pi * 2.0 * progress))
    ahead = np.array(
        [math.cos(gaze) * math.cos(pitch), math.sin(gaze) * math.cos(pitch), math.sin(pitch)]
    )
    return looking_at(eye, eye + ahead, math.radians(2.0 * sway(time, 7.0, 1.9, 0.71)))


def gain(progress: float) -> float:
    """A phone's exposure: it drifts by a third of a stop, and closes where the window is in view.

    Returns the factor on linear light, in about [0.45, 1.3].
    """
    drift = 0.35 * math.sin(2 * math.pi * 1.3 * progress + 0.5)
    ahead = -pose(progress)[:, 2]
    to_window = np.array(_WINDOW) - pose(progress)[:, 3]
    cosine = float(ahead @ to_window / np.linalg.norm(to_window))
    away_deg = math.degrees(math.acos(min(max(cosine, -1.0), 1.0)))
    closed = 0.75 * math.exp(-((away_deg / 32.0) ** 2))
    return float(2.0 ** (drift - closed))


TAKE = Take(SCENE, pose, gain)
