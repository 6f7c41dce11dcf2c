"""A scene in shells: finest around what was filmed, coarser beyond, up to where cameras saw.

One shell is the scene's bounds at `max_distance`, with voxels of the asked resolution. Within it is
one for the subject, if half of what cameras see is that, with voxels half as large: of what lies
within two camera distances, the thing that is walked round is a tenth. Each further one reaches
three times as far and has voxels three times as large, so that from the cameras all look alike.
The cameras' distance is that to what they look at, or, of a walk, twice the depth that they see.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.surface.clean import clean
from pipelines.exports.surface.isosurface import LEVEL, Density, extract
from pipelines.exports.surface.poisson import reconstruct
from pipelines.exports.surface.tsdf import Blocks, affordable_blocks, fuse
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.depth_views import DepthView, ViewStore

Method = Literal["tsdf", "poisson", "marching_cubes"]
REACH = 3.0
_MIN_GROWTH = 1.2
"""What is hardly larger than the shell in it shows nothing new and is left out."""
_FINER = 2.0
_LEAST_FINER = 1.3
"""A subject whose voxels would be hardly smaller than those around it needs no shell."""
_LEAST_SEEN = 0.5
"""Of what cameras see, for a subject. Of things that are walked round 0.54 to 0.97 is; 0.25 of a
room, whose walls got holes and bumps from finer voxels."""
_WALK = 0.5
"""Of the cameras' distance to what they look at: where they see less far in the median, they went
along a way, whose length says nothing of how fine things are."""
_NOISE_VOXELS, _NOISE = 2.0, 0.02
"""A view shows a place that its depth is that near to, in voxels or of the depth."""
_OUTER_FACES = 0.25
_FUSE_SHARE = 0.75


@dataclass(frozen=True)
class Shell:
    """bounds: with all that inner shells have. voxel: world units. is_far: whether it lies beyond
    `max_distance`. blocks: where they are known. looked_from: the cameras' distance to what they
    see, world units, that of the bounds where it is not told; less on a walk.
    """

    bounds: SceneBounds
    voxel: float
    is_far: bool = False
    blocks: Blocks | None = None
    looked_from: float | None = None

    @property
    def distance(self) -> float:
        """From where it was looked at, world units."""
        return self.bounds.distance if self.looked_from is None else self.looked_from


@dataclass(frozen=True)
class Subject:
    """What may have finer voxels. max_distance: in camera distances. pixel: what one of the fused
    views covers at distance 1: no voxel is smaller than that at its shell's rim. views: some of
    them, small ones will do.
    """

    max_distance: float
    pixel: float
    views: Sequence[DepthView]


def find_shells(
    bounds_at: Callable[[float], SceneBounds | None],
    max_distance: float,
    far_distance: float,
    resolution: int,
    subject: Subject | None = None,
) -> list[Shell]:
    """The shells, innermost first; none where there is no surface.

    bounds_at: the bounds that reach so many camera distances. resolution: voxels along the longest
    side of the one at `max_distance`. subject: what may have voxels half as large.
    """
    inner = bounds_at(max_distance)
    if inner is None:
        return []
    voxel, reach = inner.usual_side / resolution, max_distance
    distance = inner.distance
    if subject is not None:
        # Who walks through a place is near what is seen, however far it goes.
        distance = min(distance, _usual_depth(subject.views, inner) / _WALK)
        voxel *= distance / inner.distance
        # Finer ones would hold what one view alone shows, and two have to agree.
        voxel = max(voxel, subject.pixel * distance * max_distance)
    shells = [Shell(inner, voxel, looked_from=distance)]
    if subject is not None and 0.0 < subject.max_distance < max_distance:
        bounds = bounds_at(subject.max_distance)
        fine = max(voxel / _FINER, subject.pixel * distance)
        if (
            bounds
            and _LEAST_FINER * fine <= voxel
            and seen_share(subject.views, bounds) >= _LEAST_SEEN
        ):
            shells.insert(0, Shell(bounds, fine, looked_from=distance))
    while reach < far_distance:
        reach = min(REACH * reach, far_distance)
        bounds = bounds_at(reach)
        if bounds and bounds.longest_side >= _MIN_GROWTH * shells[-1].bounds.longest_side:
            coarse = voxel * reach / max_distance
            shells.append(Shell(bounds, coarse, is_far=True, looked_from=distance))
    return shells


def _usual_depth(views: Sequence[DepthView], bounds: SceneBounds) -> float:
    """The median depth of what views see within bounds."""
    depths = [view.z_depth[bounds.mask(view)] for view in views]
    known = np.concatenate([np.zeros(0, np.float32), *depths])
    return float(np.median(known)) if len(known) else bounds.distance


def seen_share(views: Sequence[DepthView], bounds: SceneBounds) -> float:
    """How much of the surfaces that views see lies within bounds, [0, 1]."""
    seen = sum(int((view.z_depth > 0.0).sum()) for view in views)
    within = sum(int(bounds.mask(view).sum()) for view in views)
    return within / max(seen, 1)


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
    density: Density | None = None,
    level: float = LEVEL,
) -> TriangleMesh:
    """All shells fused and cleaned, as one mesh; may be without vertices.

    max_faces: of each shell up to `max_distance`; those beyond have at most a quarter of it.
    on_progress: told the share that is done; may raise. method: how a shell's surface is made of
    the views. density, level: the field of `marching_cubes`, and where its surface is
    (`isosurface.extract`).
    """
    pieces = []
    for index, shell in enumerate(shells):

        def on_fused(done: float, before: int = index) -> None:
            on_progress((before + _FUSE_SHARE * done) / len(shells))

        def on_cleaned(done: float, before: int = index) -> None:
            on_progress((before + _FUSE_SHARE + (1.0 - _FUSE_SHARE) * done) / len(shells))

        if method == "poisson":
            fused = reconstruct(views, shell.bounds, shell.voxel, on_fused)
        elif method == "marching_cubes":
            if density is None:
                raise ValueError("marching_cubes is done on a density field")
            fused = extract(
                density, views, shell.bounds, shell.voxel, on_fused, shell.blocks, level
            )
        else:
            fused = fuse(views, shell.bounds, shell.voxel, on_fused, shell.blocks)
        if index:
            fused = _outside(fused, shells[index - 1].bounds, shell.voxel)
        faces = max(100, int(_OUTER_FACES * max_faces)) if shell.is_far else max_faces
        looks_at = functools.partial(_looks_at, views, voxel=shell.voxel)
        pieces.append(clean(fused, shell.bounds, faces, on_cleaned, looks_at))
        on_cleaned(1.0)
    return joined([piece for piece in pieces if len(piece.faces)])


def _looks_at(
    views: Iterable[DepthView], points: NDArray[np.floating], *, voxel: float
) -> NDArray[np.float64]:
    """[P, 2], how many views show points [P, 3], and how many look through them."""
    there, through = np.zeros(len(points)), np.zeros(len(points))
    for view in views:
        depth, shown = view.seen_at(points)
        margin = np.maximum(_NOISE_VOXELS * voxel, _NOISE * depth)
        through += shown > depth + margin
        there += (shown > 0.0) & (np.abs(shown - depth) <= margin)
    return np.stack([there, through], axis=1)


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
