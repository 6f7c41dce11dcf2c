"""A mesh of fewer triangles, by quadric decimation, before it is painted: no seam is torn.

All that makes meshes smaller goes through here: the fused surface, the mesh as it is delivered, its
levels of detail. Each piece of the mesh gives up the same share of its triangles: across all of
them the coarse triangles of what is far would count for more than the fine ones of the subject.
Open borders stay exactly as they are, as far as the triangles suffice for them. (Open3D's
decimation is not used: it is three times as slow for the same distance to the surface, and its
`boundary_weight`, as of 0.20, does not hold borders.)
The work itself is `pipelines.exports.decimation`.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import open3d
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.exports import decimation
from pipelines.exports.apart import run_apart
from pipelines.exports.decimation import decimated
from pipelines.exports.mesh import Floats, TriangleMesh, joined
from pipelines.exports.surface.open3d_mesh import from_open3d, to_open3d

_LEAST_PIECE = 200
"""Faces; what is smaller is reduced together with its like."""
_LEAST_SHARE = 4
"""Faces that a piece keeps: with fewer it is no surface any more, or gone."""
LARGE = 300_000
"""Faces of a piece that has a process of its own."""
_USUAL_S = 6e-6
"""How long a face takes, for what is told while nobody knows how far it is."""

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core
_tensor_geometry: Any = open3d.t.geometry


def reduced(
    mesh: TriangleMesh,
    triangles: int,
    on_progress: Callable[[float], None] = lambda done: None,
) -> TriangleMesh:
    """The mesh with so many triangles; one that has no more stays as it is.

    A few more remain where no edge can be taken away without turning a triangle over, and where
    there are so many pieces that the least of each is more. on_progress:
    told a share that rises, every second also within a large piece; what it raises ends the work.
    """
    total = len(mesh.faces)
    if total <= triangles:
        return mesh
    piece = _pieces(mesh)
    sizes = np.bincount(piece)
    shares = _shares(sizes, triangles)
    before = np.cumsum(sizes) - sizes
    parts = []
    for index, share in enumerate(shares):

        def on_part(done: float, first: int = before[index], size: int = sizes[index]) -> None:
            on_progress((first + size * done) / total)

        parts.append(_fewer(mesh.with_faces(mesh.faces[piece == index]), int(share), on_part))
        on_part(1.0)
    return joined([part for part in parts if len(part.faces)])


def _shares(sizes: NDArray[np.int64], triangles: int) -> NDArray[np.int64]:
    """Faces that are left of pieces with so many: the same share, the least, or all there are.

    What the least takes is given by the pieces that keep most.
    """
    least = np.minimum(sizes, _LEAST_SHARE)
    even = np.floor(sizes * (triangles / sizes.sum())).astype(np.int64)
    shares: NDArray[np.int64] = np.maximum(even, least)
    for index in np.argsort(-shares, kind="stable"):
        shares[index] -= min(max(shares.sum() - triangles, 0), shares[index] - least[index])
    return shares


def _fewer(
    mesh: TriangleMesh, triangles: int, on_progress: Callable[[float], None]
) -> TriangleMesh:
    """One piece with so many triangles, its colours where they were."""
    origin = mesh.vertices.mean(axis=0)
    # The errors that pyfqmr allows, more with each round, are those of a mesh of size 1.
    size = float(np.linalg.norm(np.ptp(mesh.vertices, axis=0))) or 1.0
    local = (mesh.vertices - origin) / size
    if len(mesh.faces) < LARGE:
        vertices, faces = decimated(local, mesh.faces, triangles)
    else:
        given = {"vertices": local, "faces": mesh.faces, "triangles": triangles}
        usual_s = _USUAL_S * len(mesh.faces)
        made_apart = run_apart(decimation.__file__, given, usual_s, on_progress)
        vertices, faces = made_apart["vertices"], made_apart["faces"]
    made = TriangleMesh(
        vertices * size + origin, faces, _colors_at(mesh, local, vertices), np.zeros_like(vertices)
    )
    return from_open3d(to_open3d(made, origin), origin)


def _colors_at(mesh: TriangleMesh, local: Floats, points: Floats) -> Floats:
    """[P, 3] the colours of a mesh, its vertices at `local`, where it is nearest to points."""
    scene = _tensor_geometry.RaycastingScene()
    scene.add_triangles(
        _core.Tensor(np.ascontiguousarray(local, np.float32)),
        _core.Tensor(np.ascontiguousarray(mesh.faces, np.uint32)),
    )
    found = scene.compute_closest_points(_core.Tensor(points.astype(np.float32)))
    u, v = found["primitive_uvs"].numpy().astype(np.float64).T
    corners = mesh.colors[mesh.faces[found["primitive_ids"].numpy().astype(np.int64)]]
    weights = np.stack([1.0 - u - v, u, v], axis=1)
    colors: Floats = np.einsum("nk,nkc->nc", weights, corners)
    return colors


def _pieces(mesh: TriangleMesh) -> NDArray[np.int64]:
    """[F] the piece of each face, from 0: connected ones, and all small ones together."""
    corners = mesh.faces.reshape(-1)
    following = mesh.faces[:, [1, 2, 0]].reshape(-1)
    count = len(mesh.vertices)
    links = coo_array((np.ones(len(corners), np.int8), (corners, following)), (count, count))
    _, of_vertex = connected_components(links, directed=False)
    of_face = of_vertex[mesh.faces[:, 0]]
    small = np.bincount(of_face) < _LEAST_PIECE
    piece: NDArray[np.int64] = np.unique(
        np.where(small[of_face], -1, of_face), return_inverse=True
    )[1]
    return piece
