"""From where a subject was seen: directions, heights, and how far apart the views are.

World axes: +Z up. A capture around something has a point that its cameras look at
(`pipelines.scene.focus`); directions are counted around that. One that faces forward, or looks
about within a room, has none, and then nothing is said of directions.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from pipelines.scene.focus import find_focus

Floats = npt.NDArray[np.float64]

NUM_SECTORS = 36
"""Sectors of ten degrees."""
_REACH_DEG = 10.0
"""A picture shows the subject from its own direction and this much to either side."""


@dataclass(frozen=True)
class Around:
    """The views of a subject. Angles in degrees.

    focus: [3], the point that the cameras look at. azimuth, elevation: [N], where each camera
    stands as seen from the focus; azimuth from +X towards +Y, elevation from level up.
    covered: [NUM_SECTORS], whether the subject was seen from there; sector i starts at 10 i.
    """

    focus: Floats
    azimuth: Floats
    elevation: Floats
    covered: npt.NDArray[np.bool_]

    @property
    def covered_deg(self) -> float:
        """How much of the way around was seen, whichever way +X points."""
        return 360.0 - float(self._unseen_deg.sum())

    @property
    def heights_deg(self) -> float:
        """How much views differ in elevation: between the 5th and the 95th percentile."""
        low, high = np.percentile(self.elevation, [5, 95])
        return float(high - low)

    @property
    def widest_gap_deg(self) -> float:
        """The longest run of directions from which nothing was seen."""
        return float(self._unseen_deg.max())

    @property
    def _unseen_deg(self) -> Floats:
        """[N], behind each camera on the way around, how far nobody saw the subject from."""
        ahead = np.sort(self.azimuth)
        gaps = np.diff(np.append(ahead, ahead[0] + 360.0))
        unseen: Floats = np.maximum(gaps - 2 * _REACH_DEG, 0.0)
        return unseen


def look_around(poses: Floats) -> Around | None:
    """poses: [N, 3, 4] world_from_camera, OpenGL axes. None where cameras share no subject."""
    if len(poses) < 3:
        return None
    focus = find_focus(poses)
    if focus is None:
        return None
    away = poses[:, :, 3] - focus
    level = np.hypot(away[:, 0], away[:, 1])
    azimuth = np.degrees(np.arctan2(away[:, 1], away[:, 0])) % 360.0
    elevation = np.degrees(np.arctan2(away[:, 2], level))
    middles = (np.arange(NUM_SECTORS) + 0.5) * 360.0 / NUM_SECTORS
    apart = np.abs((middles[:, None] - azimuth[None, :] + 180.0) % 360.0 - 180.0)
    covered: npt.NDArray[np.bool_] = np.any(apart <= _REACH_DEG, axis=1)
    return Around(focus, azimuth, elevation, covered)
