"""The open borders of meshes as loops."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.exports.surface.borders import border_loops, knotted_edges
from tests.unit.pipelines.exports.surface.torn import SIDE, ball, sheet, within


def test_a_closed_surface_has_none_and_a_sheet_its_rim() -> None:
    assert border_loops(ball(within(0.0)).faces) == []
    (rim,) = border_loops(sheet(within(0.0), num=10).faces)
    assert len(rim.vertices) == len(set(rim.vertices.tolist())) == 40
    assert border_loops(np.zeros((0, 3), np.int32)) == []


@pytest.mark.parametrize("radius", [0.15, 0.6])
def test_a_loop_goes_as_the_faces_that_close_it_do(radius: float) -> None:
    mesh = sheet(within(radius))
    outer, hole = sorted(border_loops(mesh.faces), key=lambda loop: -len(loop.vertices))
    for loop, sign in ((outer, -1.0), (hole, 1.0)):
        x, y, _ = mesh.vertices[loop.vertices].T
        area = 0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum()
        assert np.sign(area) == sign
        ends = np.roll(loop.vertices, -1)
        for face, one, two in zip(mesh.faces[loop.faces], loop.vertices, ends, strict=True):
            assert {int(one), int(two)} <= set(face.tolist())
    assert 0.5 * np.pi * radius**2 < area < 2.0 * np.pi * radius**2


def test_holes_that_touch_at_a_vertex_are_two_loops() -> None:
    def two_squares(points: np.ndarray) -> np.ndarray:
        x, y = points.T
        one = (np.abs(x - SIDE) < SIDE) & (np.abs(y - SIDE) < SIDE)
        other = (np.abs(x + SIDE) < SIDE) & (np.abs(y + SIDE) < SIDE)
        return np.asarray(one | other)

    loops = border_loops(sheet(two_squares).faces)
    assert sorted(len(loop.vertices) for loop in loops) == [8, 8, 120]
    shared = set(loops[0].vertices.tolist()) | set(loops[1].vertices.tolist())
    assert len(shared) in (15, 8 + 120)


def test_a_loop_at_an_edge_of_three_faces_is_left_out() -> None:
    mesh = sheet(within(0.25), num=20)
    hole = min(border_loops(mesh.faces), key=lambda loop: len(loop.vertices))
    fin = [hole.vertices[1], hole.vertices[0], len(mesh.vertices)]
    faces = np.concatenate([mesh.faces, [fin], [[fin[0], fin[1], fin[2] + 1]]])
    assert knotted_edges(faces).sum() == 3
    assert not knotted_edges(mesh.faces).any()
    loops = border_loops(faces)
    assert all(len(loop.vertices) == 80 for loop in loops), "the fins' and the hole's are not"
