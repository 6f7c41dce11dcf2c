"""A scene in shells: fine around what was filmed, coarser beyond, up to where cameras saw.

The innermost shell is the scene's bounds at `max_distance`. Each further one reaches three times as
far and has voxels three times as large, so that from the cameras all of them look alike.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.surface.clean import clean
from pipelines.exports.surface.poisson import reconstruct
from pipelines.exports.surface.tsdf import Blocks, affordable_blocks, fuse
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import ViewStore

Method = Literal["tsdf", "poisson"]
REACH = 3.0
_MIN_GROWTH = 1.2
"""What is hardly larger than the shell in it shows nothing new and is left out."""
_OUTER_FACES = 0.25
_FUSE_SHARE = 0.75


@dataclass(frozen=True)
class Shell:
    """bounds: with all that inner shells have. voxel: world units. blocks: where they are known."""

    bounds: SceneBounds
    voxel: float
    blocks: Blocks | None = None


def find_shells(
    bounds_at: Callable[[float], SceneBounds | None],
    max_distance: float,
    far_distance: float,
    resolution: int,
) -> list[Shell]:
    """The shells, innermost first; none where there is no surface.

    bounds_at: the bounds that reach so many camera distances. resolution: voxels along the longest
    side of the innermost one.
    """
    inner = bounds_at(max_distance)
    if inner is None:
        return []
    voxel, reach = inner.longest_side / resolution, max_distance
    shells = [Shell(inner, voxel)]
    while reach < far_distance:
        reach = min(REACH * reach, far_distance)
        bounds = bounds_at(reach)
        if bounds and bounds.longest_side >= _MIN_GROWTH * shells[-1].bounds.longest_side:
            shells.append(Shell(bounds, voxel * reach / max_distance))
    return shells


def affordable(
    views: ViewStore,
    shells: Sequence[Shell],
    on_progress: Callable[[float], None] = lambda fraction: None,
) -> list[Shell]:
    """The shells with voxels that memory has room for (`tsdf.affordable_blocks`).

    on_progress: told the share that is done; may raise.
    """
    made = []
    for index, shell in enumerate(shells):

        def on_share(done: float, before: int = index) -> None:
            on_progress((before + done) / len(shells))

        voxel, blocks = affordable_blocks(views, shell.bounds, shell.voxel, on_share)
        made.append(replace(shell, voxel=voxel, blocks=blocks))
        on_share(1.0)
    return made


def fuse_shells(
    views: ViewStore,
    shells: Sequence[Shell],
    max_faces: int,
    on_progress: Callable[[float], None] = lambda fraction: None,
    method: Method = "tsdf",
) -> TriangleMesh:
    """All shells fused and cleaned, as one mesh; may be without vertices.

    max_faces: of the innermost shell; each other one has at most a quarter of it. on_progress: told
    the share that is done; may raise. method: how a shell's surface is made of the views.
    """
    pieces = []
    for index, shell in enumerate(shells):

        def on_fused(done: float, before: int = index) -> None:
            on_progress((before + _FUSE_SHARE * done) / len(shells))

        def on_cleaned(done: float, before: int = index) -> None:
            on_progress((before + _FUSE_SHARE + (1.0 - _FUSE_SHARE) * done) / len(shells))

        if method == "poisson":
            fused = reconstruct(views, shell.bounds, shell.voxel, on_fused)
        else:
            fused = fuse(views, shell.bounds, shell.voxel, on_fused, shell.blocks)
        if index:
            fused = _outside(fused, shells[index - 1].bounds, shell.voxel)
        faces = max_faces if index == 0 else max(100, int(_OUTER_FACES * max_faces))
        pieces.append(clean(fused, shell.bounds, faces, on_cleaned))
        on_cleaned(1.0)
    return joined([piece for piece in pieces if len(piece.faces)])


def _outside(mesh: TriangleMesh, inner: SceneBounds, overlap: float) -> TriangleMesh:
    """The faces that are not within the inner bounds, less a rim of one voxel."""
    smaller = replace(
        inner,
        radius=inner.radius - overlap,
        box_min=inner.box_min + overlap,
        box_max=inner.box_max - overlap,
    )
    if len(mesh.faces) == 0:
        return mesh
    hidden = smaller.contains(mesh.vertices)[mesh.faces].all(axis=1)
    return replace(mesh, faces=mesh.faces[~hidden])
