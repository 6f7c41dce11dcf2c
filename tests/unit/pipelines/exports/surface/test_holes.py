"""Which holes are closed, and with what."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.errors import Cancelled
from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.surface.borders import border_loops, knotted_edges
from pipelines.exports.surface.holes import close_holes, diameter, hole_limits
from pipelines.exports.surface.shells import Shell
from pipelines.scene.bounds import SceneBounds
from tests.unit.pipelines.exports.surface.torn import (
    SIDE,
    ball,
    coloured,
    looking_down,
    num_open_edges,
    sheet,
    within,
)

Floats = NDArray[np.float64]


def limit(size: float) -> Callable[[Floats], Floats]:
    return lambda points: np.full(len(points), size)


def test_a_hole_in_a_ball_is_closed_as_the_ball_goes_on() -> None:
    torn = ball(lambda points: points[:, 2] > 0.93)
    closing = close_holes(torn, limit(1.0))
    mesh = closing.mesh
    assert (closing.closed, closing.left, num_open_edges(mesh.faces)) == (1, {}, 0)
    assert not knotted_edges(mesh.faces).any()
    old = len(torn.vertices)
    np.testing.assert_array_equal(mesh.vertices[:old], torn.vertices)
    np.testing.assert_array_equal(mesh.faces[: len(torn.faces)], torn.faces)
    radii = np.linalg.norm(mesh.vertices[old:], axis=1)
    # A flat lid would be 7 % too low in its middle.
    assert (np.abs(radii - 1.0) < 0.025).all()
    sides = mesh.vertices[mesh.faces] - mesh.vertices[np.roll(mesh.faces, -1, axis=1)]
    lengths = np.linalg.norm(sides, axis=2)
    usual = lengths[: len(torn.faces)].mean()
    assert lengths[len(torn.faces) :].max() < 1.8 * usual
    assert lengths[len(torn.faces) :].mean() == pytest.approx(usual, rel=0.25)
    outward = (mesh.normals * mesh.vertices).sum(axis=1) / np.linalg.norm(mesh.vertices, axis=1)
    assert (outward > 0.98).all()
    rim = border_loops(torn.faces)[0].vertices
    low, high = torn.colors[rim].min(axis=0), torn.colors[rim].max(axis=0)
    assert (mesh.colors[old:] > low - 1e-9).all()
    assert (mesh.colors[old:] < high + 1e-9).all()


def test_only_holes_of_the_stated_size_are_closed() -> None:
    def gone(points: Floats) -> NDArray[np.bool_]:
        small = np.linalg.norm(points - [0.8, 0.8], axis=1) < 0.2
        return np.asarray(small | (np.linalg.norm(points, axis=1) < 0.5))

    torn = sheet(gone)
    large, small = sorted(
        (
            diameter(torn.vertices[loop.vertices])
            for loop in border_loops(torn.faces)
            if len(loop.vertices) < 100
        ),
        reverse=True,
    )
    for size, closed in ((0.9 * small, 0), (1.1 * small, 1), (1.1 * large, 2)):
        closing = close_holes(torn, limit(size))
        assert closing.closed == closed
        assert len(border_loops(closing.mesh.faces)) == 3 - closed
    assert close_holes(torn, limit(0.0)).mesh is torn


def test_what_cameras_look_through_stays_open() -> None:
    torn = sheet(within(0.3))

    def ground(points: Floats) -> Floats:
        return np.full(points.shape[:2], 5.0)

    def cellar(points: Floats) -> Floats:
        return np.where(np.linalg.norm(points, axis=2) < 0.35, 7.0, 5.0)

    def sky(points: Floats) -> Floats:
        return np.where(np.linalg.norm(points, axis=2) < 0.35, 0.0, 5.0)

    def something_before(points: Floats) -> Floats:
        return np.full(points.shape[:2], 3.0)

    for depths, closed in ((ground, 1), (cellar, 0), (sky, 0), (something_before, 1)):
        closing = close_holes(torn, limit(1.0), looking_down(depths))
        assert closing.closed == closed, depths.__name__
        assert closing.left == ({} if closed else {"seen_through": 1})
    # One view errs: the others are believed.
    views = [*looking_down(ground, 3), *looking_down(cellar, 1)]
    assert close_holes(torn, limit(1.0), views).closed == 1
    views = [*looking_down(cellar, 3), *looking_down(ground, 1)]
    assert close_holes(torn, limit(1.0), views).closed == 0


def test_the_border_of_what_was_filmed_stays() -> None:
    small = sheet(within(0.0), num=6)
    closing = close_holes(small, limit(10.0))
    assert closing.mesh is small
    assert closing.left == {"outer": 1}
    cap = ball(lambda points: points[:, 2] < 0.5)
    assert close_holes(cap, limit(10.0)).left == {"outer": 1}


def test_the_end_of_a_pipe_stays_open() -> None:
    turn = 2.0 * np.pi * np.arange(16) / 16
    rings = [
        np.stack([0.2 * np.cos(turn), 0.2 * np.sin(turn), np.full(16, height)], axis=1)
        for height in np.linspace(0.0, 1.0, 11)
    ]
    at = np.arange(160)
    beside = at - at % 16 + (at + 1) % 16
    faces = np.concatenate(
        [np.stack([at, beside, at + 16], axis=1), np.stack([beside, beside + 16, at + 16], axis=1)]
    )
    pipe = coloured(np.concatenate(rings), faces)
    assert close_holes(pipe, limit(1.0)).left == {"outer": 2}


def test_a_hole_with_a_loose_piece_in_it_stays() -> None:
    torn, piece = sheet(within(0.5)), sheet(lambda points: ~within(0.2)(points))
    both = joined([torn, piece])
    closing = close_holes(both, limit(1.5))
    assert closing.mesh is both
    assert closing.left == {"outer": 1, "occupied": 1}
    below = replace(piece, vertices=piece.vertices - [0.0, 0.0, 0.5])
    assert close_holes(joined([torn, below]), limit(1.5)).closed == 1


def test_a_hole_that_something_passes_through_stays() -> None:
    torn = sheet(within(0.4))
    rod = sheet(within(0.0), num=4)
    upright = replace(rod, vertices=rod.vertices[:, [2, 0, 1]] + 0.05)
    closing = close_holes(joined([torn, upright]), limit(1.5))
    assert closing.closed == 0
    assert closing.left["occupied"] == 1


def test_holes_that_touch_are_both_closed() -> None:
    def two_squares(points: Floats) -> NDArray[np.bool_]:
        x, y = points.T
        one = (np.abs(x - 2 * SIDE) < 2 * SIDE) & (np.abs(y - 2 * SIDE) < 2 * SIDE)
        other = (np.abs(x + 2 * SIDE) < 2 * SIDE) & (np.abs(y + 2 * SIDE) < 2 * SIDE)
        return np.asarray(one | other)

    closing = close_holes(sheet(two_squares), limit(1.0))
    assert closing.closed == 2
    assert not knotted_edges(closing.mesh.faces).any()
    (rim,) = border_loops(closing.mesh.faces)
    assert len(rim.vertices) == 120
    assert np.abs(closing.mesh.vertices[:, 2]).max() < 1e-9


def test_a_rim_with_an_edge_of_three_faces_is_left_and_no_knot_is_made() -> None:
    torn = sheet(within(0.25))
    hole = min(border_loops(torn.faces), key=lambda loop: len(loop.vertices))
    ends = hole.vertices[:2]
    tips = torn.vertices[ends].mean(axis=0) + np.array([[0.0, 0.0, 0.1], [0.0, 0.0, -0.1]])
    count = len(torn.vertices)
    fins = np.array([[ends[1], ends[0], count], [ends[1], ends[0], count + 1]])
    mesh = coloured(np.concatenate([torn.vertices, tips]), np.concatenate([torn.faces, fins]))
    assert knotted_edges(mesh.faces).sum() == 3
    closing = close_holes(mesh, limit(1.0))
    assert closing.closed == 0
    assert knotted_edges(closing.mesh.faces).sum() == 3


def test_a_missing_triangle_is_put_back() -> None:
    whole = ball(within(0.0), 3)
    torn = TriangleMesh(whole.vertices, whole.faces[1:], whole.colors, whole.normals)
    closing = close_holes(torn, limit(1.0))
    assert closing.closed == 1
    assert sorted(closing.mesh.faces[-1].tolist()) == sorted(whole.faces[0].tolist())
    np.testing.assert_allclose(closing.mesh.normals, whole.normals, atol=1e-9)


def test_a_bent_and_noisy_rim_makes_no_bulge() -> None:
    noise = np.random.default_rng(5)
    torn = sheet(within(0.6))
    bumpy = torn.vertices + noise.normal(0.0, 0.1 * SIDE, torn.vertices.shape)
    closing = close_holes(replace(torn, vertices=bumpy), limit(2.0))
    assert closing.closed == 1
    assert np.abs(closing.mesh.vertices[len(bumpy) :, 2]).max() < 0.5 * SIDE


def test_far_away_holes_may_be_larger() -> None:
    def bounds(radius: float) -> SceneBounds:
        return SceneBounds(np.zeros(3), 2.0, radius, np.full(3, -radius), np.full(3, radius))

    shells = [Shell(bounds(2.0), 0.01), Shell(bounds(4.0), 0.02), Shell(bounds(12.0), 0.06, True)]
    limits = hole_limits(shells, 0.1, 2.0)(np.array([[1.0, 0, 0], [3.0, 0, 0], [9.0, 0, 0]]))
    np.testing.assert_allclose(limits, [0.2, 0.2, 0.6])


def test_it_ends_where_it_is_cancelled_and_tells_how_far_it_is() -> None:
    told: list[float] = []
    torn, views = sheet(within(0.3)), looking_down(lambda points: np.full(points.shape[:2], 5.0))
    close_holes(torn, limit(1.0), views, told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0

    def stop(done: float) -> None:
        if done >= 0.5:
            raise Cancelled("enough")

    with pytest.raises(Cancelled):
        close_holes(torn, limit(1.0), views, stop)
