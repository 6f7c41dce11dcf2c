"""What carries things, out of a surface in cells: tables, the ground, walls that things hang on.

A plane is sought by votes of the cells' own planes, weighted by area and by how much cameras looked
there, and fitted to the cells that lie on it. Cameras stand before a wall and above what is level:
its normal points to them. Lengths in world units, +Z up.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

CELLS = 40
"""To the distance between cameras and what they look at."""
_NEAR_SHARE = 0.02
"""So near a plane, in distances, is on it."""
_ALIKE = 0.85
_LEVEL = np.cos(np.radians(25.0))
_UPRIGHT = np.sin(np.radians(25.0))
_TRIALS, _ROUNDS, _MOST_PLANES = 300, 4, 6
_LEAST_AREA = 0.05
"""Of all that was looked at, for a plane to count."""
_ABOVE = 0.02
"""Of all that was looked at, that a level plane must carry."""
_BEHIND = 0.05
"""Of all, what may lie behind a wall."""
_REACH = 0.6
"""How far the outer tenth of a wall is from the focus at least, in distances: a thing's own face
does not reach so far."""


@dataclass(frozen=True)
class Cells:
    """A surface in cubes around a focus. places: [C, 3] the middle of what is in each. normals:
    [C, 3] unit, outward. areas: [C]. side: of the cubes. reach: [C], from the focus."""

    places: Floats
    normals: Floats
    areas: Floats
    side: float
    reach: Floats

    def __len__(self) -> int:
        return len(self.places)


def cells_of(
    vertices: Floats, faces: NDArray[np.integer[Any]], focus: Floats, distance: float
) -> Cells:
    """The surface within `distance` of the focus, in cells."""
    corners = vertices[faces]
    middles = corners.mean(axis=1)
    near = np.linalg.norm(middles - focus, axis=1) < distance
    corners, middles = corners[near], middles[near]
    crossed = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]) / 2.0
    areas = np.linalg.norm(crossed, axis=1)
    side = distance / CELLS
    keys = np.floor((middles - focus) / side).astype(np.int64)
    cells, member = np.unique(keys, axis=0, return_inverse=True)
    member = member.reshape(-1)

    def total(values: Floats) -> Floats:
        columns = [np.bincount(member, values[:, axis], len(cells)) for axis in range(3)]
        return np.stack(columns, axis=1).astype(np.float64)  # of nothing, bincount gives integers

    summed: Floats = np.bincount(member, areas, len(cells)).astype(np.float64)
    kept = summed > 0.0
    places = total(areas[:, None] * middles)[kept] / summed[kept, None]
    normals = total(crossed)[kept]
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-300)
    reach = np.linalg.norm(places - focus, axis=1)
    return Cells(places, normals, summed[kept], side, reach)


@dataclass(frozen=True)
class Plane:
    """normal @ x = offset. normal: [3] unit, to the cameras' side. share: of all that was looked
    at, what lies on it."""

    normal: Floats
    offset: float
    share: float

    @property
    def is_level(self) -> bool:
        """Whether things stand on it, by gravity."""
        return bool(self.normal[2] > _LEVEL)

    def height(self, points: Floats) -> Floats:
        """[P] how far points [P, 3] are before it."""
        above: Floats = points @ self.normal - self.offset
        return above

    def axes(self) -> Floats:
        """[3, 2], two directions in it at right angles."""
        first = np.cross(self.normal, np.eye(3)[int(np.abs(self.normal).argmin())])
        first /= np.linalg.norm(first)
        return np.stack([first, np.cross(self.normal, first)], axis=1)

    def level_at(self, point: Floats) -> float:
        """The height +Z of a level plane above or below a point."""
        return float((self.offset - self.normal[:2] @ point[:2]) / self.normal[2])

    def told(self) -> dict[str, Any]:
        """For the report."""
        return {
            "normal": [round(float(value), 4) for value in self.normal],
            "offset": round(self.offset, 6),
            "share": round(self.share, 3),
        }


@dataclass(frozen=True)
class Planes:
    """carrier: what things stand on or hang at, None where nothing was found. walls: others behind
    things, that are not part of them."""

    carrier: Plane | None
    walls: Sequence[Plane]


def planes_of(cells: Cells, attention: Floats, eyes: Floats, distance: float) -> Planes:
    """attention: [C], how much cameras looked there. eyes: [N, 3], the cameras' places."""
    weights = cells.areas * attention**2
    total = float(weights.sum())
    found: list[Plane] = []
    left = np.ones(len(cells), bool)
    near = _NEAR_SHARE * distance
    chance = np.random.default_rng(0)
    while total > 0.0 and len(found) < _MOST_PLANES and weights[left].sum() > _LEAST_AREA * total:
        plane, on = _largest(cells, np.where(left, weights, 0.0), near, chance)
        share = float(weights[on].sum()) / total
        if share < _LEAST_AREA:
            break
        if np.median(plane.height(eyes)) > 0.0:
            found.append(replace(plane, share=share))
        left &= ~on
    return Planes(*_roles(found, cells, weights / max(total, 1e-300), distance))


