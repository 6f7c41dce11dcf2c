"""Which part of the world is the scene: a ball around what the cameras look at, and a box in it.

World units throughout. `focus` is the point that the cameras look at, `distance` how far they are
from it; what is farther than `max_distance * distance` from the focus is background and is not
exported. The box is the tightest that holds almost all of the surface that remains.

Captures come in three shapes, told apart by the poses alone:
- around something: the optical axes meet, in front of the cameras. Focus and distance follow from
  the poses (least squares over the axes).
- forward-facing (a door handle filmed with 0.3 m of travel) and outward-facing (a room): the axes
  are nearly parallel or meet behind the cameras. Then the surface that the trained scene shows in
  the middle of its views decides: the focus is its median, the distance the larger of the cameras'
  mean distance to it and the median depth.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

_MIN_AXIS_SPREAD = 0.02
"""Smallest eigenvalue of the mean (I - d d^T): sin^2 of the spread of the axes, here 8 degrees."""
_MIN_SHARE_IN_FRONT = 0.8
_BOX_PERCENTILE = 0.5
_BOX_MARGIN = 0.05


@dataclass(frozen=True)
class SceneBounds:
    """focus: [3]. distance, radius: world units. box_min, box_max: [3], inside the ball's box."""

    focus: Floats
    distance: float
    radius: float
    box_min: Floats
    box_max: Floats

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Whether points [..., 3] are part of the scene: [...]."""
        in_ball = np.linalg.norm(points - self.focus, axis=-1) <= self.radius
        in_box = np.all((points >= self.box_min) & (points <= self.box_max), axis=-1)
        inside: NDArray[np.bool_] = in_ball & in_box
        return inside

    @property
    def longest_side(self) -> float:
        """The longest side of the box."""
        return float(np.max(self.box_max - self.box_min))

    def as_dict(self) -> dict[str, object]:
        """Plain data for a summary."""
        return {
            "focus": [round(float(value), 6) for value in self.focus],
            "distance": round(self.distance, 6),
            "radius": round(self.radius, 6),
            "box_min": [round(float(value), 6) for value in self.box_min],
            "box_max": [round(float(value), 6) for value in self.box_max],
        }


def camera_focus(poses: Floats) -> Floats | None:
    """The point nearest to all optical axes, [3], or None where they do not define one.

    poses: [N, 3, 4]. Least squares: sum over cameras of (I - d d^T)(x - c) = 0. None where the
    axes spread less than 8 degrees or most cameras would have the point behind them.
    """
    centers, axes = poses[:, :, 3], -poses[:, :, 2]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    system = across.mean(axis=0)
    if np.linalg.eigvalsh(system)[0] < _MIN_AXIS_SPREAD:
        return None
    focus: Floats = np.linalg.solve(system, np.einsum("nij,nj->i", across, centers) / len(poses))
    in_front = ((focus - centers) * axes).sum(axis=1) > 0
    return focus if in_front.mean() >= _MIN_SHARE_IN_FRONT else None


def scene_bounds(
    poses: Floats, surface: Floats, central: Floats, depths: Floats, max_distance: float
) -> SceneBounds | None:
    """Bounds from poses and a sample of the trained surface.

    poses: [N, 3, 4]. surface: [P, 3] points seen in views spread over the capture. central: [C, 3]
    those in the middle of the views, with `depths` [C], their distances from their cameras.
    max_distance: radius of the ball, in distances. Returns None where no surface lies within it.
    """
    if len(central) == 0:
        return None
    focus = camera_focus(poses)
    if focus is not None:
        distance = float(np.linalg.norm(poses[:, :, 3] - focus, axis=1).mean())
    else:
        focus = np.median(central, axis=0)
        from_cameras = float(np.linalg.norm(poses[:, :, 3] - focus, axis=1).mean())
        distance = max(from_cameras, float(np.median(depths)))
    radius = max_distance * distance
    near = surface[np.linalg.norm(surface - focus, axis=1) <= radius]
    if len(near) == 0:
        return None
    low, high = np.percentile(near, (_BOX_PERCENTILE, 100.0 - _BOX_PERCENTILE), axis=0)
    margin = _BOX_MARGIN * float(np.max(high - low)) + 1e-9
    return SceneBounds(
        focus=focus,
        distance=distance,
        radius=radius,
        box_min=np.maximum(low - margin, focus - radius),
        box_max=np.minimum(high + margin, focus + radius),
    )
