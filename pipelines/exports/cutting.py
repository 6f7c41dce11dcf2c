"""A piece cut out of a delivered mesh: triangles end at the box's sides, the texture is its own.

Whole triangles would leave a saw's teeth; so those that cross a side of the box are cut there, with
what their new corners have of normals, colours or places in the texture. What of the texture is
left unused goes: charts are moved together, texel for texel, so that nothing is resampled.
"""

from __future__ import annotations

from dataclasses import replace
from typing import overload

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.exports.crop import Crop
from pipelines.exports.mesh import TexturedMesh, TriangleMesh
from pipelines.exports.subject import Thing
from pipelines.exports.texture.charts import MARGIN_PX
from pipelines.exports.texture.packing import outlines_of, smallest
from pipelines.exports.texture.texels import fill

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]
AnyMesh = TriangleMesh | TexturedMesh

_CRUMB = 0.01
_FLAT = 1e-12
"""Area of a triangle, in squares of the box's longest side, below which it is a line."""


@overload
def cut_out(mesh: TriangleMesh, thing: Thing) -> TriangleMesh: ...


@overload
def cut_out(mesh: TexturedMesh, thing: Thing) -> TexturedMesh: ...


def cut_out(mesh: AnyMesh, thing: Thing) -> AnyMesh:
    """A thing and what it stands on; may be without faces."""
    piece = clipped(mesh, thing.region)
    if thing.carried_by is not None:
        piece = _cut_at(piece, thing.carried_by.height(piece.vertices) + thing.slab)
    middles = piece.vertices[piece.faces].mean(axis=1)
    piece = without_crumbs(of_faces(piece, ~thing.is_other(middles)), _CRUMB)
    if isinstance(piece, TexturedMesh) and len(piece.faces):
        return with_own_texture(piece)
    return piece


def clipped(mesh: AnyMesh, box: Crop) -> AnyMesh:
    """What of a mesh is inside of an oriented box, cut off cleanly; may be without faces."""
    # Most of a mesh lies elsewhere: with all corners beyond one side it needs no cutting.
    beyond = ((mesh.vertices - box.center) @ box.axes)[mesh.faces]
    outside = np.logical_or((beyond > box.half).all(axis=1), (beyond < -box.half).all(axis=1))
    mesh = of_faces(mesh, ~np.any(outside, axis=1))
    for axis in range(3):
        for sign in (1.0, -1.0):
            inside = box.half[axis] - sign * ((mesh.vertices - box.center) @ box.axes[:, axis])
            mesh = _cut_at(mesh, inside)
    corners = mesh.vertices[mesh.faces]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    real = np.linalg.norm(crossed, axis=1) / 2.0 > _FLAT * float(box.half.max() * 2.0) ** 2
    return of_faces(mesh, real)


def of_faces(mesh: AnyMesh, kept: NDArray[np.bool_]) -> AnyMesh:
    """The faces [F] that are kept, with the vertices that they have."""
    used, flat = np.unique(mesh.faces[kept], return_inverse=True)
    return _with(mesh, _values(mesh)[used], flat.reshape(-1, 3).astype(np.int32))


def without_crumbs(mesh: AnyMesh, least_share: float) -> AnyMesh:
    """The mesh less loose pieces that have less than this share of its largest one's area."""
    if len(mesh.faces) == 0:
        return mesh
    # A vertex is there once for each of its places in a texture: pieces are found by place.
    _, place = np.unique(mesh.vertices, axis=0, return_inverse=True)
    piece = _pieces(place.reshape(-1)[mesh.faces])
    corners = mesh.vertices[mesh.faces]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.bincount(piece, np.linalg.norm(crossed, axis=1))
    return of_faces(mesh, (areas >= least_share * areas.max())[piece])


