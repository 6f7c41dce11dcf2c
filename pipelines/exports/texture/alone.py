"""Faces that no photo shows whole: how finely they are laid flat, and the gradients on them.

All that is known of them is the colours of their vertices, so they need no more texels than these
tell of. Symbols: V vertices, F faces, U corners, P photos, N texels.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from pipelines.exports.texture.charts import Charts, Layout
from pipelines.exports.texture.choice import NOBODY
from pipelines.exports.texture.photos import Photos

Floats = NDArray[np.float64]

_TEXELS_PER_EDGE = 2.0
"""Of a triangle as large as a face with equal sides."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def gradient_density(vertices: Floats, faces: NDArray[np.int32], photos: Photos) -> Floats:
    """Texels for a unit of length on each face, [F]: what its corners' colours need, and no more
    than a pixel of the nearest photo would show.

    vertices: [V, 3], in the frame of the photos.
    """
    a, b, c = (vertices[faces[:, corner]] for corner in range(3))
    twice = np.linalg.norm(np.cross(b - a, c - a), axis=1)
    edge = np.sqrt(2.0 / np.sqrt(3.0) * twice)
    eyes = np.stack([photos.eye(index) for index in range(len(photos))])
    distance, nearest = cKDTree(eyes).query((a + b + c) / 3.0)
    angle = np.array([photos.pixel_angle(index) for index in range(len(photos))])
    covers = np.maximum(angle[nearest] * distance, 1e-30)
    density: Floats = np.minimum(_TEXELS_PER_EDGE / np.maximum(edge, 1e-30), 1.0 / covers)
    return density


class Gradients:
    """The texels of charts that no photo shows, margins and all. N may be 0.

    rows, columns: [N]. Each has the colour of the place on its chart that is nearest to it.
    """

    def __init__(self, charts: Charts, layout: Layout) -> None:
        alone = np.flatnonzero(charts.photo == NOBODY)
        own = charts.faces[charts.photo[charts.face_chart] == NOBODY]
        places = [layout.packing.texels(chart) for chart in alone.tolist()]
        self.rows, self.columns = np.concatenate([np.zeros((2, 0), np.int64), *places], axis=1)
        if len(alone) == 0:
            return
        flat = np.concatenate([layout.uv, np.zeros((len(layout.uv), 1))], axis=1)
        scene = _tensor_geometry.RaycastingScene()
        scene.add_triangles(
            _core.Tensor(flat.astype(np.float32)),
            _core.Tensor(np.ascontiguousarray(own, np.uint32)),
        )
        asked = np.stack([self.columns + 0.5, self.rows + 0.5, np.zeros(len(self.rows))], axis=1)
        found = scene.compute_closest_points(_core.Tensor(asked.astype(np.float32)))
        self._corners = own[found["primitive_ids"].numpy().astype(np.int64)]
        u, v = found["primitive_uvs"].numpy().T
        self._weights = np.stack([1.0 - u - v, u, v], axis=1)

    def paint(self, picture: NDArray[np.uint8], colors: NDArray[np.floating[Any]]) -> None:
        """Lay them on a picture [H, W, 3], in place. colors: [U, 3] in [0, 1]."""
        if len(self.rows):
            mixed = np.einsum("nc,ncd->nd", self._weights, colors[self._corners])
            texels = np.rint(255.0 * np.clip(mixed, 0.0, 1.0)).astype(np.uint8)
            picture[self.rows, self.columns] = texels
