"""Charts and their places in the picture."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.texture.charts import CELL_PX, Charts, TextureFull, cut, lay_out
from pipelines.exports.texture.choice import NOBODY


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


def test_charts_are_connected_faces_of_one_photo() -> None:
    places, faces = grid(8)
    middle = places[faces].mean(axis=1)
    choice = np.where(middle[:, 0] < 3, 0, np.where(middle[:, 0] < 5, 1, 0)).astype(np.int32)
    choice[0] = NOBODY
    charts = cut(faces, choice, lambda photo, which: 10.0 * places[which] + 100.0 * photo)
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
    return cut(faces, choice, lambda photo, which: 12.0 * places[which] + 20.0)


@pytest.mark.parametrize("largest", [4096, 512])
def test_patches_do_not_overlap_and_hold_their_faces(largest: int) -> None:
    charts = many_charts()
    layout = lay_out(charts, lambda photo: (520, 520), largest)
    assert layout.side <= largest
    used = np.zeros((layout.side, layout.side), int)
    for left, top, right, bottom in layout.target.tolist():
        assert 0 <= left < right <= layout.side
        assert 0 <= top < bottom <= layout.side
        used[top:bottom, left:right] += 1
    alone = charts.photo[charts.face_chart] == NOBODY
    cells = np.floor(layout.uv[charts.faces[alone, 0]]).astype(int)
    for left, top in cells.tolist():
        used[top : top + CELL_PX, left : left + CELL_PX] += 1
    assert used.max() == 1
    row = np.full(len(charts.photo), -1)
    row[layout.charts] = np.arange(len(layout.charts))
    shown = row[charts.chart] >= 0
    boxes = layout.target[row[charts.chart[shown]]]
    assert (layout.uv[shown] >= boxes[:, :2]).all()
    assert (layout.uv[shown] <= boxes[:, 2:]).all()


def test_with_room_enough_pixels_are_copied_as_they_are() -> None:
    charts = many_charts()
    layout = lay_out(charts, lambda photo: (520, 520), 8192)
    size = layout.source[:, 2:] - layout.source[:, :2]
    assert np.array_equal(layout.target[:, 2:] - layout.target[:, :2], size)


def test_what_can_never_fit_is_refused() -> None:
    places, faces = grid(100)
    choice = np.full(len(faces), NOBODY, np.int32)
    charts = cut(faces, choice, lambda photo, which: places[which])
    with pytest.raises(TextureFull, match="do not fit into 256 px"):
        lay_out(charts, lambda photo: (10, 10), 256)
