"""A textured surface cut into charts: connected faces that one photo colours, laid out as it shows
them; and their places in one picture.

A chart's patch is a piece of its photo, so that nothing is resampled but where the picture has no
room. Faces that no photo shows are charts too, unwrapped for a gradient of their corners' colours.
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
from pipelines.exports.texture.packing import Outlines, Packing, outlines_of, packed

Floats = NDArray[np.float64]
Ints = NDArray[np.int32]

MARGIN_PX = 3
"""What a patch shows of its photo around its faces, so that smaller copies of the texture do not
mix in what lies beside it."""


@dataclass(frozen=True)
class Charts:
    """faces: [F, 3], corners. vertex: [U], the mesh's vertex of each corner. chart: [U].

    photo: [C], NOBODY for charts that no photo shows, which come last. place: [U, 2], px in the
    photo; texels, of those that no photo shows. face_chart: [F].
    """

    faces: Ints
    vertex: Ints
    chart: Ints
    photo: Ints
    place: Floats
    face_chart: Ints


def cut(
    faces: Ints,
    choice: Ints,
    places_of: Callable[[int, Ints], Floats],
    flat_of: Callable[[Ints], tuple[Ints, Floats]],
) -> Charts:
    """Cut along the borders between photos.

    choice: [F], the photo of each face. places_of: where a photo shows some vertices, px. flat_of:
    of faces [N, 3] that no photo shows, their charts [N] and where the corners of these lie, texels
    [K, 2], in the order of `corners_of`.
    """
    shown = choice != NOBODY
    face_chart, photo = np.zeros(len(faces), np.int32), np.zeros(0, np.int32)
    if shown.any():
        face_chart[shown], photo = pieces(neighbours_of(faces[shown]), choice[shown])
    flat = np.zeros((0, 2))
    if not shown.all():
        own_chart, flat = flat_of(faces[~shown])
        face_chart[~shown] = len(photo) + own_chart
        photo = np.append(photo, np.full(own_chart.max() + 1, NOBODY)).astype(np.int32)
    cut_faces, vertex, chart = corners_of(faces, face_chart)
    place = np.zeros((len(vertex), 2))
    by_photo = photo[chart]
    place[by_photo == NOBODY] = flat
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
    """The chart of each face [F], and the choice of each chart [C]: connected faces of one choice.

    across: [F, 3], as `neighbours_of` has it. choice: [F].
    """
    here = np.repeat(np.arange(len(across)), 3)
    there = across.reshape(-1)
    joined = (there >= 0) & (choice[here] == choice[there])
    links = coo_array(
        (np.ones(joined.sum(), np.int8), (here[joined], there[joined])), (len(across), len(across))
    )
    count, piece = connected_components(links, directed=False)
    photo = np.zeros(count, np.int32)
    photo[piece] = choice
    return piece.astype(np.int32), photo


@dataclass(frozen=True)
class Layout:
    """Where things are in a picture.

    uv: [U, 2], px in the picture, from its top left corner. charts: [N], those with a photo.
    source: [N, 4] int, left, top, right, bottom in the photo. scaled: [N, 2] int, width and height
    that these have in the picture, before they are turned. packing: of all charts, which begin
    where their scaled sources do.
    """

    uv: Floats
    charts: Ints
    source: Ints
    scaled: Ints
    packing: Packing

    @property
    def size(self) -> tuple[int, int]:
        """Width and height of the picture, px."""
        return self.packing.size


def lay_out(
    charts: Charts,
    size_of: Callable[[int], tuple[int, int]],
    largest_side: int,
    poll: Callable[[], None] = lambda: None,
) -> Layout:
    """Place all charts in the smallest picture that holds them, or make them fit the largest.

    size_of: width and height of a photo. largest_side: px, a power of two. poll: called every
    second or so; may raise. Raises TextureFull.
    """
    shown = np.flatnonzero(charts.photo != NOBODY).astype(np.int32)

    def outlines_at(scale: float) -> Outlines:
        place = _scaled(charts, shown, size_of, scale)[2]
        return outlines_of(place, charts.faces, charts.chart, MARGIN_PX)

    scale, packing = packed(outlines_at, largest_side, poll)
    source, scaled, place = _scaled(charts, shown, size_of, scale)
    return Layout(packing.moved(place, charts.chart), shown, source, scaled, packing)


def _scaled(
    charts: Charts, shown: Ints, size_of: Callable[[int], tuple[int, int]], scale: float
) -> tuple[Ints, Ints, Floats]:
    """The pieces of photos that charts need [N, 4], what size they get [N, 2], and the places of
    all corners [U, 2], texels from the left top of these."""
    source = _boxes(charts, shown, size_of, MARGIN_PX / scale)
    size = source[:, 2:] - source[:, :2]
    scaled = np.maximum(np.ceil(size * scale), 1).astype(np.int32)
    begin = np.zeros((len(charts.photo), 2))
    grown = np.full((len(charts.photo), 2), scale)
    begin[shown], grown[shown] = source[:, :2], scaled / size
    return source, scaled, (charts.place - begin[charts.chart]) * grown[charts.chart]


def _boxes(
    charts: Charts, shown: Ints, size_of: Callable[[int], tuple[int, int]], margin: float
) -> Ints:
    """The pieces of photos that charts need, [N, 4]."""
    count = len(charts.photo)
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, charts.chart, charts.place)
    np.maximum.at(high, charts.chart, charts.place)
    sizes = np.array([size_of(int(photo)) for photo in charts.photo[shown]]).reshape(-1, 2)
    start = np.maximum(np.floor(low[shown] - margin), 0)
    end = np.minimum(np.ceil(high[shown] + margin), sizes)
    boxes: Ints = np.concatenate([start, end], axis=1).astype(np.int32)
    return boxes
