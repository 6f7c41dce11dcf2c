"""A textured surface cut into charts: connected faces that one photo colours, laid out as it shows
them; and their places in one square picture.

A chart's patch is a piece of its photo, so that nothing is resampled but where the picture has no
room. Faces that no photo shows get a cell of their own, for a gradient of their corners' colours.
Symbols: F faces, U corners (a vertex, once for each chart it is in), C charts.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from pipelines.exports.texture.choice import NOBODY, neighbours_of

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

CELL_PX = 4
"""Side of the cell of a face that no photo shows."""
MARGIN_PX = 3
"""What a patch shows of its photo around its faces, so that smaller copies of the texture do not
mix in what lies beside it."""
_SHRINK = 0.93
_LEAST_SCALE = 0.02


class TextureFull(ValueError):
    """More faces than the largest picture has room for."""


@dataclass(frozen=True)
class Charts:
    """faces: [F, 3], corners. vertex: [U], the mesh's vertex of each corner. chart: [U].

    photo: [C], NOBODY for charts of one face that no photo shows. place: [U, 2], px in the photo.
    face_chart: [F].
    """

    faces: Ints
    vertex: Ints
    chart: Ints
    photo: Ints
    place: Floats
    face_chart: Ints


def cut(faces: Ints, choice: Ints, places_of: Callable[[int, Ints], Floats]) -> Charts:
    """Cut along the borders between photos.

    choice: [F], the photo of each face. places_of: where a photo shows some vertices, px.
    """
    face_chart, photo = pieces(neighbours_of(faces), choice)
    cut_faces, vertex, chart = corners_of(faces, face_chart)
    place = np.zeros((len(vertex), 2))
    by_photo = photo[chart]
    for index in np.unique(by_photo[by_photo != NOBODY]):
        mine = by_photo == index
        place[mine] = places_of(int(index), vertex[mine])
    return Charts(cut_faces, vertex, chart, photo, place, face_chart)


def corners_of(faces: Ints, face_chart: Ints) -> tuple[Ints, Ints, Ints]:
    """Faces [F, 3] of corners, and each corner's vertex [U] and chart [U].

    A vertex is one corner for each chart that it is in; corners are in the order of their charts.
    """
    count = int(faces.max()) + 1
    corners, flat = np.unique(
        face_chart[:, None].astype(np.int64) * count + faces, return_inverse=True
    )
    chart, vertex = np.divmod(corners, count)
    return flat.reshape(-1, 3).astype(np.int32), vertex.astype(np.int32), chart.astype(np.int32)


def pieces(across: Ints, choice: Ints) -> tuple[Ints, Ints]:
    """The chart of each face [F], and the choice of each chart [C]; `NOBODY`'s are of one face.

    across: [F, 3], as `neighbours_of` has it. choice: [F].
    """
    here = np.repeat(np.arange(len(across)), 3)
    there = across.reshape(-1)
    joined = (there >= 0) & (choice[here] == choice[there]) & (choice[here] != NOBODY)
    links = coo_array(
        (np.ones(joined.sum(), np.int8), (here[joined], there[joined])), (len(across), len(across))
    )
    count, piece = connected_components(links, directed=False)
    photo = np.full(count, NOBODY, np.int32)
    photo[piece] = choice
    return piece.astype(np.int32), photo


@dataclass(frozen=True)
class Layout:
    """Where things are in a square picture. side: of it, px.

    uv: [U, 2], px in the picture, from its top left corner. charts: [N], those with a photo.
    source: [N, 4] int, left, top, right, bottom in the photo. target: [N, 4], the same in the
    picture.
    """

    side: int
    uv: Floats
    charts: Ints
    source: Ints
    target: Ints


def lay_out(charts: Charts, size_of: Callable[[int], tuple[int, int]], largest_side: int) -> Layout:
    """Place all charts in the smallest square of a power of two that holds them, or make them fit.

    size_of: width and height of a photo. largest_side: px, a power of two. Raises TextureFull.
    """
    shown = np.flatnonzero(charts.photo != NOBODY).astype(np.int32)
    source = _boxes(charts, shown, size_of)
    cells = np.flatnonzero(charts.photo == NOBODY)
    size = (source[:, 2:] - source[:, :2]).astype(np.float64)
    side = 256
    while side < largest_side and not _fits(size, 1.0, len(cells), side):
        side *= 2
    scale = 1.0
    while (packed := _packed(size, scale, len(cells), side)) is None:
        scale *= _SHRINK
        if scale < _LEAST_SCALE:
            raise TextureFull(f"{len(charts.face_chart)} faces do not fit into {side} px")
    target, cells_top = packed
    uv = np.zeros_like(charts.place)
    row = np.full(len(charts.photo), -1)
    row[shown] = np.arange(len(shown))
    mine = row[charts.chart]
    by_photo = mine >= 0
    mine = mine[by_photo]
    grown = (target[mine, 2:] - target[mine, :2]) / (source[mine, 2:] - source[mine, :2])
    uv[by_photo] = target[mine, :2] + (charts.place[by_photo] - source[mine, :2]) * grown
    _place_cells(charts, cells, cells_top, side, uv)
    return Layout(side, uv, shown, source, target)


def _boxes(charts: Charts, shown: Ints, size_of: Callable[[int], tuple[int, int]]) -> Ints:
    """The pieces of photos that charts need, [N, 4]."""
    count = len(charts.photo)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, charts.chart, charts.place)
    np.maximum.at(high, charts.chart, charts.place)
    sizes = np.array([size_of(int(photo)) for photo in charts.photo[shown]]).reshape(-1, 2)
    start = np.maximum(np.floor(low[shown]) - MARGIN_PX, 0)
    end = np.minimum(np.ceil(high[shown]) + MARGIN_PX, sizes)
    boxes: Ints = np.concatenate([start, end], axis=1).astype(np.int32)
    return boxes


def _cell_rows(num_cells: int, side: int) -> int:
    """Height in px that cells take up."""
    return -(-num_cells // (side // CELL_PX)) * CELL_PX


def _fits(size: Floats, scale: float, num_cells: int, side: int) -> bool:
    return _packed(size, scale, num_cells, side) is not None


def _packed(size: Floats, scale: float, num_cells: int, side: int) -> tuple[Ints, int] | None:
    """The rectangles on shelves, the tallest first, and the row where cells begin; None if full.

    size: [N, 2]. Returns targets [N, 4].
    """
    grown = np.maximum(np.ceil(size * scale), 1).astype(np.int64)
    room = side - _cell_rows(num_cells, side)
    if room < 0 or (grown[:, 0] > side).any() or grown.prod(axis=1).sum() > side * room:
        return None
    target = np.zeros((len(size), 4), np.int32)
    x = y = height = 0
    for index in np.argsort(-grown[:, 1], kind="stable"):
        w, h = int(grown[index, 0]), int(grown[index, 1])
        if x + w > side:
            x, y, height = 0, y + height, 0
        height = max(height, h)
        if y + height > room:
            return None
        target[index] = x, y, x + w, y + h
        x += w
    return target, y + height


def shelves(size: Floats, side: int) -> Ints | None:
    """Places of rectangles [N, 2] in a square, as left, top, right, bottom [N, 4]; None if full."""
    packed = _packed(size, 1.0, 0, side)
    return None if packed is None else packed[0]


def _place_cells(charts: Charts, cells: NDArray[np.intp], top: int, side: int, uv: Floats) -> None:
    """Corners of faces without a photo, at the centres of texels of their cells."""
    order = np.full(len(charts.photo), -1)
    order[cells] = np.arange(len(cells))
    number = order[charts.face_chart]
    alone = number >= 0
    number = number[alone]
    per_row = side // CELL_PX
    left, row = CELL_PX * (number % per_row), top + CELL_PX * (number // per_row)
    for corner, (dx, dy) in enumerate(((0.5, 0.5), (3.5, 0.5), (0.5, 3.5))):
        uv[charts.faces[alone, corner]] = np.stack([left + dx, row + dy], axis=-1)
