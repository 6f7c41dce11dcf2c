"""Depth views as a cloud of points: gathered, rid of outliers, thinned, given normals.

P points, in the world frame. Whether views agree on a point is left to `scene.consistency`.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.float64]

_geometry: Any = open3d.geometry
_utility: Any = open3d.utility

_NEIGHBOURS = 20
_OUTLIER_SIGMAS = 2.0


@dataclass(frozen=True)
class Cloud:
    """points, normals: [P, 3] world. colors: [P, 3] uint8. eyes: [P, 3], who saw each point."""

    points: Floats
    colors: NDArray[np.uint8]
    eyes: Floats

    def __len__(self) -> int:
        return len(self.points)

    def take(self, which: NDArray[Any]) -> Cloud:
        """The points that a mask or index array picks."""
        return Cloud(self.points[which], self.colors[which], self.eyes[which])


def gather(views: Iterable[DepthView], bounds: SceneBounds) -> Cloud:
    """The points of all views that lie in the scene and not on a jump in depth."""
    points, colors, eyes = [np.zeros((0, 3))], [np.zeros((0, 3), np.uint8)], [np.zeros((0, 3))]
    for view in views:
        mask = bounds.mask(view)
        points.append(view.points()[mask])
        colors.append(view.rgb[mask])
        eyes.append(np.broadcast_to(view.world_from_camera[:, 3], points[-1].shape))
    return Cloud(np.concatenate(points), np.concatenate(colors), np.concatenate(eyes))


def joined(clouds: Sequence[Cloud]) -> Cloud:
    """Clouds as one."""
    return Cloud(
        *(
            np.concatenate([getattr(cloud, name) for cloud in clouds])
            for name in ("points", "colors", "eyes")
        )
    )


def without_outliers(cloud: Cloud, origin: Floats) -> Cloud:
    """The points whose neighbours are not unusually far; `origin` [3]: a point near the cloud."""
    if len(cloud) <= _NEIGHBOURS:
        return cloud
    _, kept = _legacy(cloud, origin).remove_statistical_outlier(_NEIGHBOURS, _OUTLIER_SIGMAS)
    return cloud.take(np.asarray(kept, np.int64))


def thinned(cloud: Cloud, at_most: int, seed: int) -> Cloud:
    """At most so many of the points, picked at random, in their order."""
    if len(cloud) <= at_most:
        return cloud
    rng = np.random.default_rng(seed)
    return cloud.take(np.sort(rng.choice(len(cloud), at_most, replace=False)))


def oriented_normals(cloud: Cloud, origin: Floats, neighbours: int = _NEIGHBOURS) -> Floats:
    """Unit normals [P, 3] from each point's neighbours, turned to the camera that saw it.

    neighbours: so many, the point among them; more are smoother, on edges too.
    """
    legacy = _legacy(cloud, origin)
    legacy.estimate_normals(_geometry.KDTreeSearchParamKNN(neighbours))
    normals = np.asarray(legacy.normals, np.float64)
    to_eye = cloud.eyes - cloud.points
    # Too few neighbours give a zero normal: then the view direction is the best that is known.
    lost = np.linalg.norm(normals, axis=1) < 0.5
    normals[lost] = to_eye[lost]
    away = (normals * to_eye).sum(axis=1) < 0
    normals[away] *= -1.0
    unit: Floats = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return unit


def _legacy(cloud: Cloud, origin: Floats) -> Any:
    return _geometry.PointCloud(_utility.Vector3dVector(cloud.points - origin))
