"""Charts and their places in the picture."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from pipelines.exports.texture.charts import MARGIN_PX, Charts, corners_of, cut, lay_out, pieces
from pipelines.exports.texture.choice import NOBODY, neighbours_of
from pipelines.exports.texture.packing import TextureFull


def grid(side: int) -> tuple[np.ndarray, np.ndarray]:
    """A flat square of triangles: vertices [V, 2] one apart, and faces."""
    i, j = np.meshgrid(np.arange(side), np.arange(side), indexing="ij")
    first = (i * (side + 1) + j).reshape(-1)
    faces = np.concatenate(
        [
            np.stack([first, first + side + 1, first + 1], axis=1),
            np.stack([first + 1, first + side + 1, first + side + 2], axis=1),
        ]
    ).astype(np.int32)
    rows, columns = np.divmod(np.arange((side + 1) ** 2), side + 1)
    return np.stack([columns, rows], axis=1).astype(float), faces


def side_by_side(places: np.ndarray) -> Callable[[np.ndarray], tuple[np.ndarray, np.ndarray]]:
    """Lay faces that no photo shows flat as they lie in a plane [V, 2]."""

    def flat(faces: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        chart, _ = pieces(neighbours_of(faces), np.zeros(len(faces), np.int32))
        _, vertex, _ = corners_of(faces, chart)
        return chart, 2.0 * places[vertex]

    return flat


def test_charts_are_connected_faces_of_one_photo() -> None:
    places, faces = grid(8)
    middle = places[faces].mean(axis=1)
    choice = np.where(middle[:, 0] < 3, 0, np.where(middle[:, 0] < 5, 1, 0)).astype(np.int32)
    choice[[0, 64]] = NOBODY
    charts = cut(
        *(faces, choice, lambda photo, which: 10.0 * places[which] + 100.0 * photo),
        side_by_side(places),
    )
    assert sorted(charts.photo.tolist()) == [NOBODY, 0, 0, 1]
    assert np.array_equal(charts.vertex[charts.faces], faces)
    assert np.array_equal(charts.photo[charts.face_chart], choice)
    assert (charts.chart[charts.faces] == charts.face_chart[:, None]).all()
    known = charts.photo[charts.chart] != NOBODY
    wanted = 10.0 * places[charts.vertex] + 100.0 * charts.photo[charts.chart][:, None]
    assert np.array_equal(charts.place[known], wanted[known])


def many_charts() -> Charts:
    """Charts of many sizes, and faces that nobody shows."""
    places, faces = grid(40)
    rng = np.random.default_rng(0)
    blocks = rng.integers(0, 6, (8, 8))
    middle = (places[faces].mean(axis=1) / 5.0).astype(int)
    choice = blocks[middle[:, 1], middle[:, 0]].astype(np.int32)
    choice[rng.random(len(faces)) < 0.1] = NOBODY
    return cut(
        faces, choice, lambda photo, which: 12.0 * places[which] + 20.0, side_by_side(places)
    )


@pytest.mark.parametrize("largest", [4096, 512])
def test_charts_do_not_overlap_and_hold_their_faces_and_a_margin(largest: int) -> None:
    charts = many_charts()
    layout = lay_out(charts, lambda photo: (520, 520), largest)
    width, height = layout.size
    assert max(layout.size) <= largest
    used = np.full((height, width), -1)
    for chart in range(len(charts.photo)):
        rows, columns = layout.packing.texels(chart)
        assert (used[rows, columns] == -1).all()
        used[rows, columns] = chart
    weights = np.random.default_rng(0).dirichlet(np.ones(3), size=(len(charts.faces), 8))
    inside = np.einsum("fkc,fcd->fkd", weights, layout.uv[charts.faces])
    reach = np.arange(-MARGIN_PX, MARGIN_PX + 1)
    for dx in reach:
        for dy in reach:
            columns, rows = np.floor(inside + np.array([dx, dy])).astype(int).transpose(2, 0, 1)
            assert (used[rows, columns] == charts.face_chart[:, None]).all()


def test_with_room_enough_pixels_are_copied_as_they_are() -> None:
    charts = many_charts()
    layout = lay_out(charts, lambda photo: (520, 520), 8192)
    size = layout.source[:, 2:] - layout.source[:, :2]
    assert np.array_equal(layout.scaled, size)
    shown = charts.photo[charts.face_chart] != NOBODY
    edges = [
        np.linalg.norm(np.diff(places[charts.faces[shown]], axis=1), axis=2)
        for places in (charts.place, layout.uv)
    ]
    assert np.allclose(*edges), "turned by a quarter at most, never stretched"
    assert max(layout.size) < 8192


def test_what_can_never_fit_is_refused() -> None:
    corners = 9.0 * np.arange(3000)[:, None] + [[0.0, 1.0, 0.0]]
    places = np.stack([corners, np.zeros_like(corners)], axis=2).reshape(-1, 2)
    places[::3, 1] = 1.0
    faces = np.arange(9000).reshape(-1, 3).astype(np.int32)
    choice = np.zeros(len(faces), np.int32)
    charts = cut(faces, choice, lambda photo, which: places[which], side_by_side(places))
    with pytest.raises(TextureFull, match="3000 charts do not fit into 256 px"):
        lay_out(charts, lambda photo: (27_010, 10), 256)
