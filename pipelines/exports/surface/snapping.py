"""Points of views, each with the noise of its own view, laid on the surface that all views made.

A surface is fused from all views, moved onto the photos and flattened where it is plane; the depth
of one view is none of that. So a point near the surface goes onto it along its own ray, where its
colour was seen, and has the normal there; at outlines, where rays pass the surface by, it goes to
the nearest place. Where there is no surface, points stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.surface.cloud import Cloud
from pipelines.exports.surface.surface_file import KeptSurface

Floats = NDArray[np.float64]

_REACH_VOXELS = 2.0
"""So far a point may be from the surface: a view's noise is less than a voxel."""
_MOST_ALONG_VOXELS = 6.0
"""And so far along its ray, which meets the surface at a glance."""
_GLANCE = 0.1
"""Least cosine of ray and normal: at less, a ray meets the surface anywhere."""
_FACING = -0.4
"""The same for the nearest place, where noise makes it negative at an outline."""
_ASIDE = 0.7
"""Least cosine of that move and the normal: beyond a border the nearest place lies aside."""
_HARDLY_VOXELS = 0.1
"""A move as short as that has no direction worth asking."""
_PORTION = 250_000

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


@dataclass(frozen=True)
class _Places:
    """On the surface, one for each of P points. moves: [P, 3], to there. normals: [P, 3], unit.
    voxel: [P], world units. fine: [P], whether the point may go there.
    """

    moves: Floats
    normals: Floats
    voxel: NDArray[np.float32]
    fine: NDArray[np.bool_]


def snapped(
    cloud: Cloud, surface: KeptSurface, on_progress: Callable[[float], None] = lambda done: None
) -> Cloud:
    """The cloud with those of its points on the surface that lie near it, and their normals.

    A point stays where the surface ends beside it, and where its camera sees the surface from
    behind, as then it is the other side of something thin. on_progress: told the share that is
    done; may raise.
    """
    points, normals = cloud.points.copy(), cloud.normals.copy()
    caster = _Caster(surface)
    for begin in range(0, len(cloud), _PORTION):
        on_progress(begin / len(cloud))
        some = slice(begin, begin + _PORTION)
        local = cloud.points[some] - surface.origin
        eyes = cloud.eyes[some] - surface.origin
        nearest = caster.nearest(local, eyes)
        for places in (nearest, caster.along_rays(local, eyes, nearest.voxel)):
            points[some][places.fine] = (cloud.points[some] + places.moves)[places.fine]
            normals[some][places.fine] = places.normals[places.fine]
    return replace(cloud, points=points, normals=normals)


class _Caster:
    """The surface, to be asked for places near points. All from its origin."""

    def __init__(self, surface: KeptSurface) -> None:
        self._surface = surface
        self._normals = _vertex_normals(surface)
        self._scene = _tensor_geometry.RaycastingScene()
        self._scene.add_triangles(
            _core.Tensor(surface.vertices), _core.Tensor(surface.faces.astype(np.uint32))
        )

    def along_rays(self, points: Floats, eyes: Floats, voxel: NDArray[np.float32]) -> _Places:
        """Where rays from eyes [P, 3] through points [P, 3] meet the surface. voxel: [P], there."""
        ways = points - eyes
        distance = np.linalg.norm(ways, axis=1)
        ways /= np.maximum(distance, 1e-300)[:, None]
        # Asked from shortly before the point: what stands before that is something else.
        before = np.minimum(_MOST_ALONG_VOXELS * voxel, distance)
        starts = points - before[:, None] * ways
        rays = np.concatenate([starts, ways], axis=1).astype(np.float32)
        found = self._scene.cast_rays(_core.Tensor(rays))
        along = found["t_hit"].numpy() - before
        hit = np.isfinite(along)
        along = np.where(hit, along, 0.0)
        face = np.where(hit, found["primitive_ids"].numpy(), 0)
        normals, _ = self._at(face, found["primitive_uvs"].numpy())
        cosine = -(normals * ways).sum(axis=1)
        far = np.abs(along)
        fine = hit & (cosine > _GLANCE) & (far <= _MOST_ALONG_VOXELS * voxel)
        fine &= far * cosine <= _REACH_VOXELS * voxel
        return _Places(along[:, None] * ways, normals, voxel, fine)

    def nearest(self, points: Floats, eyes: Floats) -> _Places:
        """The places nearest to points [P, 3] that eyes [P, 3] saw."""
        local = points.astype(np.float32)
        found = self._scene.compute_closest_points(_core.Tensor(local))
        normals, voxel = self._at(found["primitive_ids"].numpy(), found["primitive_uvs"].numpy())
        moves = (found["points"].numpy() - local).astype(np.float64)
        far = np.linalg.norm(moves, axis=1)
        to_eye = eyes - points
        facing = (to_eye * normals).sum(axis=1) > _FACING * np.linalg.norm(to_eye, axis=1)
        aside = np.abs((moves * normals).sum(axis=1)) < _ASIDE * far
        fine = facing & (far <= _REACH_VOXELS * voxel)
        fine &= ~aside | (far <= _HARDLY_VOXELS * voxel)
        return _Places(moves, normals, voxel, fine)

    def _at(
        self, face: NDArray[np.integer[Any]], uv: NDArray[np.float32]
    ) -> tuple[Floats, NDArray[np.float32]]:
        """Normals [P, 3] and voxels [P] at places in faces [P]."""
        corners = self._surface.faces[face.astype(np.int64)]
        u, v = uv.T
        shares = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float64)
        normals = np.einsum("pc,pcd->pd", shares, self._normals[corners])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return normals, self._surface.voxel[corners[:, 0]]


def _vertex_normals(surface: KeptSurface) -> Floats:
    """The mean normal of each vertex's faces by area, [V, 3], unit or zero."""
    corners = surface.vertices.astype(np.float64)[surface.faces]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    flat = surface.faces.ravel()
    total = np.stack(
        [
            np.bincount(flat, np.repeat(crossed[:, axis], 3), len(surface.vertices))
            for axis in range(3)
        ],
        axis=1,
    )
    normals: Floats = total / np.maximum(np.linalg.norm(total, axis=1, keepdims=True), 1e-300)
    return normals
