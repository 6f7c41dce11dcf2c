"""A mesh without what stands where photos show that nothing does.

What a ray passes that ends in the sky or in a blank ground is empty, all the way: the visual hull
(Laurentini, "The Visual Hull Concept for Silhouette-Based Image Understanding", PAMI 1994). Fusion
knows surfaces alone, and lets them run on past a thing's rim, or across the gap between two
chimneys, where the photos paint them with the sky. Triangles that lie across the hull's border are
cut there.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from pipelines.exports.mesh import Floats, TriangleMesh, unit_normals
from pipelines.nerf.stereo.views import StereoView

_MARGIN_PX = 1
"""Of a map: what is so near to something may be its outline, or its pose's error."""
_LEAST_VIEWS, _LEAST_SHARE = 3, 0.2
"""Views, and of those before whose picture of it nothing nearer is known the share, that see
through a point."""
_NEARER = 0.95
"""Share of a point's depth from which what is known there does not hide it."""
_HALVINGS = 4
"""Of an edge across the border, to find it."""

Bools = NDArray[np.bool_]


class Seen(NamedTuple):
    """view: a photo's. is_void: [H, W], where it shows nothing. z: [H, W], known depth, or 0."""

    view: StereoView
    is_void: Bools
    z: NDArray[np.float32]


def carved(
    mesh: TriangleMesh,
    photos: Iterable[Seen],
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """The mesh without what photos see through. on_progress: told the share that is done; may
    raise. A mesh of which nothing would be left stays.
    """
    sure = [
        one._replace(is_void=binary_erosion(one.is_void, iterations=_MARGIN_PX, border_value=1))
        for one in photos
    ]
    hull = _Hull(sure, on_progress)
    empty = hull.is_empty(mesh.vertices, 0)
    if not empty.any() or empty[mesh.faces].all():
        return mesh
    return _cut(mesh, empty, hull)


@dataclass(frozen=True)
class _Hull:
    """photos: void where they are so for sure."""

    photos: Sequence[Seen]
    on_progress: Callable[[float], None]

    def is_empty(self, points: Floats, turn: int) -> Bools:
        """[P], whether enough photos see through points [P, 3]. turn: how often it was asked."""
        through = np.zeros(len(points), np.int64)
        reached = np.zeros(len(points), np.int64)
        for done, (view, void, z) in enumerate(self.photos):
            self.on_progress((turn + done / len(self.photos)) / (1 + _HALVINGS))
            which, row, column = view.shown_at(points)
            depth = (points[which] - view.center) @ view.world_from_camera[:, 2]
            known = z[row, column]
            reached[which] += (known <= 0.0) | (known >= _NEARER * depth)
            through[which] += void[row, column]
        empty: Bools = (through >= _LEAST_VIEWS) & (through >= _LEAST_SHARE * reached)
        return empty


def _cut(mesh: TriangleMesh, empty: Bools, hull: _Hull) -> TriangleMesh:
    """The mesh without the parts of its faces that lie beyond the border of what is empty [V]."""
    count = empty[mesh.faces].sum(axis=1)
    # The odd corner comes first, the others follow in their order.
    one_gone = _turned(mesh.faces[count == 1], empty[mesh.faces[count == 1]])
    one_left = _turned(mesh.faces[count == 2], ~empty[mesh.faces[count == 2]])
    edges = np.concatenate(
        [one_gone[:, [1, 0]], one_gone[:, [2, 0]], one_left[:, [0, 1]], one_left[:, [0, 2]]]
    )
    edges, place = np.unique(edges, axis=0, return_inverse=True)
    share = _border(mesh.vertices, edges, hull)[:, None]
    new = len(mesh.vertices) + place.reshape(-1).astype(np.int32)
    ends = np.cumsum([len(one_gone), len(one_gone), len(one_left)])
    a, b, c, d = np.split(new, ends)

    def between(values: Floats) -> Floats:
        inner: Floats = (1.0 - share) * values[edges[:, 0]] + share * values[edges[:, 1]]
        return np.concatenate([values, inner])

    faces = [
        mesh.faces[count == 0],
        np.stack([a, one_gone[:, 1], one_gone[:, 2]], axis=1),
        np.stack([a, one_gone[:, 2], b], axis=1),
        np.stack([one_left[:, 0], c, d], axis=1),
    ]
    whole = TriangleMesh(
        between(mesh.vertices),
        np.concatenate(faces).astype(np.int32),
        between(mesh.colors),
        unit_normals(between(mesh.normals)),
    )
    return whole.with_faces(whole.faces)


def _turned(faces: NDArray[np.int32], is_first: Bools) -> NDArray[np.int32]:
    """Faces [F, 3] with that corner in front, [F, 3] with one of each."""
    order = (is_first.argmax(axis=1)[:, None] + np.arange(3)) % 3
    return np.take_along_axis(faces, order, axis=1)


def _border(vertices: Floats, edges: NDArray[np.int32], hull: _Hull) -> Floats:
    """[E], how far along edges [E, 2] from what is there to what is empty the border lies."""
    begin, end = vertices[edges[:, 0]], vertices[edges[:, 1]]
    low, high = np.zeros(len(edges)), np.ones(len(edges))
    for turn in range(1, 1 + _HALVINGS):
        middle = 0.5 * (low + high)
        empty = hull.is_empty(begin + middle[:, None] * (end - begin), turn)
        low, high = np.where(empty, low, middle), np.where(empty, middle, high)
    return 0.5 * (low + high)