def _largest(
    cells: Cells, weights: Floats, near: float, chance: np.random.Generator
) -> tuple[Plane, Bools]:
    """The plane with the most weight on it, and what lies there."""
    picked = chance.choice(len(cells), _TRIALS, p=weights / weights.sum())
    normals = cells.normals[picked]
    offsets = (normals * cells.places[picked]).sum(axis=1)
    votes = np.zeros(_TRIALS)
    for index in range(_TRIALS):
        on = _on(cells, normals[index], offsets[index], near)
        votes[index] = weights[on].sum()
    best = int(votes.argmax())
    normal, offset = normals[best], float(offsets[best])
    on = _on(cells, normal, offset, near)
    for _ in range(_ROUNDS):
        w = weights * on
        if (w > 0).sum() < 3:
            break
        middle = (w[:, None] * cells.places).sum(axis=0) / w.sum()
        away = cells.places - middle
        _, vectors = np.linalg.eigh((w[:, None] * away).T @ away)
        normal = vectors[:, 0] * np.sign(vectors[:, 0] @ normal or 1.0)
        offset = float(normal @ middle)
        on = _on(cells, normal, offset, near)
    return Plane(normal, offset, 0.0), on & (weights > 0.0)


def _on(cells: Cells, normal: Floats, offset: float, near: float) -> Bools:
    on: Bools = (np.abs(cells.places @ normal - offset) < near) & (cells.normals @ normal > _ALIKE)
    return on


def _roles(
    found: Sequence[Plane], cells: Cells, shares: Floats, distance: float
) -> tuple[Plane | None, list[Plane]]:
    """Which plane carries things, and which are walls behind them."""
    near = _NEAR_SHARE * distance
    levels = [
        plane
        for plane in found
        if plane.is_level and shares[plane.height(cells.places) > 2.0 * near].sum() > _ABOVE
    ]
    walls = []
    for plane in found:
        if abs(plane.normal[2]) > _UPRIGHT:
            continue
        height = plane.height(cells.places)
        on = np.abs(height) < near
        wide = np.percentile(cells.reach[on], 90) > _REACH * distance
        if wide and shares[height < -2.0 * near].sum() < _BEHIND:
            walls.append(plane)
    if levels:
        return max(levels, key=lambda plane: plane.share), walls
    if not walls:
        return None, []
    carrier = max(walls, key=lambda plane: plane.share)
    return carrier, [wall for wall in walls if wall is not carrier]


def patch_under(plane: Plane, cells: Cells, thing: Floats, near_cells: float = 1.5) -> Bools:
    """[C], what lies on a plane in one piece with what is below the cells [T, 3] of a thing."""
    axes = plane.axes()
    on = np.abs(plane.height(cells.places)) < near_cells * cells.side
    flat, below = cells.places @ axes, thing @ axes
    low = np.minimum(flat.min(axis=0), below.min(axis=0)) - cells.side
    high = np.maximum(flat.max(axis=0), below.max(axis=0)) + cells.side
    taken = np.zeros(np.ceil((high - low) / cells.side).astype(int) + 1, bool)
    squares = np.floor((flat - low) / cells.side).astype(int)
    taken[tuple(squares[on].T)] = True
    taken[tuple(np.floor((below - low) / cells.side).astype(int).T)] = True
    label, count = ndimage.label(ndimage.binary_dilation(taken, np.ones((3, 3))), np.ones((3, 3)))
    mine = np.zeros(count + 1, bool)
    mine[label[tuple(np.floor((below - low) / cells.side).astype(int).T)]] = True
    held: Bools = on & mine[label[tuple(squares.T)]]
    return held
