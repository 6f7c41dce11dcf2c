"""Small holes of a surface closed, and which holes are none.

A border of a mesh is a loop. It is closed where its diameter is small, and left open where

- it is the outer border of a piece: what closes it folds back over what is beyond the rim;
- cameras look through: of what they show where it would be closed, more lies behind, or is nothing
  at all, than lies there. The hole in a handle is none in the surface, and what a window is, where
  depth is unknown, is not for this to guess;
- something is there: what would close it meets or lies on another part of the surface, as where a
  loose piece lies in the hole;
- the mesh is tangled there: an edge would have three faces.

Symbols: V vertices of the mesh, N new ones, P points.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.distance import pdist

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.borders import Loop, border_loops
from pipelines.exports.surface.hole_patches import Patches, edges_of, fine_patches, spread_over
from pipelines.exports.surface.rings import MeshRings
from pipelines.exports.surface.shells import Shell
from pipelines.exports.surface.triangulation import least_area
from pipelines.scene.depth_views import DepthView

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_MOST_EDGES = 400
_GOES_ON = 0.3
"""Cosine between what closes a hole and what is beyond its rim, in the mean, that is a hole's."""
_DEPTH_SHARE, _DEPTH_EDGES = 0.02, 2.0
"""What a view shows is on a surface within this of its depth, or these edges of it."""
_APART = 0.3
"""Edges: another part of the surface is as near as this only where both are one."""
_SHARE_MET = 0.05
_NEAR_END = 0.02

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


@dataclass(frozen=True)
class Closing:
    """mesh: with what closes its holes. closed: how many. left: how many small ones stay open, by
    why: `outer`, `seen_through`, `occupied`, `tangled`."""

    mesh: TriangleMesh
    closed: int = 0
    left: dict[str, int] = field(default_factory=dict)

    def as_dict(self) -> dict[str, Any]:
        """What the report says."""
        return {"closed": self.closed, "left_open": self.left}


def hole_limits(
    shells: Sequence[Shell], size: float, max_distance: float
) -> Callable[[Floats], Floats]:
    """How large holes may be at points [P, 3]: [P], world units.

    size: in the distances of shells. max_distance: in those of their bounds; beyond it, holes may
    grow as the voxels do.
    """

    def limit_at(points: Floats) -> Floats:
        limits, known = np.zeros(len(points)), np.zeros(len(points), np.bool_)
        for shell in shells:
            bounds = shell.bounds
            grown = max(1.0, bounds.radius / (max_distance * bounds.distance))
            # What reaches out of the last one has its size.
            here = ~known & (bounds.contains(points) | (shell is shells[-1]))
            limits[here] = size * shell.distance * grown
            known |= here
        return limits

    return limit_at


def close_holes(
    mesh: TriangleMesh,
    limit_at: Callable[[Floats], Floats],
    views: Iterable[DepthView] = (),
    on_progress: Callable[[float], None] = lambda done: None,
) -> Closing:
    """The mesh with its small holes closed, its own vertices first and as they were.

    limit_at: see `hole_limits`. views: what cameras show, in the mesh's world. on_progress: told
    the share that is done; may raise.
    """
    loops = [loop for loop in border_loops(mesh.faces) if len(loop.vertices) <= _MOST_EDGES]
    if not loops:
        return Closing(mesh)
    middles = np.array([mesh.vertices[loop.vertices].mean(axis=0) for loop in loops])
    small = [
        loop
        for loop, limit in zip(loops, limit_at(middles), strict=True)
        if diameter(mesh.vertices[loop.vertices]) <= limit
    ]
    on_progress(0.1)
    return _Work(mesh, small).closed(views, on_progress) if small else Closing(mesh)


def diameter(points: Floats) -> float:
    """The greatest distance between two of points [P, 3]."""
    if len(points) > 100:
        # Points in a plane or on a line have no hull.
        with contextlib.suppress(QhullError):
            points = points[ConvexHull(points).vertices]
    return float(pdist(points).max())


