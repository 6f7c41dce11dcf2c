"""Plain table tops, whose bumps are larger than a voxel or two: nobody knew where they are.

Fusion's noise is a fraction of an edge of the mesh, and so `pipelines.exports.surface.flatness`
finds what is flat. A white table has no noise but guesses. So regions of one colour, of which the
photos know nothing, are looked at once more: whatever of them about faces as a plane that was found
(the floor, a wall) and keeps near one parallel to it, without being bent as a whole, is laid on it.

Symbols: V vertices.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from pipelines.exports.mesh import unit_normals
from pipelines.exports.surface.flatness import NOWHERE, FlatParts, edges_within, is_bent
from pipelines.exports.surface.rings import MeshRings

Floats = NDArray[np.float64]

_LOOK_ROUNDS, _NORMAL_ROUNDS = 4, 20
_ONE_COLOUR, _UNTOLD = 0.06, 0.3
_FACING = 0.7
_NEAR, _UNEVEN = 5.0, 1.0
"""Edges: what is farther from the plane does not belong to it, and the median distance of a region
that does. The juice box's table has 0.86; the fox's brow, plain to the same measure, 1.28."""
_LEAST_SHARE = 0.01
"""Of all vertices: where a mesh reaches far its area says little of what is near."""
_SAME = np.cos(np.radians(5.0))
_FIT_ROUNDS, _FIT_SCALE = 20, 1.5


def with_plain_parts(
    parts: FlatParts, vertices: Floats, rings: MeshRings, colors: Floats, trust: Floats
) -> FlatParts:
    """The flat parts of a mesh [V, 3], and its plain regions that are parallel to one of them.

    colors: [V, 3] in [0, 1]. trust: [V] in [0, 1], in what the photos say of each vertex.
    """
    plain = find_plain(rings, colors, trust, _ONE_COLOUR, _UNTOLD)
    facing = unit_normals(rings.spread(rings.normals(vertices), _NORMAL_ROUNDS))
    lengths = rings.scale(vertices)
    planes, plane_of = list(parts.planes), parts.plane_of.copy()
    for normal in _directions(parts.planes):
        free = (plane_of == NOWHERE) & plain & (np.abs(facing @ normal) > _FACING)
        for members in _regions(free, rings):
            plane, kept = _laid(vertices[members], lengths[members], normal)
            if plane is None:
                continue
            plane_of[members[kept]] = len(planes)
            planes.append(plane)
    return FlatParts(np.array(planes).reshape(-1, 4), plane_of)


def find_plain(
    rings: MeshRings, colors: Floats, trust: Floats, one_colour: float, untold: float
) -> NDArray[np.bool_]:
    """[V]: where all around has one colour and the photos have no say.

    colors: [V, 3] in [0, 1]. trust: [V] in [0, 1], in what the photos say of each vertex. Both
    limits are what stays below: the spread of the colours, and the mean trust.
    """
    mean = rings.spread(colors, _LOOK_ROUNDS)
    variance = (rings.spread(colors**2, _LOOK_ROUNDS) - mean**2).sum(axis=1)
    told = rings.spread(trust[:, None], _LOOK_ROUNDS)[:, 0]
    plain: NDArray[np.bool_] = (variance < one_colour**2) & (told < untold)
    return plain


def _directions(planes: Floats) -> list[Floats]:
    """The normals of planes [P, 4], each direction once."""
    found: list[Floats] = []
    for plane in planes:
        if all(abs(float(plane[:3] @ other)) < _SAME for other in found):
            found.append(plane[:3])
    return found


def _regions(free: NDArray[np.bool_], rings: MeshRings) -> list[NDArray[np.intp]]:
    """The connected vertices among some [V], where they are enough."""
    marked = np.where(free, 0, NOWHERE).astype(np.intp)
    _, region_of = connected_components(edges_within(marked, rings), directed=False)
    counts = np.bincount(region_of[free], minlength=int(region_of.max()) + 1)
    large = np.flatnonzero(counts >= _LEAST_SHARE * len(free))
    return [np.flatnonzero(free & (region_of == index)) for index in large]


def _laid(
    points: Floats, lengths: Floats, normal: Floats
) -> tuple[Floats | None, NDArray[np.bool_]]:
    """The plane [4] that a region [K, 3] lies near, and what of it does; None where none does."""
    heights = points @ normal
    level = float(np.median(heights))
    for _ in range(_FIT_ROUNDS):
        far = (heights - level) / (_FIT_SCALE * lengths)
        weights = 1.0 / (lengths**2 * (1.0 + far**2))
        level = float(weights @ heights / weights.sum())
    away = np.abs(heights - level) / lengths
    kept: NDArray[np.bool_] = away < _NEAR
    plane = np.append(normal, level)
    even = kept.any() and float(np.median(away[kept])) < _UNEVEN
    if not even or is_bent(plane, points[kept], lengths[kept]):
        return None, kept
    return plane, kept
