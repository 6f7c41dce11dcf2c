"""Which part of the world is the scene: a ball around what the cameras look at, and a box in it.

World units throughout. `focus` is the point that the cameras look at, `distance` how far they are
from it; what is farther than `max_distance * distance` from the focus is background and is not
exported. The box is the tightest that holds almost all of the surface that remains, and what a
fifth of the views show of the rest.

Captures come in three shapes, told apart by the poses alone:
- around something: the optical axes meet, in front of the cameras. Focus and distance follow from
  the poses (`pipelines.scene.focus`).
- forward-facing (a door handle filmed with 0.3 m of travel) and outward-facing (a room): the axes
  are nearly parallel or meet behind the cameras. Then the surface that the trained scene shows in
  the middle of its views decides: the focus is its median, the distance the larger of the cameras'
  mean distance to it and the median depth.

Cameras that are far away from all others hardly count (`usual_distance`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.scene.depth_views import DepthView
from pipelines.scene.focus import find_focus, usual_distance

Floats = NDArray[np.float64]

_BOX_PERCENTILE = 0.5
_BOX_MARGIN = 0.05
_CELLS, _SURE_SHARE = 20, 0.2
"""Two views show the same where it is in one cube, of which so many make the distance; and so many
of them have to."""


@dataclass(frozen=True)
class SceneBounds:
    """focus: [3]. distance, radius: world units. box_min, box_max: [3], inside the ball's box.

    widened_by: what the box's longest side has on that of the box of almost all of the surface.
    """

    focus: Floats
    distance: float
    radius: float
    box_min: Floats
    box_max: Floats
    widened_by: float = 0.0

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """Whether points [..., 3] are part of the scene: [...]."""
        in_ball = np.linalg.norm(points - self.focus, axis=-1) <= self.radius
        in_box = np.all((points >= self.box_min) & (points <= self.box_max), axis=-1)
        inside: NDArray[np.bool_] = in_ball & in_box
        return inside

    def mask(self, view: DepthView) -> NDArray[np.bool_]:
        """[H, W] the pixels of a view whose depth is to be trusted and lies in the scene."""
        wanted: NDArray[np.bool_] = view.smooth_mask() & self.contains(view.points())
        return wanted

    @property
    def longest_side(self) -> float:
        """The longest side of the box."""
        return float(np.max(self.box_max - self.box_min))

    @property
    def usual_side(self) -> float:
        """The longest side of what holds almost all of the surface: a stem makes nothing coarse."""
        return self.longest_side - self.widened_by

    def as_dict(self) -> dict[str, object]:
        """Plain data for a summary."""
        return {
            "focus": [round(float(value), 6) for value in self.focus],
            "distance": round(self.distance, 6),
            "radius": round(self.radius, 6),
            "box_min": [round(float(value), 6) for value in self.box_min],
            "box_max": [round(float(value), 6) for value in self.box_max],
        }


def bounds_of_views(
    views: Sequence[DepthView], poses: Floats, max_distance: float
) -> SceneBounds | None:
    """`scene_bounds` from the surface that views spread over the capture show.

    poses: [N, 3, 4] of all its cameras.
    """
    surface, central, depths = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)]
    for view in views:
        known = view.smooth_mask()
        middle = np.zeros_like(known)
        height, width = known.shape
        middle[height // 3 : -(height // 3) or None, width // 3 : -(width // 3) or None] = True
        points = view.points()
        surface.append(points[known])
        central.append(points[known & middle])
        depths.append(np.linalg.norm(central[-1] - view.world_from_camera[:, 3], axis=1))
    bounds = scene_bounds(
        poses,
        np.concatenate(surface),
        np.concatenate(central),
        np.concatenate(depths),
        max_distance,
    )
    return None if bounds is None else _with_what_many_see(bounds, surface[1:])


def _with_what_many_see(bounds: SceneBounds, seen: Sequence[Floats]) -> SceneBounds:
    """The bounds with what a share of the views see beyond them: a stem is few of all pixels.

    seen: [P, 3] of each view.
    """
    near = [part[np.linalg.norm(part - bounds.focus, axis=1) <= bounds.radius] for part in seen]
    points = np.concatenate(near)
    if len(points) == 0:
        return bounds
    cells = np.floor((points - bounds.focus) * (_CELLS / bounds.distance)).astype(np.int64)
    view = np.repeat(np.arange(len(near)), [len(part) for part in near])
    # Cells, and pairs of cell and view, as one number each: rows of several sort ten times as long.
    x, y, z = (cells - cells.min(axis=0)).T
    _, cell = np.unique((x * (y.max() + 1) + y) * (z.max() + 1) + z, return_inverse=True)
    votes = np.bincount(np.unique(cell * len(near) + view) // len(near))
    sure = points[votes[cell] >= max(2.0, _SURE_SHARE * len(seen))]
    beyond = sure[~bounds.contains(sure)]
    if len(beyond) == 0:
        return bounds
    margin = bounds.distance / _CELLS
    low, high = beyond.min(axis=0) - margin, beyond.max(axis=0) + margin
    wide = replace(
        bounds,
        box_min=np.maximum(np.minimum(bounds.box_min, low), bounds.focus - bounds.radius),
        box_max=np.minimum(np.maximum(bounds.box_max, high), bounds.focus + bounds.radius),
    )
    return replace(wide, widened_by=wide.longest_side - bounds.longest_side)


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
    focus = find_focus(poses)
    if focus is not None:
        distance = usual_distance(poses, focus)
    else:
        focus = np.median(central, axis=0)
        distance = max(usual_distance(poses, focus), float(np.median(depths)))
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
