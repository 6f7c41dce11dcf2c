"""Loops of vertices closed with triangles: as few as there can be, or in a plane.

Symbols: L vertices of a loop; faces are counted in places along it, and turn as it does.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ints = NDArray[np.int64]
Bools = NDArray[np.bool_]


def least_area(points: Floats, taken: Bools) -> Ints | None:
    """The L - 2 faces [L - 2, 3] over a loop [L, 3] with the least area in all.

    taken: [L, L], pairs of vertices that have an edge already, to which none is added. None where
    there are no such faces. Time: L^3.
    Source: Barequet and Sharir 1995.
    """
    count = len(points)
    cost = np.full((count, count), np.inf)
    split = np.full((count, count), -1, np.int64)
    following = np.arange(count - 1)
    cost[following, following + 1] = 0.0
    for gap in range(2, count):
        first = np.arange(count - gap)[:, None]
        last = first + gap
        middle = first + np.arange(1, gap)[None, :]
        across = np.cross(points[middle] - points[first], points[last] - points[first])
        area = 0.5 * np.linalg.norm(across, axis=2)
        total = cost[first, middle] + cost[middle, last] + area
        best = total.argmin(axis=1)
        rows, columns = first[:, 0], last[:, 0]
        free = ~taken[rows, columns] | (gap == count - 1)
        cost[rows, columns] = np.where(free, total[np.arange(len(rows)), best], np.inf)
        split[rows, columns] = rows + 1 + best
    if not np.isfinite(cost[0, count - 1]):
        return None
    faces, open_spans = [], [(0, count - 1)]
    while open_spans:
        low, high = open_spans.pop()
        if high - low < 2:
            continue
        between = int(split[low, high])
        faces.append((low, between, high))
        open_spans += [(low, between), (between, high)]
    return np.array(faces, np.int64)


def in_plane(flat: Floats) -> Ints:
    """Faces [L - 2, 3] over a loop in a plane [L, 2], by cutting off its ears.

    Where the loop crosses itself some faces turn the other way.
    """
    x, y = flat.T
    around = float((x * np.roll(y, -1) - np.roll(x, -1) * y).sum())
    turn = 1.0 if around >= 0.0 else -1.0
    ring = list(range(len(flat)))
    faces, place, refused = [], 0, 0
    while len(ring) > 3:
        place %= len(ring)
        corner = [ring[place - 1], ring[place], ring[(place + 1) % len(ring)]]
        if refused > len(ring) or _is_ear(flat, corner, ring, turn):
            faces.append(corner)
            del ring[place]
            place, refused = place - 1, 0
        else:
            place, refused = place + 1, refused + 1
    faces.append(ring)
    return np.array(faces, np.int64)


def _is_ear(flat: Floats, corner: list[int], ring: list[int], turn: float) -> bool:
    """Whether a corner juts out and holds no other vertex of the ring."""
    a, b, c = flat[corner]
    if turn * _side(a, b, c) <= 0.0:
        return False
    others = flat[ring]
    inside = np.ones(len(ring), np.bool_)
    for begin, end in ((a, b), (b, c), (c, a)):
        inside &= turn * _sides(begin, end, others) >= 0.0
    # The corner's own places, and others at the same.
    for own in (a, b, c):
        inside &= (others != own).any(axis=1)
    return not inside.any()


def _side(a: Floats, b: Floats, c: Floats) -> float:
    return float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0]))


def _sides(a: Floats, b: Floats, points: Floats) -> Floats:
    """[N], positive for points [N, 2] on the left of a line."""
    left: Floats = (b[0] - a[0]) * (points[:, 1] - a[1]) - (b[1] - a[1]) * (points[:, 0] - a[0])
    return left
