"""Depth views fused into a triangle mesh, through a sparse truncated signed distance field.

Two passes over the views: the first finds the blocks of voxels near any surface inside the bounds,
the second lets **every** view speak on every block, so that a ghost seen by one view is carved away
by those that look through it. Each voxel keeps the true mean over the views (Curless and Levoy
1996). The field lives in a frame whose origin is the middle of the bounds, which keeps float32
exact also for captures with large coordinates; the mesh comes back in the world frame.

open3d 0.20: `t.geometry.VoxelBlockGrid`; colour must be float32; pixel (u, v) is looked up by
truncation, which is our pixel centre at +0.5.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.depth_views import DepthView
from pipelines.scene_bounds import SceneBounds

Floats = NDArray[np.float64]

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_geometry: Any = open3d.geometry
_tensor_geometry: Any = open3d.t.geometry
_utility: Any = open3d.utility

_BLOCK = 8
_NOTHING_TOUCHED = "No block is touched"
_TRUNCATION_VOXELS = 5.0
_MIN_VIEWS = 2.0
_MIN_COMPONENT_SHARE = 0.02


@dataclass(frozen=True)
class TriangleMesh:
    """vertices: [V, 3] world. faces: [F, 3] int32, counter-clockwise from outside.

    colors: [V, 3] in [0, 1], sRGB. normals: [V, 3], unit.
    """

    vertices: Floats
    faces: NDArray[np.int32]
    colors: Floats
    normals: Floats


def fuse(
    views: Iterable[DepthView],
    bounds: SceneBounds,
    resolution: int,
    on_view: Callable[[int], None] = lambda done: None,
) -> TriangleMesh:
    """Fuse depth views into a mesh.

    views: can be iterated more than once. bounds: where surface is wanted. resolution: voxels along
    the longest side of the bounds. on_view: told the number of views fused so far; may raise.
    Returns a mesh without vertices where the views show no surface inside the bounds.
    """
    origin = (bounds.box_min + bounds.box_max) / 2.0
    voxel = bounds.longest_side / resolution
    grid = _tensor_geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(_core.float32, _core.float32, _core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel,
        block_resolution=_BLOCK,
        block_count=10_000,
        device=_core.Device("CPU:0"),
    )
    blocks = _blocks_near_surface(grid, views, bounds, origin)
    if len(blocks) == 0:
        return _empty()
    keys = _core.Tensor(blocks)
    for done, view in enumerate(views, start=1):
        depth = np.where(view.smooth_mask(), view.z_depth, 0.0).astype(np.float32)
        color = np.ascontiguousarray(view.rgb, dtype=np.float32) / np.float32(255.0)
        lens = _core.Tensor(view.lens.matrix())
        grid.integrate(
            keys,
            _tensor_geometry.Image(_core.Tensor(depth[..., None])),
            _tensor_geometry.Image(_core.Tensor(color)),
            lens,
            lens,
            _core.Tensor(view.camera_from_world_cv(origin)),
            1.0,
            _farthest(view),
            _TRUNCATION_VOXELS,
        )
        on_view(done)
    extracted = grid.extract_triangle_mesh(_MIN_VIEWS).to_legacy()
    return _to_world(extracted, origin)


def _farthest(view: DepthView) -> float:
    """A depth behind every pixel of the view."""
    return float(view.z_depth.max()) * 1.01 + 1e-6


def _blocks_near_surface(
    grid: Any, views: Iterable[DepthView], bounds: SceneBounds, origin: Floats
) -> NDArray[np.int32]:
    """Coordinates [B, 3] of the blocks that any view's surface inside the bounds touches."""
    found: set[tuple[int, int, int]] = set()
    for view in views:
        wanted = view.smooth_mask() & bounds.contains(view.points())
        if not wanted.any():
            continue
        depth = np.where(wanted, view.z_depth, 0.0).astype(np.float32)
        try:
            keys = grid.compute_unique_block_coordinates(
                _tensor_geometry.Image(_core.Tensor(depth[..., None])),
                _core.Tensor(view.lens.matrix()),
                _core.Tensor(view.camera_from_world_cv(origin)),
                1.0,
                _farthest(view),
                _TRUNCATION_VOXELS,
            )
        except RuntimeError as error:
            # Open3D looks at every fourth pixel, and calls it an error when none of them counts.
            if _NOTHING_TOUCHED not in str(error):
                raise
            continue
        found.update(map(tuple, keys.numpy().tolist()))
    return np.asarray(sorted(found), dtype=np.int32).reshape(-1, 3)


def clean(mesh: TriangleMesh, bounds: SceneBounds, max_faces: int) -> TriangleMesh:
    """Drop what lies outside the bounds and small loose pieces, then simplify.

    Pieces with less than 2 % of the largest one's area go. Simplification is quadric decimation to
    at most `max_faces`. May return a mesh without vertices.
    """
    inside = bounds.contains(mesh.vertices)
    faces = mesh.faces[inside[mesh.faces].all(axis=1)]
    if len(faces) == 0:
        return _empty()
    origin = (bounds.box_min + bounds.box_max) / 2.0
    legacy = _geometry.TriangleMesh(
        _utility.Vector3dVector(mesh.vertices - origin),
        _utility.Vector3iVector(faces),
    )
    legacy.vertex_colors = _utility.Vector3dVector(mesh.colors)
    labels, _, piece_areas = legacy.cluster_connected_triangles()
    areas = np.asarray(piece_areas)
    small = areas < _MIN_COMPONENT_SHARE * areas.max()
    legacy.remove_triangles_by_mask(small[np.asarray(labels)])
    legacy.remove_unreferenced_vertices()
    if len(legacy.triangles) > max_faces:
        legacy = legacy.simplify_quadric_decimation(max_faces)
    legacy.remove_degenerate_triangles()
    legacy.remove_unreferenced_vertices()
    return _to_world(legacy, origin)


def _empty() -> TriangleMesh:
    none = np.zeros((0, 3))
    return TriangleMesh(none, np.zeros((0, 3), np.int32), none, none)


def _to_world(legacy: Any, origin: Floats) -> TriangleMesh:
    """open3d's mesh with fresh normals, moved from the field's frame to the world."""
    if len(legacy.triangles) == 0:
        return _empty()
    legacy.compute_vertex_normals()
    return TriangleMesh(
        vertices=np.asarray(legacy.vertices, np.float64) + origin,
        faces=np.asarray(legacy.triangles, np.int32),
        colors=np.clip(np.asarray(legacy.vertex_colors, np.float64), 0.0, 1.0),
        normals=np.asarray(legacy.vertex_normals, np.float64),
    )
