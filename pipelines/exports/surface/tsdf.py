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

from collections.abc import Callable, Iterator
from typing import Any, Protocol

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh, empty_mesh, ordered
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.float64]
Blocks = NDArray[np.int32]
"""[B, 3], coordinates of blocks of voxels."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry

_BLOCK = 8
_NOTHING_TOUCHED = "No block is touched"
_TRUNCATION_VOXELS = 5.0
_MIN_VIEWS = 2
"""A surface that one view alone shows is not believed."""
MOST_BLOCKS = 80_000
"""Blocks of voxels for which there is room, each with about 30 KB until the mesh is done."""
_MANY, _COARSER = 4, 1.05
_FIND_SHARE, _EXTRACT_SHARE, _ORDER_SHARE = 0.25, 0.9, 0.95


class Sized(Protocol):
    """Depth views that can be counted and iterated more than once: a list, a store on disk."""

    def __len__(self) -> int: ...

    def __iter__(self) -> Iterator[DepthView]: ...


def affordable_blocks(
    views: Sized,
    bounds: SceneBounds,
    voxel: float,
    on_progress: Callable[[float], None] = lambda done: None,
) -> tuple[float, Blocks | None]:
    """The voxel's side, or a larger one with which no more than `MOST_BLOCKS` are fused, and those.

    Where the whole box has no more, no view is looked at, and the blocks are None. on_progress: as
    of `fuse`.
    """
    origin, left = (bounds.box_min + bounds.box_max) / 2.0, 1.0
    while _blocks_of_box(bounds, voxel) > MOST_BLOCKS:

        def on_share(done: float, before: float = left) -> None:
            on_progress(1.0 - before + 0.5 * before * done)

        most, grid = _MANY * MOST_BLOCKS, voxel_grid(voxel, 1)
        blocks = _blocks_near_surface(grid, views, bounds, origin, on_share, most)
        if len(blocks) <= MOST_BLOCKS:
            return voxel, blocks
        # Surfaces have as many blocks as the square of what the voxels are finer.
        voxel *= max(_COARSER, float(np.sqrt(len(blocks) / MOST_BLOCKS)))
        left *= 0.5
    return voxel, None


def _blocks_of_box(bounds: SceneBounds, voxel: float) -> float:
    """As many blocks as the box could touch, with those that reach into it from outside."""
    sides = (
        (bounds.box_max - bounds.box_min) / (voxel * _BLOCK)
        + 2.0
        + 2.0 * _TRUNCATION_VOXELS / _BLOCK
    )
    return float(np.prod(np.ceil(sides)))


def voxel_grid(voxel: float, num_blocks: int) -> Any:
    """Open3D's grid with room for so many blocks; it takes a larger copy where it needs more."""
    return _tensor_geometry.VoxelBlockGrid(
        attr_names=("tsdf", "weight", "color"),
        attr_dtypes=(_core.float32, _core.float32, _core.float32),
        attr_channels=((1), (1), (3)),
        voxel_size=voxel,
        block_resolution=_BLOCK,
        block_count=num_blocks,
        device=_core.Device("CPU:0"),
    )


def fuse(
    views: Sized,
    bounds: SceneBounds,
    voxel: float,
    on_progress: Callable[[float], None] = lambda done: None,
    blocks: Blocks | None = None,
) -> TriangleMesh:
    """Fuse depth views into a mesh.

    views: are iterated twice. bounds: where surface is wanted. voxel: side of a voxel, world units.
    on_progress: told the share that is done; may raise. blocks: where `affordable_blocks` found
    them for that voxel.
    Returns a mesh without vertices where the views show no surface inside the bounds.
    """
    origin = (bounds.box_min + bounds.box_max) / 2.0

    def on_found(done: float) -> None:
        on_progress(_FIND_SHARE * done)

    if blocks is None:
        blocks = touched_blocks(views, bounds, voxel, on_found)
    if len(blocks) == 0:
        return empty_mesh()
    grid = voxel_grid(voxel, len(blocks))
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
        on_progress(_FIND_SHARE + (_EXTRACT_SHARE - _FIND_SHARE) * done / len(views))
    # Open3D keeps voxels whose weight, the number of views, is above its threshold.
    nowhere = np.zeros(3)
    made = from_open3d(grid.extract_triangle_mesh(_MIN_VIEWS - 0.5).to_legacy(), nowhere)
    del grid, keys  # the field is larger than all that follows
    on_progress(_ORDER_SHARE)
    # Its threads number vertices and faces as they come to them, another way in each run.
    made = ordered(made, lambda done: on_progress(_ORDER_SHARE + (1.0 - _ORDER_SHARE) * done))
    return from_open3d(to_open3d(made, nowhere), origin)


def _farthest(view: DepthView) -> float:
    """A depth behind every pixel of the view."""
    return float(view.z_depth.max()) * 1.01 + 1e-6


def touched_blocks(
    views: Sized,
    bounds: SceneBounds,
    voxel: float,
    on_progress: Callable[[float], None] = lambda done: None,
) -> Blocks:
    """All blocks near any view's surface inside the bounds. on_progress: as of `fuse`."""
    origin = (bounds.box_min + bounds.box_max) / 2.0
    return _blocks_near_surface(voxel_grid(voxel, 1), views, bounds, origin, on_progress)


def _blocks_near_surface(
    grid: Any,
    views: Sized,
    bounds: SceneBounds,
    origin: Floats,
    on_progress: Callable[[float], None] = lambda done: None,
    at_most: float = np.inf,
) -> Blocks:
    """Coordinates [B, 3] of the blocks that any view's surface inside the bounds touches.

    at_most: where there are more the rest is not looked for.
    """
    found: set[tuple[int, int, int]] = set()
    for done, view in enumerate(views):
        on_progress(done / len(views))
        if len(found) > at_most:
            break
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