class _Work:
    """The holes of a mesh, and what is known of each: the loops are numbered."""

    def __init__(self, mesh: TriangleMesh, loops: Sequence[Loop]) -> None:
        self.mesh, self.loops = mesh, loops
        self.rim = np.zeros(len(mesh.vertices), np.bool_)
        self.rim[np.concatenate([loop.vertices for loop in loops])] = True
        self.at_rim = np.flatnonzero(self.rim[mesh.faces].any(axis=1))
        corners = mesh.vertices[mesh.faces[self.at_rim]]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        length = np.linalg.norm(across, axis=1, keepdims=True)
        self.normals = np.zeros((len(mesh.faces), 3))
        self.normals[self.at_rim] = across / np.maximum(length, 1e-300)
        edges = edges_of(mesh.faces[self.at_rim])[0]
        self.edges = np.sort(edges, axis=1) @ np.array([len(mesh.vertices), 1])
        self.lengths = np.array([self._edge_lengths(loop).mean() for loop in loops])
        self.left: dict[str, int] = {}

    def _edge_lengths(self, loop: Loop) -> Floats:
        points = self.mesh.vertices[loop.vertices]
        lengths: Floats = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
        return lengths

    def closed(self, views: Iterable[DepthView], on_progress: Callable[[float], None]) -> Closing:
        """What comes of it."""
        patches = self._coarse(on_progress)
        patches = self._dropped(patches, self._outer(), "outer")
        patches = self._dropped(patches, self._tangled(patches), "tangled")
        if len(patches.faces):
            around = self.mesh.faces[self.at_rim]
            patches = fine_patches(self.mesh.vertices, around, patches, self.lengths)
            patches = self._dropped(patches, self._folded(patches), "outer")
            on_progress(0.5)
            seen_through = self._seen_through(patches, views, lambda: on_progress(0.5))
            patches = self._dropped(patches, seen_through, "seen_through")
            patches = self._dropped(patches, self._occupied(patches), "occupied")
            patches = self._dropped(patches, self._tangled(patches), "tangled")
        on_progress(1.0)
        if len(patches.faces) == 0:
            return Closing(self.mesh, 0, self.left)
        return Closing(with_patches(self.mesh, patches), self._number(patches), self.left)

    def _number(self, patches: Patches) -> int:
        return len(np.unique(patches.hole_of))

    def _dropped(self, patches: Patches, bad: Bools, why: str) -> Patches:
        """The patches less those of some holes [loops]."""
        kept = patches.without(np.flatnonzero(bad))
        count = self._number(patches) - self._number(kept)
        if count:
            self.left[why] = self.left.get(why, 0) + count
        return kept

    def _coarse(self, on_progress: Callable[[float], None]) -> Patches:
        """As few faces as there can be over each hole."""
        faces, hole_of, points = [], [], self.mesh.vertices
        for index, loop in enumerate(self.loops):
            own = loop.vertices
            low, high = np.minimum.outer(own, own), np.maximum.outer(own, own)
            wanted = low * len(points) + high
            at = np.searchsorted(self.edges, wanted).clip(max=len(self.edges) - 1)
            taken = self.edges[at] == wanted
            found = least_area(points[own], taken)
            if found is None:
                self.left["tangled"] = self.left.get("tangled", 0) + 1
                continue
            faces.append(own[found])
            hole_of.append(np.full(len(found), index))
            on_progress(0.1 + 0.2 * index / len(self.loops))
        none = np.zeros((0, 3), np.int64)
        return Patches(
            np.zeros((0, 3)),
            np.concatenate([none, *faces]),
            np.concatenate([none[:, 0], *hole_of]),
        )

    def _outer(self) -> Bools:
        """[loops], where what is beyond the rim lies within the loop, or goes off to its side."""
        outer = np.zeros(len(self.loops), np.bool_)
        for index, loop in enumerate(self.loops):
            points = self.mesh.vertices[loop.vertices]
            points = points - points.mean(axis=0)
            across = np.cross(points, np.roll(points, -1, axis=0)).sum(axis=0)
            outer[index] = self._unlike(loop, across / max(float(np.linalg.norm(across)), 1e-300))
        return outer

    def _folded(self, patches: Patches) -> Bools:
        """[loops], where the patch does not go on as the surface does."""
        points = np.concatenate([self.mesh.vertices, patches.new])
        corners = points[patches.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        unit = across / np.maximum(np.linalg.norm(across, axis=1, keepdims=True), 1e-300)
        own = patches.faces.reshape(-1) * len(points) + patches.faces[:, [1, 2, 0]].reshape(-1)
        order = np.argsort(own)
        folded = np.zeros(len(self.loops), np.bool_)
        for index in np.unique(patches.hole_of):
            loop = self.loops[index]
            wanted = loop.vertices * len(points) + np.roll(loop.vertices, -1)
            there = order[np.searchsorted(own, wanted, sorter=order)] // 3
            folded[index] = self._unlike(loop, unit[there])
        return folded

    def _unlike(self, loop: Loop, normals: Floats) -> bool:
        """Whether normals [3] or [L, 3] are not those of the faces beyond a rim, in the mean."""
        lengths = self._edge_lengths(loop)
        cosine = (self.normals[loop.faces] * normals).sum(axis=1)
        return float(cosine @ lengths) < _GOES_ON * float(lengths.sum())

    def _tangled(self, patches: Patches) -> Bools:
        """[loops], where an edge would have more than two faces."""
        own = patches.faces
        _, edge_of, count = edges_of(np.concatenate([self.mesh.faces[self.at_rim], own]))
        many = (count[edge_of] > 2).reshape(-1, 3)[len(self.at_rim) :].any(axis=1)
        tangled = np.zeros(len(self.loops), np.bool_)
        tangled[patches.hole_of[many]] = True
        return tangled

    def _seen_through(
        self, patches: Patches, views: Iterable[DepthView], tell: Callable[[], None]
    ) -> Bools:
        """[loops], where cameras look through rather than at what would be there."""
        points = np.concatenate([self.mesh.vertices, patches.new])
        middles = points[patches.faces].mean(axis=1)
        at, through = np.zeros(len(middles)), np.zeros(len(middles))
        margins = _DEPTH_EDGES * self.lengths[patches.hole_of]
        for view in views:
            behind, there = looks(view, middles, margins)
            through += behind
            at += there
            tell()
        count = len(self.loops)
        total_through = np.bincount(patches.hole_of, through, count)
        open_there: Bools = total_through > np.bincount(patches.hole_of, at, count)
        return open_there

    def _occupied(self, patches: Patches) -> Bools:
        """[loops], where the patch meets or lies on what is there already."""
        if len(patches.faces) == 0:
            return np.zeros(len(self.loops), np.bool_)
        origin = self.mesh.vertices.mean(axis=0)
        points = np.concatenate([self.mesh.vertices, patches.new]) - origin
        scene = _tensor_geometry.RaycastingScene()
        scene.add_triangles(
            _core.Tensor((self.mesh.vertices - origin).astype(np.float32)),
            _core.Tensor(self.mesh.faces.astype(np.uint32)),
        )
        starts = points[patches.faces].reshape(-1, 3)
        ways = points[patches.faces[:, [1, 2, 0]]].reshape(-1, 3) - starts
        rays = _core.Tensor(np.concatenate([starts, ways], axis=1).astype(np.float32))
        met = scene.test_occlusions(rays, _NEAR_END, 1.0 - _NEAR_END).numpy()
        middles = points[patches.faces].mean(axis=1)
        found = scene.compute_closest_points(_core.Tensor(middles.astype(np.float32)))
        away = np.linalg.norm(found["points"].numpy() - middles, axis=1)
        nearest = found["primitive_ids"].numpy().astype(np.int64)
        other = ~self._is_beyond_rim(patches.hole_of, self.mesh.faces[nearest])
        lies_on = other & (away < _APART * self.lengths[patches.hole_of])
        count = len(self.loops)
        bad = np.bincount(patches.hole_of, lies_on | met.reshape(-1, 3).any(axis=1), count)
        occupied: Bools = bad > _SHARE_MET * np.bincount(patches.hole_of, minlength=count)
        return occupied

    def _is_beyond_rim(self, holes: Ints, faces: NDArray[np.integer]) -> Bools:
        """[N], whether a face of the mesh [N, 3] is about the rim of that hole [N]."""
        count = len(self.mesh.vertices)
        near = self.mesh.faces[self.at_rim]
        rows = np.repeat(np.arange(len(self.loops)), [len(loop.vertices) for loop in self.loops])
        columns = np.concatenate([loop.vertices for loop in self.loops])
        shape = (len(self.loops), count)
        rims = coo_array((np.ones(len(rows)), (rows, columns)), shape).tocsr()
        hole, vertex = (rims + rims @ MeshRings(near, count).around).nonzero()
        known = hole.astype(np.int64) * count + vertex
        of_face = [np.isin(holes * count + corner, known) for corner in faces.T]
        beyond: Bools = of_face[0] | of_face[1] | of_face[2]
        return beyond


def looks(view: DepthView, points: Floats, margins: Floats) -> tuple[Bools, Bools]:
    """Whether a view shows what lies behind points [P, 3], or nothing; and whether what is there.

    margins: [P], how far from a point what is there may be along the view's axis. Points that are
    not in the picture, or behind something, are neither.
    """
    depth, shown = view.seen_at(points)
    margin = np.maximum(margins, _DEPTH_SHARE * depth)
    behind: Bools = (shown == 0.0) | (shown > depth + margin)
    there: Bools = (shown > 0.0) & (shown >= depth - margin) & (shown <= depth + margin)
    return behind, there


def with_patches(mesh: TriangleMesh, patches: Patches) -> TriangleMesh:
    """The mesh and what closes its holes: colours of the rims, normals of all faces around."""
    used, flat = np.unique(patches.faces, return_inverse=True)
    old = len(mesh.vertices)
    number = np.arange(old + len(patches.new))
    fresh = used[used >= old]
    number[fresh] = old + np.arange(len(fresh))
    made = number[used][flat].reshape(-1, 3)
    vertices = np.concatenate([mesh.vertices, patches.new[fresh - old]])
    colors = np.concatenate([mesh.colors, spread_over(mesh.colors, patches)[fresh - old]])
    faces = np.concatenate([mesh.faces, made.astype(np.int32)])
    touched = np.zeros(len(vertices), np.bool_)
    touched[made] = True
    near = faces[touched[faces].any(axis=1)]
    normals = np.concatenate([mesh.normals, np.zeros((len(fresh), 3))])
    normals[touched] = MeshRings(near, len(vertices)).normals(vertices)[touched]
    return TriangleMesh(vertices, faces, np.clip(colors, 0.0, 1.0), normals)
