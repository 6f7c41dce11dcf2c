"""The picture on a mesh as a cloud wears it, and points of the mesh where a cloud has too few.

A cloud's own colours are those of single views of the trained scene, no finer than it was trained
and foggy where photos are few; the picture is made of the photos. And where views that agree are
few, as at a glance, the cloud is thin though the mesh is whole.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.exports.mesh import TexturedMesh
from pipelines.exports.spacing import least_crowded
from pipelines.exports.surface.cloud import Cloud
from pipelines.judging.asset_views import Texture, point_spacing

Floats = NDArray[np.float64]

_FILL_SHARE = 0.25
"""Places asked on the mesh, to the points wanted: gaps are filled half as densely, so that little
is taken from where the cloud has its points."""
_CHOICE = 2
"""So many random places to one that is kept, the most crowded left out."""
_NEAREST_EYE = 0.3
"""Of the median distance to a camera: what was filmed from nearer gets no more points."""
_PIXEL = 0.7
"""Of a point's spacing: what its colour is the mean of."""
_AWAY = 2.0
"""Of a point's spacing: so far a mesh with fewer triangles may pass it by."""
_MOST_EYES, _MOST_ASKED = 64, 20_000
"""Cameras that are asked what they see, points whether the mesh reaches them: more tell no more."""
_BEFORE = 0.999
"""Share of the way to a point that is to be free."""
_PORTION = 250_000

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


