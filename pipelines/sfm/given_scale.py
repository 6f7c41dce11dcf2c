"""How long things are: by the path of the given poses, or by the depth that a sensor measured.

Refined poses are moved back onto the given centres, which drift: the scale of the path is about as
uncertain as its shape is wrong. A sensor measures lengths anew in every picture, with an error of
its own. Where both agree within these uncertainties, the scale is their mean, weighted by them
(the inverse of the squares); where they do not, something else is wrong, as a sensor's unit, and
the path is believed.

Symbols: N images; poses [N, 3, 4] world_from_camera, OpenCV axes; shares are natural logarithms.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from pipelines.sfm.given_depth import Beside
from pipelines.sfm.given_refinement import Refined
from pipelines.sfm.tracks import Bools, Floats

SHARE_IN_SCALE = 0.5
"""Error of a path's scale, as a share, in the root mean square of what else its centres are off,
in that of their distance from their middle. Drift that was made up as waves and as random walks
along four paths: 0.32 to 0.57 (root mean squares)."""
_LEAST_UNCERTAIN = 1e-3
SENSOR_BIAS, SENSOR_BIAS_M = 0.005, 0.005
"""By how much a phone's sensor may be off everywhere, as a share and in metres, one standard
deviation: Luetzenburg et al., "Evaluation of the Apple iPhone 12 Pro LiDAR for an application in
geosciences", 2021, find 1 cm on small things."""
_DEVIATION = 1.4826
"""Standard deviation in the median deviation, of a normal distribution."""
MOST_SPREAD = 0.05
"""Median deviation of points from measured depth beyond which a sensor says nothing."""
_AGREE = 3.0
"""Standard deviations within which both may be right."""
_OUTLYING = 3.0
CONTRADICTS = 0.03
"""Share from which it is to be told that both do not agree: less may be either's."""


@dataclass(frozen=True)
class Scale:
    """What refined lengths are multiplied by, and why.

    factor: 1 where the path alone is believed. by_sensor: what it would be by the sensor alone,
    None where that says nothing. path_uncertain, sensor_uncertain: standard deviations, as shares.
    weight: of the sensor, 0 to 1. why: in words.
    """

    factor: float
    why: str
    path_uncertain: float
    weight: float = 0.0
    by_sensor: float | None = None
    sensor_uncertain: float | None = None

    @property
    def is_contradicted(self) -> bool:
        """Whether a sensor that is sure of itself says something else than the path."""
        if self.by_sensor is None or self.sensor_uncertain is None or self.weight > 0.0:
            return False
        return abs(float(np.log(self.by_sensor))) > CONTRADICTS

    def as_dict(self) -> dict[str, Any]:
        """As report.json has it."""
        return {
            "believed": "path" if self.weight == 0.0 else "path and sensor",
            "factor": round(self.factor, 6),
            "by_sensor": None if self.by_sensor is None else float(f"{self.by_sensor:.5g}"),
            "sensor_weight": round(self.weight, 4),
            "path_uncertain": round(self.path_uncertain, 5),
            "sensor_uncertain": None
            if self.sensor_uncertain is None
            else round(self.sensor_uncertain, 5),
            "why": self.why,
        }


def path_uncertainty(given: Floats, refined: Floats, use: Bools) -> float:
    """How uncertain the scale is that refined poses have from the given centres, as a share.

    use: [N], images whose refined pose says something of the path. Those far off the others, as of
    rows mixed up, have no say.
    """
    off = np.linalg.norm(refined[use, :, 3] - given[use, :, 3], axis=1)
    if len(off) < 3:
        return float("inf")
    near = off <= _OUTLYING * max(float(np.median(off)), 1e-12)
    centers = refined[use, :, 3][near]
    reach = np.sqrt(((centers - centers.mean(axis=0)) ** 2).sum(axis=1).mean())
    if reach <= 0:
        return float("inf")
    return max(float(SHARE_IN_SCALE * np.sqrt((off[near] ** 2).mean()) / reach), _LEAST_UNCERTAIN)


def sensor_uncertainty(beside: Beside) -> float:
    """How uncertain the scale is that a sensor tells, as a share: noise falls with the number of
    pictures (places in one of them may share an error), bias does not. World units are metres."""
    noise = _DEVIATION * beside.spread / np.sqrt(beside.num_images)
    return float(np.sqrt(noise**2 + SENSOR_BIAS**2 + (SENSOR_BIAS_M / beside.depth) ** 2))


def weighed(given: Floats, refined: Refined, beside: Beside | None) -> Scale:
    """The scale of refined poses that lie on the given centres. World units are metres."""
    path = path_uncertainty(given, refined.poses, refined.is_seen & ~refined.is_anew)
    if beside is None:
        return Scale(1.0, "there is too little measured depth to tell", path)
    wanted = -float(np.log(beside.ratio))
    by_sensor = float(np.exp(wanted))
    if beside.spread > MOST_SPREAD:
        why = f"points deviate from measured depth by {beside.spread:.1%} (median), too much"
        return Scale(1.0, why, path, by_sensor=by_sensor)
    sensor = sensor_uncertainty(beside)
    both = f"the path knows lengths within {path:.1%}, the sensor within {sensor:.1%}"
    if abs(wanted) > _AGREE * np.hypot(path, sensor):
        why = f"{both}, and they contradict each other: by the sensor {by_sensor:.4g} times as long"
        return Scale(1.0, why, path, 0.0, by_sensor, sensor)
    weight = 1.0 if np.isinf(path) else path**2 / (path**2 + sensor**2)
    factor = float(np.exp(weight * wanted))
    why = f"{both}, and says they are {by_sensor:.4f} times as long"
    return Scale(factor, why, path, float(weight), by_sensor, sensor)


def scaled(found: Refined, factor: float, about: Floats) -> Refined:
    """Poses and points larger by a factor, about a point [3] that stays where it is."""
    poses = found.poses.copy()
    poses[:, :, 3] = about + factor * (poses[:, :, 3] - about)
    return replace(found, poses=poses, points=about + factor * (found.points - about))
