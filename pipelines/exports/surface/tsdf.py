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
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh, empty_mesh, ordered
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.float64]

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry

_BLOCK = 8
_NOTHING_TOUCHED = "No block is touched"
_TRUNCATION_VOXELS = 5.0
_MIN_VIEWS = 2
"""A surface that one view alone shows is not believed."""


def fuse(
    views: Iterable[DepthView],
    bounds: SceneBounds,
    voxel: float,
    on_view: Callable[[int], None] = lambda done: None,
) -> TriangleMesh:
    """Fuse depth views into a mesh.

    views: can be iterated more than once. bounds: where surface is wanted. voxel: side of a voxel,
    world units. on_view: told the number of views fused so far; may raise.
    Returns a mesh without vertices where the views show no surface inside the bounds.
    """
    origin = (bounds.box_min + bounds.box_max) / 2.0
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
        return empty_mesh()
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
    # Open3D keeps voxels whose weight, the number of views, is above its threshold.
    extracted = grid.extract_triangle_mesh(_MIN_VIEWS - 0.5).to_legacy()
    # Its threads number vertices and faces as they come to them, another way in each run.
    nowhere = np.zeros(3)
    return from_open3d(to_open3d(ordered(from_open3d(extracted, nowhere)), nowhere), origin)


def _farthest(view: DepthView) -> float:
    """A depth behind every pixel of the view."""
    return float(view.z_depth.max()) * 1.01 + 1e-6


def _blocks_near_surface(
    grid: Any, views: Iterable[DepthView], bounds: SceneBounds, origin: Floats
) -> NDArray[np.int32]:
    """Coordinates [B, 3] of the blocks that any view's surface inside the bounds touches."""
    found: set[tuple[int, int, int]] = set()
    for view in views:
        wanted = bounds.mask(view)
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
