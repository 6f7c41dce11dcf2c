"""The open borders of a mesh: closed loops of edges that have one face.

Symbols: F faces, H = 3 F half-edges: of face f, half-edge 3 f + k goes from its corner k to the
next one.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Ints = NDArray[np.int64]

_BORDER, _KNOTTED = -1, -2


@dataclass(frozen=True)
class Loop:
    """A border in the order in which faces that close it have their edges, no vertex twice.

    vertices: [L]. faces: [L], the face at the edge from each vertex to the next.
    """

    vertices: Ints
    faces: Ints


def border_loops(faces: NDArray[np.integer]) -> list[Loop]:
    """The loops of the borders of faces [F, 3], those with the least vertex first.

    A border that meets itself at a vertex is several loops, parted there. Borders that reach an
    edge of more than two faces, or of two that face opposite ways, are left out.
    """
    if len(faces) == 0:
        return []
    starts = faces.reshape(-1).astype(np.int64)
    ends = faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
    twins = _twins(starts, ends)
    border = np.flatnonzero(twins == _BORDER)
    # Around the vertex at its end, from face to face, to the border on the other side of the fan.
    reached = _next_in_face(border)
    while True:
        inside = twins[reached] >= 0
        if not inside.any():
            break
        reached[inside] = _next_in_face(twins[reached[inside]])
    following = np.full(len(starts), _KNOTTED, np.int64)
    following[border] = np.where(twins[reached] == _BORDER, reached, _KNOTTED)
    from_vertex = starts.tolist()
    cycles = [part for way in _cycles(border, following) for part in _parted(way, from_vertex)]
    # The half-edge of a face goes against those of the faces that close the hole.
    loops = [Loop(ends[cycle[::-1]], cycle[::-1] // 3) for cycle in map(np.asarray, cycles)]
    return sorted(loops, key=lambda loop: (int(loop.vertices.min()), len(loop.vertices)))


def knotted_edges(faces: NDArray[np.integer]) -> NDArray[np.bool_]:
    """[H], whether an edge has more than two faces, or two that face opposite ways."""
    starts = faces.reshape(-1).astype(np.int64)
    ends = faces[:, [1, 2, 0]].reshape(-1).astype(np.int64)
    knotted: NDArray[np.bool_] = _twins(starts, ends) == _KNOTTED
    return knotted


def _next_in_face(half_edges: Ints) -> Ints:
    return half_edges - half_edges % 3 + (half_edges + 1) % 3


def _twins(starts: Ints, ends: Ints) -> Ints:
    """[H], the half-edge on the other side, or what there is in its place."""
    count = int(max(starts.max(), ends.max())) + 1
    keys, back = starts * count + ends, ends * count + starts
    order = np.argsort(keys, kind="stable")
    known = keys[order]
    first = np.searchsorted(known, back, "left")
    found = np.searchsorted(known, back, "right") - first
    own = np.searchsorted(known, keys, "right") - np.searchsorted(known, keys, "left")
    twins = np.where(found == 1, order[np.minimum(first, len(order) - 1)], _BORDER)
    twins[(own > 1) | (found > 1)] = _KNOTTED
    return twins


def _cycles(border: Ints, following: Ints) -> list[list[int]]:
    """The half-edges of each closed way."""
    after, free = following.tolist(), set(border.tolist())
    cycles = []
    for first in border.tolist():
        if first not in free:
            continue
        way, here = [], first
        while here in free:
            free.discard(here)
            way.append(here)
            here = after[here]
        if here == first:
            cycles.append(way)
    return cycles


def _parted(cycle: list[int], starts: list[int]) -> list[list[int]]:
    """A way cut where it comes to a vertex again, so that no part does."""
    parts: list[list[int]] = []
    way: list[int] = []
    place: dict[int, int] = {}
    for half_edge in cycle:
        vertex = starts[half_edge]
        if vertex in place:
            begin = place[vertex]
            parts.append(way[begin:])
            for gone in way[begin:]:
                del place[starts[gone]]
            del way[begin:]
        place[vertex] = len(way)
        way.append(half_edge)
    parts.append(way)
    return parts
