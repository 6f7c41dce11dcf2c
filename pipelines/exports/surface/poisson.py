"""Depth views turned into a mesh by Poisson reconstruction: smooth, small holes closed.

Each cube of space with a voxel's side gets one point, the mean of what the views show in it, where
two views at least show something and the others do not look through it; a smooth surface is laid
through the points along their normals. Where it strays from them, as it does across what nobody
saw, it is cut away. It has the mean of the colours in which views see it. All happens in a frame
whose origin is the middle of the bounds.

Source: Kazhdan and Hoppe, "Screened Poisson Surface Reconstruction", 2013, as Open3D does it.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray

from pipelines.exports.apart import run_apart
from pipelines.exports.each_view import each_view
from pipelines.exports.mesh import Floats, TriangleMesh, empty_mesh, ordered
from pipelines.exports.surface import poisson_solver
from pipelines.exports.surface.cloud import Cloud, with_normals
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d
from pipelines.exports.surface.tsdf import Sized
from pipelines.exports.surface.view_colors import seen_colors
from pipelines.scene.bounds import SceneBounds
from pipelines.scene.consistency import consistent
from pipelines.scene.depth_views import DepthView

_MIN_VIEWS = 2
"""A place that one view alone shows is not believed."""
MOST_POINTS = 2_000_000
"""Points for which there is room; cubes become larger where there would be more."""
LARGE = 10_000
"""Points from which the solver gets a process of its own, whose start takes a second."""
_COARSER = 1.05
_STRAY_CUBES = 2.0
"""The surface ends so many cubes from the nearest point."""
_FEWEST = 30
_BESIDE_CUBES = 3.0
"""How far the surface may lie from a view's depth, along its axis, to be what that view sees."""
_GATHER_SHARE, _AGREE_SHARE, _ORIENTED_SHARE, _SOLVED_SHARE = 0.4, 0.5, 0.52, 0.85
_NEAR_SHARE, _ORDERED_SHARE = 0.87, 0.9
_USUAL_S = 1e-4
"""How long a point takes, for what is told while nobody knows how far the solver is."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core


@dataclass(frozen=True)
class _Sums:
    """Of C cubes, by their number: [C, 9] summed place, colour and eye; [C] how many views."""

    key: NDArray[np.int64]
    total: Floats
    num_views: NDArray[np.int64]

    def with_one_more(self, key: NDArray[np.int64], total: Floats) -> _Sums:
        """And what a view shows; a cube is at most once in it."""
        keys = np.concatenate([self.key, key])
        known, at = np.unique(keys, return_inverse=True)
        totals = np.zeros((len(known), total.shape[1]))
        totals[at[: len(self.key)]] = self.total
        totals[at[len(self.key) :]] += total
        votes = np.bincount(at[len(self.key) :], minlength=len(known))
        votes[at[: len(self.key)]] += self.num_views
        return _Sums(known, totals, votes)


def reconstruct(
    views: Sized,
    bounds: SceneBounds,
    voxel: float,
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """The surface that the views show within the bounds.

    views: are iterated more than once. voxel: side of the cubes, world units. on_progress: told the
    share that is done, every second also while the surface is sought; what it raises ends the work.
    Returns a mesh without vertices where too little is seen. Raises ToolError.
    """
    origin = (bounds.box_min + bounds.box_max) / 2.0
    cloud, side = averaged(views, bounds, voxel, lambda done: on_progress(_GATHER_SHARE * done))

    def told() -> Iterator[DepthView]:
        for done, view in enumerate(views):
            on_progress(_GATHER_SHARE + (_AGREE_SHARE - _GATHER_SHARE) * done / len(views))
            yield view

    cloud = cloud.take(consistent(cloud.points, told()))
    if len(cloud) < _FEWEST:
        return empty_mesh()
    cloud = with_normals(cloud, on_progress=lambda done: on_progress(_AGREE_SHARE))
    points: Floats = cloud.points - origin
    on_progress(_ORIENTED_SHARE)
    given = {
        "points": points,
        "normals": cloud.normals,
        "colors": cloud.colors.astype(np.float64) / 255.0,
        "width": np.float64(side),
    }
    if len(cloud) < LARGE:
        solved = poisson_solver.solved(given)
    else:
        solved = run_apart(
            poisson_solver.__file__,
            given,
            _USUAL_S * len(cloud),
            lambda done: on_progress(_ORIENTED_SHARE + (_SOLVED_SHARE - _ORIENTED_SHARE) * done),
        )
    on_progress(_SOLVED_SHARE)
    made = TriangleMesh(
        solved["vertices"], solved["faces"], solved["colors"], np.zeros_like(solved["vertices"])
    )
    made = _near(made, points, _STRAY_CUBES * side)
    if len(made.faces) == 0:
        return empty_mesh()
    on_progress(_NEAR_SHARE)
    made = ordered(
        made, lambda done: on_progress(_NEAR_SHARE + (_ORDERED_SHARE - _NEAR_SHARE) * done)
    )
    made = from_open3d(to_open3d(made, np.zeros(3)), origin)
    on_progress(_ORDERED_SHARE)
    count, colors = seen_colors(
        made,
        views,
        _BESIDE_CUBES * side,
        lambda done: on_progress(_ORDERED_SHARE + (1.0 - _ORDERED_SHARE) * done),
    )
    return replace(made, colors=np.where(count[:, None] > 0, colors, made.colors))


def averaged(
    views: Sized,
    bounds: SceneBounds,
    side: float,
    on_progress: Callable[[float], None] = lambda done: None,
) -> tuple[Cloud, float]:
    """A point for each cube that two views show, and the cubes' side, larger where they are many.

    Each view has one vote in a cube: the mean of its pixels there.
    """
    left = 1.0  # of what is told: how often larger cubes are tried is not known
    while True:
        sums = _Sums(np.zeros(0, np.int64), np.zeros((0, 9)), np.zeros(0, np.int64))
        counts = np.ceil((bounds.box_max - bounds.box_min) / side).astype(np.int64) + 1
        shown = each_view(functools.partial(_means, bounds, side, counts), views)
        for done, (key, mean) in enumerate(shown):
            on_progress(1.0 - left * (1.0 - 0.5 * done / len(views)))
            sums = sums.with_one_more(key, mean)
        agreed = sums.num_views >= _MIN_VIEWS
        if int(agreed.sum()) <= MOST_POINTS:
            break
        side *= max(_COARSER, float(np.sqrt(agreed.sum() / MOST_POINTS)))
        left *= 0.5
    found: Floats = sums.total[agreed] / sums.num_views[agreed][:, None]
    colors = np.rint(found[:, 3:6]).astype(np.uint8)
    return Cloud.seen(found[:, :3] + bounds.box_min, colors, found[:, 6:]), side


def _means(
    bounds: SceneBounds, side: float, counts: NDArray[np.int64], view: DepthView
) -> tuple[NDArray[np.int64], Floats]:
    """The cubes that a view shows, and the mean of its pixels there. counts: [3], cubes along each
    axis."""
    mask = bounds.mask(view)
    points = view.points()[mask]
    cubes = np.floor((points - bounds.box_min) / side).astype(np.int64)
    cubes = np.clip(cubes, 0, counts - 1)
    flat = (cubes[:, 0] * counts[1] + cubes[:, 1]) * counts[2] + cubes[:, 2]
    eyes = np.broadcast_to(view.world_from_camera[:, 3], points.shape)
    told = np.concatenate([points - bounds.box_min, view.rgb[mask], eyes], axis=1)
    key, at, pixels = np.unique(flat, return_inverse=True, return_counts=True)
    total = np.stack([np.bincount(at, told[:, column], len(key)) for column in range(9)], axis=1)
    return key, total / pixels[:, None]


def _near(mesh: TriangleMesh, points: Floats, reach: float) -> TriangleMesh:
    """The faces whose corners all have a point so near."""
    search = _core.nns.NearestNeighborSearch(_core.Tensor(np.ascontiguousarray(points, np.float32)))
    search.knn_index()
    _, squared = search.knn_search(_core.Tensor(mesh.vertices.astype(np.float32)), 1)
    near = squared.numpy()[:, 0] <= reach**2
    return mesh.with_faces(mesh.faces[near[mesh.faces].all(axis=1)])
