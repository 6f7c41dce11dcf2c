"""Depth views turned into a mesh by Poisson reconstruction: smooth, small holes closed.

Each cube of space with a voxel's side gets one point, the mean of what the views show in it, where
two views at least show something, from places far enough apart, and the others do not look through
it. Depths that tremble make layers of such points, some cubes thick: then each point moves onto the
plane of those around it, and those that come into one cube become one. A smooth surface is laid
through them along their normals. Where it strays from them, as it does across what nobody saw, it
is cut away. It has the mean of the colours in which views see it. All happens in a frame whose
origin is the middle of the bounds.

Sources: Kazhdan and Hoppe, "Screened Poisson Surface Reconstruction", 2013, as Open3D does it;
Alexa et al., "Point Set Surfaces", 2001, for the planes, of which one round is enough here.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

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
_PARALLAX = 0.04
"""Radians, the standard deviation of the directions in which views see a cube: 4.6 degrees between
two views. What frames of a film show that follow each other is one opinion, however many they are:
where nobody saw it from elsewhere, it is as likely off the surface. What was measured:
docs/surfaces-experiments.md."""
_OF_ALL_EYES = 0.06
"""And as a share of what all the views together could have, where that is less: far away."""
MOST_POINTS = 2_000_000
"""Points for which there is room; cubes become larger where there would be more."""
LARGE = 10_000
"""Points from which the solver gets a process of its own, whose start takes a second."""
_COARSER = 1.05
_AROUND_CUBES, _AROUND, _PORTION = 2.5, 64, 20_000
"""How far around a point its plane is sought, by how many points at most, and for how many at a
time."""
_THIN, _THICK = 0.2, 0.3
"""Cubes, the standard deviation of layers along their normals, in the median: up to the former
points stay as they are, with the edges of things; from the latter on they lie on their planes."""
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
    """Of C cubes, by their number: [C, 10] summed place, colour, eye, and the eye's square, places
    and eyes from the bounds' least corner; [C] how many views."""

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
    """A point for each cube that views show from different places, and the cubes' side, larger
    where they are many.

    Each view has one vote in a cube: the mean of its pixels there.
    """
    left = 1.0  # of what is told: how often larger cubes are tried is not known
    while True:
        sums = _Sums(np.zeros(0, np.int64), np.zeros((0, 10)), np.zeros(0, np.int64))
        counts = np.ceil((bounds.box_max - bounds.box_min) / side).astype(np.int64) + 1
        shown = each_view(functools.partial(_means, bounds, side, counts), views)
        eyes = []
        for done, (key, mean) in enumerate(shown):
            on_progress(1.0 - left * (1.0 - 0.5 * done / len(views)))
            sums = sums.with_one_more(key, mean)
            eyes += [mean[0, 6:9]] if len(key) else []
        agreed = _agreed(sums, np.array(eyes).reshape(-1, 3))
        if int(agreed.sum()) <= MOST_POINTS:
            break
        side *= max(_COARSER, float(np.sqrt(agreed.sum() / MOST_POINTS)))
        left *= 0.5
    votes = sums.num_views[agreed].astype(np.float64)
    found: Floats = sums.total[agreed] / votes[:, None]

    def on_part(done: float) -> None:
        on_progress(1.0 - left * 0.5 * (1.0 - done))

    found[:, :3] = _on_planes(found[:, :3], votes, side, on_part)
    at = np.unique(_numbered(found[:, :3], side, counts), return_inverse=True)[1]
    weight = np.bincount(at, votes)[:, None]
    merged = np.stack([np.bincount(at, votes * column) for column in found.T], axis=1) / weight
    colors = np.rint(merged[:, 3:6]).astype(np.uint8)
    seen = Cloud.seen(merged[:, :3] + bounds.box_min, colors, merged[:, 6:9] + bounds.box_min)
    return seen, side


