"""Levels of detail: the same mesh again, each time with a quarter of the triangles.

A viewer shows a coarse level while the fine one is still on its way, or where the thing is small.
Each level is reduced from the one before it and painted on its own, with half the texture's side:
as many texels per triangle as the one before has.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.mesh_options import LEAST_TRIANGLES
from pipelines.exports.reduction import reduced

SHARE = 4
LEAST_TEXTURE_PX = 512


def levels_of(
    mesh: TriangleMesh,
    count: int,
    on_progress: Callable[[float], None] = lambda done: None,
) -> Iterator[TriangleMesh]:
    """The levels below a mesh, the finest first; a level never has fewer than a few triangles.

    on_progress: as of `reduced`, for each level.
    """
    for _ in range(count):
        mesh = reduced(mesh, max(LEAST_TRIANGLES, len(mesh.faces) // SHARE), on_progress)
        yield mesh


def texture_px_of(level: int, full_px: int) -> int:
    """The largest side of the texture of level 1, 2, ..., a power of two as the full one's is."""
    return max(LEAST_TEXTURE_PX, full_px >> level)
