"""Points of views, each with the noise of its own view, laid on the surface that all views made.

A surface is fused from all views, moved onto the photos and flattened where it is plane; the depth
of one view is none of that. So a point near the surface goes to the nearest place on it and has its
normal. Where there is no surface, points stay as they are.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.surface.cloud import Cloud
from pipelines.exports.surface.surface_file import KeptSurface

Floats = NDArray[np.float64]

_REACH_VOXELS = 2.0
"""So far a point may be from the surface: a view's noise is less than a voxel."""
_LEAST_COSINE = 0.7
"""Of the move and the normal: beyond a border of the surface the nearest place lies aside."""
_FACING = -0.4
"""Least cosine of the normal and the way to the camera: at an outline, noise makes it negative."""
_HARDLY_VOXELS = 0.1
"""A move as short as that has no direction worth asking."""
_PORTION = 250_000

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def snapped(
    cloud: Cloud, surface: KeptSurface, on_progress: Callable[[float], None] = lambda done: None
) -> Cloud:
    """The cloud with those of its points on the surface that lie near it, and their normals.

    A point stays where the surface ends beside it, and where its camera sees the surface from
    behind, as then it is the other side of something thin. on_progress: told the share that is
    done; may raise.
    """
    points, normals = cloud.points.copy(), cloud.normals.copy()
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor(surface.vertices), _core.Tensor(surface.faces.astype(np.uint32))
    )
    at_vertices = _vertex_normals(surface)
    for begin in range(0, len(cloud), _PORTION):
        on_progress(begin / len(cloud))
        some = slice(begin, begin + _PORTION)
        points[some], normals[some] = _moved(
            cloud.points[some], cloud.eyes[some], surface, scene, at_vertices
        )
    return replace(cloud, points=points, normals=normals)


def _moved(
    points: Floats, eyes: Floats, surface: KeptSurface, scene: Any, at_vertices: Floats
) -> tuple[Floats, Floats]:
    """Of some points [P, 3]: where they are in the end, and their normals or zero."""
    local = (points - surface.origin).astype(np.float32)
    found = scene.compute_closest_points(_core.Tensor(local))
    places = found["points"].numpy()
    corners = surface.faces[found["primitive_ids"].numpy().astype(np.int64)]
    u, v = found["primitive_uvs"].numpy().T
    shares = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float64)
    normals = np.einsum("pc,pcd->pd", shares, at_vertices[corners])
    length = np.linalg.norm(normals, axis=1)
    normals /= np.maximum(length, 1e-12)[:, None]
    move = (places - local).astype(np.float64)
    far, voxel = np.linalg.norm(move, axis=1), surface.voxel[corners[:, 0]]
    along = np.abs((move * normals).sum(axis=1)) >= _LEAST_COSINE * far
    to_eye = eyes - points
    facing = (to_eye * normals).sum(axis=1) > _FACING * np.linalg.norm(to_eye, axis=1)
    onto = (far <= _REACH_VOXELS * voxel) & (along | (far <= _HARDLY_VOXELS * voxel))
    onto &= facing & (length > 0.5)
    return (
        np.where(onto[:, None], surface.origin + places, points),
        np.where(onto[:, None], normals, 0.0),
    )


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
