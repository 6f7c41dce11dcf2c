"""Sums over the neighbourhoods of a mesh's vertices.

Symbols: V vertices, F faces.
"""

from __future__ import annotations

from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array, csr_array, diags_array

from pipelines.exports.mesh import unit_normals

Floats = NDArray[np.float64]


class MeshRings:
    """Who is whose neighbour. faces: [F, 3]. noise: the least length that `scale` tells."""

    def __init__(self, faces: NDArray[np.int32], num_vertices: int, noise: float = 0.0) -> None:
        self.faces = faces
        self.noise = noise
        self.num_vertices = num_vertices
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        rows, columns = np.concatenate([edges, edges[:, ::-1]]).T
        shape = (num_vertices, num_vertices)
        self.around: csr_array = coo_array((np.ones(len(rows)), (rows, columns)), shape).tocsr()
        """[V, V]: 1 where an edge is."""
        self.around.data[:] = 1.0

    @cached_property
    def degree(self) -> Floats:
        """[V]: neighbours."""
        return np.asarray(self.around.sum(axis=1), np.float64).ravel()

    @cached_property
    def laplacian(self) -> csr_array:
        """[V, V]: of the graph, positive semidefinite."""
        return (diags_array(self.degree) - self.around).tocsr()

    @cached_property
    def on_border(self) -> NDArray[np.bool_]:
        """[V]: at an edge with one face."""
        faces = self.faces
        edges = np.concatenate([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
        pairs, counts = np.unique(np.sort(edges, axis=1), axis=0, return_counts=True)
        border = np.zeros(self.num_vertices, np.bool_)
        border[pairs[counts == 1]] = True
        return border

    def edge_lengths(self, vertices: Floats) -> Floats:
        """[V]: the mean length of the edges at each vertex."""
        pairs = self.around.tocoo()
        length = np.linalg.norm(vertices[pairs.row] - vertices[pairs.col], axis=1)
        mean: Floats = np.bincount(pairs.row, length, len(vertices)) / np.maximum(self.degree, 1.0)
        return mean

    def scale(self, vertices: Floats) -> Floats:
        """[V]: what bumps are measured in: the edges, where they are not shorter than noise is."""
        return np.maximum(self.edge_lengths(vertices), max(self.noise, 1e-12))

    def crossed(self, vertices: Floats) -> tuple[Floats, Floats]:
        """Sums over the faces around each vertex: of twice their area times their normal [V, 3],
        and of twice their area [V].
        """
        first, second, third = (vertices[self.faces[:, k]] for k in range(3))
        across = np.cross(second - first, third - first)
        twice = np.linalg.norm(across, axis=1)
        total, area = np.zeros_like(vertices), np.zeros(len(vertices))
        for corner in self.faces.T:
            area += np.bincount(corner, twice, len(vertices))
            for axis in range(3):
                total[:, axis] += np.bincount(corner, across[:, axis], len(vertices))
        return total, area

    def straightness(self, vertices: Floats, rounds: int) -> Floats:
        """[V]: the length of the mean normal around each, about so many edges far: 1 on a plane."""
        total, area = self.crossed(vertices)
        for _ in range(rounds):
            total, area = total + self.around @ total, area + self.around @ area
        straight: Floats = np.linalg.norm(total, axis=1) / np.maximum(area, 1e-30)
        return straight

    def normals(self, vertices: Floats) -> Floats:
        """[V, 3], unit: the mean of the faces around each, by area."""
        return unit_normals(self.crossed(vertices)[0])

    def areas(self, vertices: Floats) -> Floats:
        """[V]: a third of the faces around each."""
        area: Floats = self.crossed(vertices)[1] / 6.0
        return area

    def spread(self, values: Floats, rounds: int) -> Floats:
        """[V, ...] halfway to the neighbours' mean, so many times."""
        count = np.maximum(self.degree, 1.0)[:, None]
        for _ in range(rounds):
            values = 0.5 * values + 0.5 * (self.around @ values) / count
        return values