def with_own_texture(mesh: TexturedMesh) -> TexturedMesh:
    """The same look with a texture that holds what the mesh uses, if that is smaller."""
    height, width = mesh.texture.shape[:2]
    chart_of = np.zeros(len(mesh.vertices), np.int32)
    chart_of[mesh.faces.reshape(-1)] = np.repeat(_pieces(mesh.faces), 3)
    places = mesh.uv * (width, height)
    outlines = outlines_of(places, mesh.faces, chart_of, MARGIN_PX)
    packing = smallest(outlines, max(width, height), width * height - 1)
    if packing is None:
        return mesh
    texture = np.zeros((packing.size[1], packing.size[0], 3), np.uint8)
    known = np.zeros(texture.shape[:2], np.bool_)
    for chart in range(len(outlines.size)):
        known[packing.lay(chart, mesh.texture, texture)] = True
    fill(texture, known)
    uv = packing.moved(places, chart_of) / packing.size
    return replace(mesh, uv=uv, texture=texture)


def _values(mesh: AnyMesh) -> Floats:
    """[V, K], all that a vertex has: its place first."""
    if isinstance(mesh, TexturedMesh):
        return np.concatenate([mesh.vertices, mesh.normals, mesh.uv], axis=1)
    return np.concatenate([mesh.vertices, mesh.normals, mesh.colors], axis=1)


def _with(mesh: AnyMesh, values: Floats, faces: Ints) -> AnyMesh:
    """A mesh like another with other vertices, as `_values` gives them."""
    vertices, normals, rest = values[:, :3], values[:, 3:6], values[:, 6:]
    if isinstance(mesh, TexturedMesh):
        return TexturedMesh(vertices, faces, normals, rest, mesh.texture)
    return TriangleMesh(vertices, faces, rest, normals)


def _pieces(faces: NDArray[np.integer]) -> Ints:
    """The connected piece of each face, [F]."""
    count = int(faces.max()) + 1
    links = coo_array(
        (np.ones(2 * len(faces), np.int8), (faces[:, [0, 0]].T.ravel(), faces[:, 1:].T.ravel())),
        (count, count),
    )
    _, piece = connected_components(links, directed=False)
    _, numbered = np.unique(piece[faces[:, 0]], return_inverse=True)
    return numbered.reshape(-1).astype(np.int32)


def _cut_at(mesh: AnyMesh, inside: Floats) -> AnyMesh:
    """What of a mesh has `inside` [V] >= 0, which is linear over each face."""
    kept = inside >= 0.0
    corners = kept[mesh.faces]
    number = corners.sum(axis=1)
    if (number == 3).all():
        return mesh
    # Each crossing face is turned so that the corner that is alone on its side comes first.
    crossing = (number == 1) | (number == 2)
    faces, alone = mesh.faces[crossing], corners[crossing]
    first = np.where(number[crossing] == 1, alone.argmax(axis=1), (~alone).argmax(axis=1))
    faces = np.take_along_axis(faces, (first[:, None] + np.arange(3)) % 3, axis=1)
    single = number[crossing] == 1
    edges = np.sort(np.concatenate([faces[:, [0, 1]], faces[:, [0, 2]]]), axis=1)
    ends, which = np.unique(edges, axis=0, return_inverse=True)
    share = inside[ends[:, 0]] / (inside[ends[:, 0]] - inside[ends[:, 1]])
    values = _values(mesh)
    made = values[ends[:, 0]] + share[:, None] * (values[ends[:, 1]] - values[ends[:, 0]])
    ahead, behind = len(values) + which.reshape(2, -1)
    a, b, c = faces.T
    pieces = [
        mesh.faces[number == 3],
        np.stack([a, ahead, behind], axis=1)[single],
        np.stack([ahead, b, c], axis=1)[~single],
        np.stack([ahead, c, behind], axis=1)[~single],
    ]
    whole = np.concatenate(pieces).astype(np.int32)
    grown = _with(mesh, np.concatenate([values, made]), whole)
    return of_faces(grown, np.ones(len(whole), bool))
