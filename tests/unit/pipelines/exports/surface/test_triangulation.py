"""Loops closed with as few triangles as there can be."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.surface.triangulation import in_plane, least_area

Floats = NDArray[np.float64]


def loop_of(flat: Floats) -> Floats:
    return np.concatenate([flat, np.zeros((len(flat), 1))], axis=1)


def star(count: int = 24, depth: float = 0.5) -> Floats:
    """[count, 2], counter-clockwise."""
    turn = 2.0 * np.pi * np.arange(count) / count
    far = np.where(np.arange(count) % 2 == 0, 1.0, depth)
    return np.stack([far * np.cos(turn), far * np.sin(turn)], axis=1)


def areas(points: Floats, faces: NDArray[np.int64]) -> Floats:
    corners = points[faces]
    return 0.5 * np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def all_ways(low: int, high: int) -> list[list[tuple[int, int, int]]]:
    """Every triangulation of the polygon of the vertices from low to high."""
    if high - low < 2:
        return [[]]
    return [
        [(low, between, high), *left, *right]
        for between in range(low + 1, high)
        for left in all_ways(low, between)
        for right in all_ways(between, high)
    ]


@pytest.mark.parametrize("count", [3, 4, 5, 7])
def test_no_other_way_has_less_area(count: int) -> None:
    points = np.random.default_rng(count).normal(size=(count, 3))
    found = least_area(points, np.zeros((count, count), np.bool_))
    assert found is not None

    def cost(faces: NDArray[np.int64]) -> float:
        return float(np.linalg.norm(areas(points, faces), axis=1).sum())

    best = min(cost(np.array(way)) for way in all_ways(0, count - 1))
    assert cost(found) == pytest.approx(best)
    assert found.shape == (count - 2, 3)


def test_a_star_is_filled_and_nothing_beside_it() -> None:
    points = loop_of(star())
    found = least_area(points, np.zeros((24, 24), np.bool_))
    assert found is not None
    for faces in (found, in_plane(star())):
        tall = areas(points, faces)[:, 2]
        assert (tall > 0.0).all()
        x, y = star().T
        assert tall.sum() == pytest.approx(0.5 * (x * np.roll(y, -1) - np.roll(x, -1) * y).sum())


def test_edges_that_are_there_are_not_made_again() -> None:
    square = loop_of(np.array([[0.0, 0.0], [1.0, 0.0], [1.0, 1.0], [0.0, 1.0]]))
    taken = np.zeros((4, 4), np.bool_)
    taken[0, 2] = taken[2, 0] = True
    faces = least_area(square, taken)
    assert faces is not None
    assert all({1, 3} <= set(face) for face in faces.tolist())
    taken[1, 3] = taken[3, 1] = True
    assert least_area(square, taken) is None


def test_a_plane_loop_is_cut_whichever_way_it_turns() -> None:
    flat = star(40, 0.3)
    for loop in (flat, flat[::-1]):
        faces = in_plane(loop)
        assert len(faces) == 38
        tall = areas(loop_of(loop), faces)[:, 2]
        assert (np.sign(tall) == np.sign(tall[0])).all()
    crossed = np.array([[0.0, 0.0], [1.0, 1.0], [1.0, 0.0], [0.0, 1.0]])
    assert len(in_plane(crossed)) == 2