def _on_planes(
    points: Floats, votes: Floats, side: float, on_progress: Callable[[float], None]
) -> Floats:
    """Points [P, 3], one of each cube, where they make thick layers each on the plane of those
    around it, as their votes [P] weigh them. on_progress: told the share that is done; may raise.
    """
    if len(points) == 0:
        return points
    tree = cKDTree(points)
    weights = np.append(votes, 0.0)  # of whom is not there
    places = np.append(points, np.zeros((1, 3)), axis=0)
    moves, thickness = np.zeros_like(points), np.zeros(len(points))
    for begin in range(0, len(points), _PORTION):
        on_progress(begin / len(points))
        some = slice(begin, begin + _PORTION)
        _, near = tree.query(
            points[some], _AROUND, distance_upper_bound=_AROUND_CUBES * side, workers=-1
        )
        weight = weights[near][:, :, None]
        total = weight.sum(axis=1)
        mean = (places[near] * weight).sum(axis=1) / total
        away = places[near] - mean[:, None]
        values, axes = np.linalg.eigh(
            np.matmul((away * weight).transpose(0, 2, 1), away) / total[:, :, None]
        )
        normal = axes[:, :, 0]
        moves[some] = normal * ((mean - points[some]) * normal).sum(axis=1)[:, None]
        thickness[some] = np.sqrt(np.maximum(values[:, 0], 0.0)) / side
    share = np.clip((np.median(thickness) - _THIN) / (_THICK - _THIN), 0.0, 1.0)
    laid: Floats = points + share * moves
    return laid


def _agreed(sums: _Sums, eyes: Floats) -> NDArray[np.bool_]:
    """Which cubes [C] enough views show, from places far enough apart. eyes: [V, 3], all views'."""
    mean = sums.total / sums.num_views[:, None]
    spread = np.sqrt(np.maximum(mean[:, 9] - (mean[:, 6:9] ** 2).sum(axis=1), 0.0))
    distance = np.linalg.norm(mean[:, :3] - mean[:, 6:9], axis=1)
    possible = np.sqrt(eyes.var(axis=0).sum()) if len(eyes) else 0.0
    wanted = np.minimum(_PARALLAX * distance, _OF_ALL_EYES * possible)
    enough: NDArray[np.bool_] = (sums.num_views >= _MIN_VIEWS) & (spread >= wanted)
    return enough


def _means(
    bounds: SceneBounds, side: float, counts: NDArray[np.int64], view: DepthView
) -> tuple[NDArray[np.int64], Floats]:
    """The cubes that a view shows, and the mean of its pixels there. counts: [3], cubes along each
    axis."""
    mask = bounds.mask(view)
    points = view.points()[mask] - bounds.box_min
    flat = _numbered(points, side, counts)
    key, at, pixels = np.unique(flat, return_inverse=True, return_counts=True)
    told = np.concatenate([points, view.rgb[mask]], axis=1)
    total = np.stack([np.bincount(at, told[:, column], len(key)) for column in range(6)], axis=1)
    eye = view.world_from_camera[:, 3] - bounds.box_min
    eyes = np.broadcast_to(np.append(eye, eye @ eye), (len(key), 4))
    return key, np.concatenate([total / pixels[:, None], eyes], axis=1)


def _numbered(points: Floats, side: float, counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """The cubes of points [P, 3] that are counted from the bounds' least corner."""
    cubes = np.clip(np.floor(points / side).astype(np.int64), 0, counts - 1)
    numbers: NDArray[np.int64] = (cubes[:, 0] * counts[1] + cubes[:, 1]) * counts[2] + cubes[:, 2]
    return numbers


def _near(mesh: TriangleMesh, points: Floats, reach: float) -> TriangleMesh:
    """The faces whose corners all have a point so near."""
    search = _core.nns.NearestNeighborSearch(_core.Tensor(np.ascontiguousarray(points, np.float32)))
    search.knn_index()
    _, squared = search.knn_search(_core.Tensor(mesh.vertices.astype(np.float32)), 1)
    near = squared.numpy()[:, 0] <= reach**2
    return mesh.with_faces(mesh.faces[near[mesh.faces].all(axis=1)])
