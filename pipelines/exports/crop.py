"""A part of the world cut out by hand: an oriented box or a ball, for meshes and clouds.

World units, in the frame of `cameras.json` (`pipelines.exports.frame`). Whether a crop holds any
surface at all is asked of small views first, so that a wrong one ends in seconds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from pipelines.errors import ExportError
from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.options import CropShapeOptions
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView
from pipelines.scene.orientation import Similarity

Floats = NDArray[np.float64]

_NEAR_PX = 2.0
"""Surface that is this near a crop, in pixels of the view that shows it, may reach into it."""


@dataclass(frozen=True)
class Crop:
    """center: [3]. axes: [3, 3], the box's own axes in its columns. half: [3], half of its sides.

    radius: of a ball, which has no axes and half; None for a box. frame_from_world: the way to the
    frame that it was given in, where that is not the world: what is told of it is told there.
    """

    center: Floats
    axes: Floats
    half: Floats
    radius: float | None = None
    frame_from_world: Similarity | None = None

    def distance(self, points: Floats) -> Floats:
        """[...] how far points [..., 3] are outside, 0 for those inside."""
        away = points - self.center
        if self.radius is not None:
            from_ball: Floats = np.maximum(np.linalg.norm(away, axis=-1) - self.radius, 0.0)
            return from_ball
        beyond = np.maximum(np.abs(away @ self.axes) - self.half, 0.0)
        outside: Floats = np.linalg.norm(beyond, axis=-1)
        return outside

    def contains(self, points: Floats) -> NDArray[np.bool_]:
        """[...] whether points [..., 3] are inside."""
        inside: NDArray[np.bool_] = self.distance(points) <= 0.0
        return inside

    def corners(self) -> tuple[Floats, Floats]:
        """The least and the greatest corner [3] of the upright box around it."""
        reach = np.abs(self.axes) @ self.half
        return self.center - reach, self.center + reach


def crop_of(options: CropShapeOptions) -> Crop | None:
    """The crop that is asked for, None for all of the scene."""
    if options.shape == "none":
        return None
    center = np.asarray(options.center, np.float64)
    if options.shape == "sphere":
        return Crop(center, np.eye(3), np.full(3, options.radius), options.radius)
    roll, pitch, yaw = np.radians(options.rotation_deg)
    axes = _turn(yaw, 2) @ _turn(pitch, 1) @ _turn(roll, 0)
    return Crop(center, axes, np.asarray(options.size, np.float64) / 2.0)


def _turn(angle: float, axis: int) -> Floats:
    """[3, 3], counter-clockwise about an axis of the world."""
    matrix = np.eye(3)
    first, second = (axis + 1) % 3, (axis + 2) % 3
    matrix[[first, second], [first, second]] = np.cos(angle)
    matrix[second, first] = np.sin(angle)
    matrix[first, second] = -np.sin(angle)
    return matrix


def narrowed(bounds: SceneBounds, crop: Crop | None) -> SceneBounds | None:
    """The bounds less what is certainly outside the crop; None where nothing remains."""
    if crop is None:
        return bounds
    low, high = crop.corners()
    low, high = np.maximum(bounds.box_min, low), np.minimum(bounds.box_max, high)
    return replace(bounds, box_min=low, box_max=high) if np.all(low < high) else None


def cropped(mesh: TriangleMesh, crop: Crop | None) -> TriangleMesh:
    """The faces that are wholly inside, with the vertices that they have."""
    if crop is None or len(mesh.faces) == 0:
        return mesh
    return mesh.with_faces(mesh.faces[crop.contains(mesh.vertices)[mesh.faces].all(axis=1)])


def surface_in(
    crop: Crop | None, views: Sequence[DepthView], bounds: SceneBounds, kind: str
) -> Floats:
    """[P, 3] the surface that views show, in the crop and around it, where some of it is inside.

    views: small ones spread over the capture. bounds: all that would be exported without the crop.
    kind: of the export, for the error. Raises ExportError `export.empty` where no view shows
    surface in the crop, or hardly beside it, or where it is outside the bounds.
    """
    found = [np.zeros((0, 3))]
    near = crop is None
    for view in views:
        mask = bounds.mask(view)
        points = view.points()[mask]
        found.append(points)
        if crop is None:
            continue
        pixel = view.z_depth[mask] / min(view.lens.fl_x, view.lens.fl_y)
        near = near or bool((crop.distance(points) <= _NEAR_PX * pixel).any())
    surface = np.concatenate(found)
    if crop is not None and (not near or narrowed(bounds, crop) is None):
        raise empty_crop(crop, surface, kind)
    return surface


def empty_crop(crop: Crop, points: Floats, kind: str) -> ExportError:
    """The error for a crop that holds nothing. points: [P, 3] of the surface around it."""
    outside = crop.distance(points) > 0.0
    nearest = float(crop.distance(points).min()) if len(points) else 0.0
    where = "the world of cameras.json"
    if crop.frame_from_world is not None:
        nearest *= crop.frame_from_world.scale
        points = crop.frame_from_world.apply_to_points(points)
        where = "the frame that is asked for"
    low, high = (end(points, axis=0) if len(points) else np.zeros(3) for end in (np.min, np.max))
    return ExportError(
        f"The crop of {kind} holds no surface: {outside.sum()} of {len(points)} points of it lie "
        f"outside, the nearest {nearest:.4g} away.",
        code="export.empty",
        hint=f"The surface reaches from {_told(low)} to {_told(high)}, in {where}; change "
        f"{kind}.crop.",
        details={
            "num_points": len(points),
            "num_outside": int(outside.sum()),
            "nearest_outside": round(nearest, 6),
            "surface_min": [round(float(value), 6) for value in low],
            "surface_max": [round(float(value), 6) for value in high],
        },
    )


def _told(point: Floats) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in point) + ")"
