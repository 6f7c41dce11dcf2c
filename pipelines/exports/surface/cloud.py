"""Depth views as a cloud of points: gathered, rid of outliers, given normals.

P points, in the world frame. Whether views agree on a point is left to `scene.consistency`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.float64]

_geometry: Any = open3d.geometry
_utility: Any = open3d.utility

_NEIGHBOURS = 20
_OUTLIER_SIGMAS = 2.0
_FEWEST_NEIGHBOURS = 3
"""A point with fewer, itself among them, has no plane."""
_PORTION = 50_000


@dataclass(frozen=True)
class Cloud:
    """points: [P, 3] world. colors: [P, 3] uint8. eyes: [P, 3], who saw each point. normals:
    [P, 3], unit, or zero where they are not known yet.
    """

    points: Floats
    colors: NDArray[np.uint8]
    eyes: Floats
    normals: Floats

    @classmethod
    def seen(cls, points: Floats, colors: NDArray[np.uint8], eyes: Floats) -> Cloud:
        """A cloud whose normals are not known yet."""
        return cls(points, colors, eyes, np.zeros_like(points))

    def __len__(self) -> int:
        return len(self.points)

    def take(self, which: NDArray[Any]) -> Cloud:
        """The points that a mask or index array picks."""
        return Cloud(*(getattr(self, field.name)[which] for field in fields(self)))


def gather(views: Iterable[DepthView], bounds: SceneBounds) -> Cloud:
    """The points of all views that lie in the scene and not on a jump in depth."""
    clouds = [Cloud.seen(np.zeros((0, 3)), np.zeros((0, 3), np.uint8), np.zeros((0, 3)))]
    for view in views:
        mask = bounds.mask(view)
        points = view.points()[mask]
        eyes = np.broadcast_to(view.world_from_camera[:, 3], points.shape)
        clouds.append(Cloud.seen(points, view.rgb[mask], eyes))
    return joined(clouds)


def joined(clouds: Sequence[Cloud]) -> Cloud:
    """Clouds as one."""
    return Cloud(
        *(
            np.concatenate([getattr(cloud, field.name) for cloud in clouds])
            for field in fields(Cloud)
        )
    )


def without_outliers(cloud: Cloud, origin: Floats) -> Cloud:
    """The points whose neighbours are not unusually far; `origin` [3]: a point near the cloud."""
    if len(cloud) <= _NEIGHBOURS:
        return cloud
    _, kept = _legacy(cloud, origin).remove_statistical_outlier(_NEIGHBOURS, _OUTLIER_SIGMAS)
    return cloud.take(np.asarray(kept, np.int64))


def with_normals(
    cloud: Cloud,
    neighbours: int = _NEIGHBOURS,
    on_progress: Callable[[float], None] = lambda done: None,
) -> Cloud:
    """The cloud with normals for all of its points: those that it has none for yet get that of
    their neighbours, turned to the camera that saw the point.

    neighbours: so many, the point among them; more are smoother, on edges too. on_progress: told
    the share that is done; may raise.
    """
    normals = cloud.normals.copy()
    wanted = np.flatnonzero(~normals.any(axis=1))
    count = min(neighbours, len(cloud))
    tree = cKDTree(cloud.points)
    for begin in range(0, len(wanted), _PORTION):
        on_progress(begin / len(wanted))
        some = wanted[begin : begin + _PORTION]
        to_eye = cloud.eyes[some] - cloud.points[some]
        if count < _FEWEST_NEIGHBOURS:  # then the view direction is the best that is known
            normals[some] = to_eye / np.linalg.norm(to_eye, axis=1, keepdims=True)
            continue
        _, near = tree.query(cloud.points[some], count, workers=-1)
        around = cloud.points[near]
        around -= around.mean(axis=1, keepdims=True)
        spread = np.matmul(around.transpose(0, 2, 1), around)
        found = np.linalg.eigh(spread)[1][:, :, 0]
        found[(found * to_eye).sum(axis=1) < 0.0] *= -1.0
        normals[some] = found
    return replace(cloud, normals=normals)


def _legacy(cloud: Cloud, origin: Floats) -> Any:
    return _geometry.PointCloud(_utility.Vector3dVector(cloud.points - origin))
