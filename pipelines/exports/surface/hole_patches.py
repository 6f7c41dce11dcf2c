"""Faces over holes made like those around them: as fine, and going on as the surface does.

After Liepa, "Filling holes in meshes" (2003): edges that are longer than those of the rim are
halved, edges are turned until no circle around a face holds a neighbour's corner, and the new
vertices are laid so that the surface bends least, its rim and what lies beyond being given:

    min_x  sum_i |x_i - mean of its neighbours|^2 + t sum_edges |x_i - x_j|^2

over new vertices and those of rims. The second term holds like a skin: a fused surface's rim
trembles, and what bends least goes on as its last triangles point, into the air.

Symbols: V vertices of the mesh, N new ones, M faces over holes.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array
from scipy.sparse.linalg import splu

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]

_LONG = 1.4
"""An edge is halved that is longer than those of its rim, times this."""
_MOST_HALVINGS, _FEW_TURNS, _MOST_TURNS = 12, 4, 20
_TENSION = 0.005


@dataclass(frozen=True)
class Patches:
    """Faces over several holes of one mesh.

    new: [N, 3], places of the vertices after the mesh's own V. faces: [M, 3], in vertices of mesh
    and patches. hole_of: [M], which hole each is of.
    """

    new: Floats
    faces: Ints
    hole_of: Ints

    def without(self, holes: Ints) -> Patches:
        """Those of the other holes; the new vertices keep their numbers."""
        kept = ~np.isin(self.hole_of, holes)
        return Patches(self.new, self.faces[kept], self.hole_of[kept])


def edges_of(faces: NDArray[np.integer]) -> tuple[Ints, Ints, Ints]:
    """(pairs [E, 2] of vertices, edge_of [3 M], count [E]) of the edges of faces [M, 3].

    edge_of: of corner k of face f to the next one, at 3 f + k.
    """
    sides = np.sort(faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
    base = int(sides.max(initial=0)) + 1
    keys, edge_of, count = np.unique(
        sides[:, 0] * base + sides[:, 1], return_inverse=True, return_counts=True
    )
    return np.stack([keys // base, keys % base], axis=1), edge_of.reshape(-1), count


def fine_patches(
    vertices: Floats, around: NDArray[np.integer], patches: Patches, lengths: Floats
) -> Patches:
    """Patches as fine as their rims, laid so that the surface goes on.

    vertices: [V, 3] of the mesh. around: [K, 3], its faces at the rims. patches: coarse ones.
    lengths: of the edges that the patch over each hole shall have.
    """
    faces, hole_of = patches.faces, patches.hole_of
    points = np.concatenate([vertices, patches.new])
    known = edges_of(around)[0]
    for _ in range(_MOST_HALVINGS):
        faces = _turned(points, faces, known, _FEW_TURNS)
        halved = _halved(points, faces, hole_of, lengths)
        if halved is None:
            break
        points, faces, hole_of = halved
    faces = _turned(points, faces, known)
    points = _laid(points, len(vertices), around, faces)
    faces = _turned(points, faces, known)
    return Patches(points[len(vertices) :], faces, hole_of)


def spread_over(values: Floats, patches: Patches) -> Floats:
    """[N, C] what rims have, evenly spread over the new vertices. values: [V, C]."""
    count = len(values) + len(patches.new)
    inner = np.arange(len(values), count)
    if len(inner) == 0:
        return np.zeros((0, values.shape[1]))
    graph = _graph(patches.faces, count)
    stiff = (diags_array(np.asarray(graph.sum(axis=1)).ravel()) - graph).tocsr()
    # A vertex that no face has stays where it may.
    loose = diags_array(np.full(len(inner), 1e-12))
    own = (stiff[inner][:, inner] + loose).tocsc()
    found: Floats = splu(own).solve(-(stiff[inner][:, : len(values)] @ values))
    return found


def _graph(faces: Ints, count: int) -> csr_array:
    """[count, count]: 1 where an edge is."""
    pairs = edges_of(faces)[0]
    rows, columns = np.concatenate([pairs, pairs[:, ::-1]]).T
    return coo_array((np.ones(len(rows)), (rows, columns)), (count, count)).tocsr()


def _halved(
    points: Floats, faces: Ints, hole_of: Ints, lengths: Floats
) -> tuple[Floats, Ints, Ints] | None:
    """Each long edge within a patch halved that is the longest of both its faces; None: no such."""
    pairs, edge_of, count = edges_of(faces)
    length = np.linalg.norm(points[pairs[:, 0]] - points[pairs[:, 1]], axis=1)
    wanted = np.zeros(len(pairs))
    wanted[edge_of] = np.repeat(lengths[hole_of], 3)
    length = np.where((count == 2) & (length > _LONG * wanted), length, 0.0)
    # Ties are settled by the edge's number, so that two faces choose the same.
    rank = np.empty(len(pairs), np.int64)
    rank[np.lexsort((np.arange(len(pairs)), length))] = np.arange(len(pairs))
    of_face = edge_of.reshape(-1, 3)
    longest = rank[of_face].argmax(axis=1)
    chosen = of_face[np.arange(len(faces)), longest]
    votes = np.bincount(chosen, minlength=len(pairs))
    split = (votes == 2) & (length > 0.0)
    if not split.any():
        return None
    number = np.full(len(pairs), -1, np.int64)
    number[split] = len(points) + np.arange(int(split.sum()))
    cut = np.flatnonzero(split[chosen])
    corners = np.take_along_axis(faces[cut], (longest[cut, None] + np.arange(3)) % 3, axis=1)
    middle = number[chosen[cut]]
    one = np.stack([corners[:, 0], middle, corners[:, 2]], axis=1)
    other = np.stack([middle, corners[:, 1], corners[:, 2]], axis=1)
    made = faces.copy()
    made[cut] = one
    ends = pairs[split]
    return (
        np.concatenate([points, (points[ends[:, 0]] + points[ends[:, 1]]) / 2.0]),
        np.concatenate([made, other]),
        np.concatenate([hole_of, hole_of[cut]]),
    )


def _turned(points: Floats, faces: Ints, known: Ints, rounds: int = _MOST_TURNS) -> Ints:
    """The edges within patches turned as Delaunay's triangles have them. known: [K, 2] edges of the
    mesh, which are not made again."""
    base = len(points)
    taken_before = np.sort(known, axis=1) @ np.array([base, 1])
    for _ in range(rounds):
        pairs, edge_of, count = edges_of(faces)
        sides = np.argsort(edge_of, kind="stable")
        begin = np.cumsum(count) - count
        inner = np.flatnonzero(count == 2)
        left, right = sides[begin[inner]], sides[begin[inner] + 1]
        # Left has the edge from a to b and c across, right from b to a and d across.
        a, b = faces[left // 3, left % 3], faces[left // 3, (left + 1) % 3]
        c, d = faces[left // 3, (left + 2) % 3], faces[right // 3, (right + 2) % 3]
        gain = _angle(points, c, a, b) + _angle(points, d, a, b) - np.pi
        normals = [_normal(points, *corner) for corner in ((a, b, c), (b, a, d))]
        made = [_normal(points, *corner) for corner in ((c, a, d), (d, b, c))]
        upright = np.ones(len(inner), np.bool_)
        for new in made:
            upright &= (new * (normals[0] + normals[1])).sum(axis=1) > 0.0
        wanted = np.sort(np.stack([c, d], axis=1), axis=1) @ np.array([base, 1])
        present = pairs @ np.array([base, 1])
        fresh = ~np.isin(wanted, present) & ~np.isin(wanted, taken_before)
        good = np.flatnonzero((gain > 1e-6) & upright & fresh & (c != d))
        if len(good) == 0:
            break
        good = good[np.argsort(-gain[good], kind="stable")]
        _, first = np.unique(wanted[good], return_index=True)
        good = good[np.sort(first)]
        best = np.full(len(faces), len(good), np.int64)
        order = np.arange(len(good))
        np.minimum.at(best, left[good] // 3, order)
        np.minimum.at(best, right[good] // 3, order)
        alone = (best[left[good] // 3] == order) & (best[right[good] // 3] == order)
        good = good[alone]
        faces = faces.copy()
        faces[left[good] // 3] = np.stack([c[good], a[good], d[good]], axis=1)
        faces[right[good] // 3] = np.stack([d[good], b[good], c[good]], axis=1)
    return faces


def _angle(points: Floats, at: Ints, a: Ints, b: Ints) -> Floats:
    """[N], between the ways from vertices to two others."""
    one, two = points[a] - points[at], points[b] - points[at]
    across = np.linalg.norm(np.cross(one, two), axis=1)
    angle: Floats = np.arctan2(across, (one * two).sum(axis=1))
    return angle


def _normal(points: Floats, a: Ints, b: Ints, c: Ints) -> Floats:
    normal: Floats = np.cross(points[b] - points[a], points[c] - points[a])
    return normal


def _laid(points: Floats, num_old: int, around: NDArray[np.integer], faces: Ints) -> Floats:
    """The points with those from `num_old` on where the surface bends least."""
    inner = np.arange(num_old, len(points))
    if len(inner) == 0:
        return points
    rows = np.unique(faces)
    graph = _graph(np.concatenate([around.astype(np.int64), faces]), len(points))[rows]
    degree = np.asarray(graph.sum(axis=1)).ravel()
    own = coo_array((np.ones(len(rows)), (np.arange(len(rows)), rows)), graph.shape)
    bend = (own - diags_array(1.0 / degree) @ graph).tocsc()
    skin_graph = _graph(faces, len(points))
    skin = (diags_array(np.asarray(skin_graph.sum(axis=1)).ravel()) - skin_graph).tocsc()
    outer = np.unique(np.concatenate([around.reshape(-1), faces.reshape(-1)]))
    outer = outer[outer < num_old]
    # Near zero there are more digits.
    origin = points[outer].mean(axis=0)
    free, held = bend[:, inner], bend[:, outer]
    matrix = (free.T @ free + _TENSION * skin[inner][:, inner]).tocsc()
    right = -(free.T @ held + _TENSION * skin[inner][:, outer]) @ (points[outer] - origin)
    laid = points.copy()
    laid[inner] = splu(matrix).solve(right) + origin
    return laid
