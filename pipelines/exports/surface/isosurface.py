"""The surface of a trained density field: where a voxel's length takes away a share of the light.

The field is asked at voxels near what the views see, in blocks, so that memory is bounded and what
no camera looks at is left out; marching cubes (Lorensen and Cline 1987) puts vertices where the
share of light that is taken away passes the level, linearly between voxels. Dense places are thin
sheets with a front and a back, so that only what at least two views see from its front is kept,
which has the mean of their colours. All happens in a frame whose origin is the middle of the
bounds, which keeps float32 exact.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.mesh import Floats, TriangleMesh, empty_mesh, ordered
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.exports.surface.tsdf import Blocks, Sized, touched_blocks, voxel_grid
from pipelines.exports.surface.view_colors import seen_colors
from pipelines.scene.bounds import SceneBounds

Density = Callable[[Floats], NDArray[np.floating[Any]]]
"""From points [N, 3], world, to density [N] per world unit."""

LEVEL = 0.25
_MIN_VIEWS = 2
"""A surface that one view alone shows is not believed."""
_BESIDE_VOXELS = 3.0
"""How far the surface may lie from a view's depth, along its axis, to be what that view sees."""
_TOGETHER = 512
"""Blocks asked at a time: 262,144 points."""
_FIND_SHARE, _ASK_SHARE, _EXTRACT_SHARE = 0.1, 0.8, 0.85

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core


def extract(
    density: Density,
    views: Sized,
    bounds: SceneBounds,
    voxel: float,
    on_progress: Callable[[float], None] = lambda done: None,
    blocks: Blocks | None = None,
    level: float = LEVEL,
) -> TriangleMesh:
    """The surface within the bounds that views see.

    views: are iterated twice. voxel: side of a voxel, world units. on_progress: told the share that
    is done; may raise. blocks: where `tsdf.affordable_blocks` found them for that voxel. level: of
    the light that goes through a voxel's length, the share that is taken away at the surface.
    Returns a mesh without vertices where there is none.
    """
    origin = (bounds.box_min + bounds.box_max) / 2.0
    if blocks is None:
        blocks = touched_blocks(views, bounds, voxel, lambda done: on_progress(_FIND_SHARE * done))
    if len(blocks) == 0:
        return empty_mesh()

    def on_asked(done: float) -> None:
        on_progress(_FIND_SHARE + (_ASK_SHARE - _FIND_SHARE) * done)

    grid = _filled(density, blocks, voxel, origin, level, on_asked)
    nowhere = np.zeros(3)
    made = from_open3d(grid.extract_triangle_mesh(0.5).to_legacy(), nowhere)
    del grid
    on_progress(_EXTRACT_SHARE)
    if len(made.faces) == 0:
        return empty_mesh()
    # Its threads number vertices and faces as they come to them, another way in each run.
    made = from_open3d(to_open3d(ordered(made), nowhere), origin)
    return _seen(
        made,
        views,
        _BESIDE_VOXELS * voxel,
        lambda done: on_progress(_EXTRACT_SHARE + (1.0 - _EXTRACT_SHARE) * done),
    )


def _filled(
    density: Density,
    blocks: Blocks,
    voxel: float,
    origin: Floats,
    level: float,
    on_progress: Callable[[float], None],
) -> Any:
    """Open3D's grid with the level less the share of light that each voxel takes away."""
    grid = voxel_grid(voxel, len(blocks))
    found, _ = grid.hashmap().activate(_core.Tensor(blocks))
    values, weights = (grid.attribute(name).reshape((-1, 1)) for name in ("tsdf", "weight"))
    for begin in range(0, len(blocks), _TOGETHER):
        on_progress(begin / len(blocks))
        places, flat = grid.voxel_coordinates_and_flattened_indices(
            found[begin : begin + _TOGETHER]
        )
        thick = np.asarray(density(places.numpy().astype(np.float64) + origin), np.float64) * voxel
        signed = (level + np.expm1(-thick)).astype(np.float32)[:, None]
        values[flat] = _core.Tensor(signed)
        weights[flat] = _core.Tensor(np.ones_like(signed))
    on_progress(1.0)
    return grid


def _seen(
    mesh: TriangleMesh, views: Sized, beside: float, on_progress: Callable[[float], None]
) -> TriangleMesh:
    """The faces whose corners two views see from their front, in the mean of their colours.

    beside: how far from a view's depth a vertex may be, world units.
    """
    count, mean = seen_colors(mesh, views, beside, on_progress)
    seen = count >= _MIN_VIEWS
    faces = mesh.faces[seen[mesh.faces].all(axis=1)]
    if len(faces) == 0:
        return empty_mesh()
    return replace(mesh, colors=mean).with_faces(faces)