class Skin:
    """A mesh with its picture. Raises ValueError for one without faces."""

    def __init__(self, mesh: TexturedMesh) -> None:
        if len(mesh.faces) == 0:
            raise ValueError("a mesh without faces has no skin")
        self._mesh = mesh
        self._origin = mesh.vertices.mean(axis=0)
        self._picture = Texture(mesh.uv, mesh.texture)
        self._density = self._picture.density(mesh.vertices, mesh.faces)
        self._scene = _tensor_geometry.RaycastingScene()
        self._scene.add_triangles(
            _core.Tensor((mesh.vertices - self._origin).astype(np.float32)),
            _core.Tensor(mesh.faces.astype(np.uint32)),
        )

    def painted(
        self,
        cloud: Cloud,
        on_mesh: NDArray[np.bool_],
        on_progress: Callable[[float], None] = lambda done: None,
    ) -> Cloud:
        """The cloud with the picture's colours at those of its points that are on the mesh.

        on_mesh: [P], on the surface that the mesh was made of; points of which it has lost, as by a
        crop, keep their colours. on_progress: told the share that is done; may raise.
        """
        colors, which = cloud.colors.copy(), np.flatnonzero(on_mesh)
        local = cloud.points - self._origin
        spacing = point_spacing(local)
        for begin in range(0, len(which), _PORTION):
            on_progress(begin / len(which))
            some = which[begin : begin + _PORTION]
            asked = local[some].astype(np.float32)
            found = self._scene.compute_closest_points(_core.Tensor(asked))
            away = np.linalg.norm(found["points"].numpy() - asked, axis=1)
            face = found["primitive_ids"].numpy().astype(np.int64)
            u, v = found["primitive_uvs"].numpy().T
            shares = np.stack([1.0 - u - v, u, v], axis=1).astype(np.float64)
            footprint = self._density[face] * spacing[some] * _PIXEL
            shown = self._picture.colors(self._between(self._mesh.uv, face, shares), footprint)
            there = away <= _AWAY * spacing[some]
            colors[some[there]] = np.rint(255.0 * shown[there])
        return replace(cloud, colors=colors)

    def filling(
        self,
        cloud: Cloud,
        eyes: Floats,
        num_points: int,
        seed: int,
        inside: Callable[[Floats], NDArray[np.bool_]] = lambda points: np.ones(len(points), bool),
        poll: Callable[[], None] = lambda: None,
    ) -> Cloud:
        """Points of the mesh, not painted yet, for where a cloud of so many has none nearby.

        eyes: [N, 3], the cameras. inside: whether the cloud is to have points [P, 3]. poll: called
        now and then; may raise. Points are as dense as pixels see them: by the distance to the
        nearest camera. What faces no camera, or is hidden from all, was filled by whoever closed
        the mesh, and gets none.
        """
        mesh = self._mesh
        wanted = max(round(_FILL_SHARE * num_points * self._share_of(cloud)), 1)
        corners = mesh.vertices[mesh.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        area = 0.5 * np.linalg.norm(across, axis=1) * inside(corners.mean(axis=1))
        if not area.any():
            return cloud.take(np.zeros(len(cloud), bool))
        far, _ = cKDTree(eyes).query(corners.mean(axis=1))
        pixels = area / np.maximum(far, max(_NEAREST_EYE * float(np.median(far)), 1e-12)) ** 2
        random = np.random.default_rng(seed)
        along = np.cumsum(pixels)
        count = _CHOICE * wanted
        steps = (np.arange(count) + random.random(count)) / count * along[-1]
        face = np.minimum(np.searchsorted(along, steps), len(pixels) - 1)
        root, other = np.sqrt(random.random(count)), random.random(count)
        shares = np.stack([1.0 - root, root * (1.0 - other), root * other], axis=1)
        points = self._between(mesh.vertices, face, shares)
        kept = least_crowded(points, wanted, seed)
        face, shares, points = face[kept], shares[kept], points[kept]
        spacing = np.sqrt(along[-1] / wanted / pixels[face] * area[face])
        gap = np.full(len(points), np.inf)
        if len(cloud):
            gap, _ = cKDTree(cloud.points).query(points, workers=-1)
        thin = (gap > spacing) & inside(points)
        points, normals = points[thin], self._between(mesh.normals, face[thin], shares[thin])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        eye = self._seen_by(points, normals, eyes, poll)
        shown = eye >= 0
        grey = np.full((int(shown.sum()), 3), 128, np.uint8)
        return Cloud(points[shown], grey, eyes[eye[shown]], normals[shown])

    def _share_of(self, cloud: Cloud) -> float:
        """Of a cloud's points on the surface that the mesh was made of, the share that the mesh
        still has: a crop of it is not to be filled for all."""
        which = np.flatnonzero(cloud.normals.any(axis=1))
        if len(which) == 0:
            return 1.0
        every = max(len(which) // _MOST_ASKED, 1)
        which = which[::every]
        local = cloud.points[which] - self._origin
        found = self._scene.compute_closest_points(_core.Tensor(local.astype(np.float32)))
        away = np.linalg.norm(found["points"].numpy() - local, axis=1)
        spacing = point_spacing(local) / np.sqrt(every)  # of all of them
        return float((away <= _AWAY * spacing).mean())

    def _seen_by(
        self, points: Floats, normals: Floats, eyes: Floats, poll: Callable[[], None]
    ) -> NDArray[np.int64]:
        """[P], the nearest of the cameras that points face with nothing of the mesh between; -1 for
        none."""
        best, nearest = np.full(len(points), -1, np.int64), np.full(len(points), np.inf)
        for index in range(0, len(eyes), max(len(eyes) // _MOST_EYES, 1)):
            poll()
            way = eyes[index] - points
            distance = np.linalg.norm(way, axis=1)
            some = np.flatnonzero((distance < nearest) & ((way * normals).sum(axis=1) > 0.0))
            begins = np.broadcast_to(eyes[index] - self._origin, (len(some), 3))
            rays = np.concatenate([begins, -way[some]], axis=1).astype(np.float32)
            hidden = self._scene.test_occlusions(_core.Tensor(rays), 0.0, _BEFORE).numpy()
            some = some[~hidden]
            best[some], nearest[some] = index, distance[some]
        return best

    def _between(self, values: Floats, face: NDArray[np.integer[Any]], shares: Floats) -> Floats:
        """Values [V, C] of the mesh's vertices at places in faces, [P, C]."""
        found: Floats = np.einsum("pc,pcd->pd", shares, values[self._mesh.faces[face]])
        return found
