"""A board's frayed rim comes to lie where photos show that it ends."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from pipelines.exports.mesh import empty_mesh
from pipelines.exports.surface import outline_views, outlines
from pipelines.exports.surface.color_edges import STEPS
from pipelines.exports.surface.outline_views import Answers
from pipelines.exports.surface.outlines import outlined
from pipelines.exports.surface.rings import MeshRings
from tests.unit.pipelines.exports.surface import board
from tests.unit.pipelines.exports.surface.test_refinement import grid

NUM_RIM = 4 * board.CELLS


def frayed(seed: int = 0) -> board.Floats:
    """Px, a wave and what is each vertex's own."""
    own = np.random.default_rng(seed).normal(size=NUM_RIM)
    return 1.5 * np.sin(np.arange(NUM_RIM) / 9.0) + own


@pytest.mark.parametrize("shift", [-2.0, 2.0])
def test_a_rim_goes_to_the_photos_edge(shift: float) -> None:
    mesh = board.mesh(frayed() + shift)

    found = outlined(mesh, board.photos())

    after = np.abs(board.rim_errors(found))
    assert np.median(np.abs(board.rim_errors(mesh))) > 1.5
    assert np.median(after) < 0.25
    assert np.percentile(after, 90) < 0.8
    assert np.array_equal(found.faces, mesh.faces)
    assert np.array_equal(found.colors, mesh.colors)


@pytest.mark.parametrize("at_once", [1, len(STEPS), 100], ids=["one", "as many as steps", "more"])
def test_few_answers_at_once_and_few_in_all_are_enough(
    monkeypatch: pytest.MonkeyPatch, at_once: int
) -> None:
    monkeypatch.setattr(outline_views, "_AT_ONCE", at_once)
    monkeypatch.setattr(outlines, "_MOST_ANSWERS", 500)

    found = outlined(board.mesh(frayed()), board.photos())

    assert np.median(np.abs(board.rim_errors(found))) < 0.3


def test_a_flap_of_the_backgrounds_colour_is_seen_through() -> None:
    mesh = board.mesh(np.full(NUM_RIM, 2.0), flap=1)

    after = board.rim_errors(outlined(mesh, board.photos()))

    assert abs(np.median(after)) < 0.5


def test_what_is_right_stays() -> None:
    mesh = board.mesh(np.zeros(NUM_RIM))

    found = outlined(mesh, board.photos())

    moved = np.linalg.norm(found.vertices - mesh.vertices, axis=1) / board.PIXEL
    assert moved.max() < 0.5
    assert np.allclose(found.normals, mesh.normals, atol=0.05)


def test_photos_without_an_edge_say_nothing() -> None:
    mesh = board.mesh(frayed())
    grey = [replace(view, picture=np.full_like(view.picture, 128)) for view in board.photos()]

    found = outlined(replace(mesh, colors=np.full_like(mesh.colors, 0.5)), grey)

    assert np.array_equal(found.vertices, mesh.vertices)


def test_what_a_mask_hides_says_nothing() -> None:
    mesh = board.mesh(frayed())
    hidden = [replace(view, usable=np.zeros_like(view.usable)) for view in board.photos()]

    assert np.array_equal(outlined(mesh, hidden).vertices, mesh.vertices)


def test_a_mesh_that_hides_nothing_stays() -> None:
    mesh = board.mesh(frayed())
    wall = mesh.with_faces(mesh.faces[len(mesh.faces) // 2 :])

    assert np.array_equal(outlined(wall, board.photos()).vertices, wall.vertices)


def test_nothing_to_do() -> None:
    mesh = board.mesh(frayed())

    assert outlined(mesh, []) is mesh
    assert len(outlined(empty_mesh(), board.photos()).vertices) == 0


def test_progress_is_told_and_may_end_it() -> None:
    told: list[float] = []

    def stop(done: float) -> None:
        told.append(done)
        if done > 0.5:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        outlined(board.mesh(frayed()), board.photos(), stop)
    assert told == sorted(told)
    assert 0.5 < told[-1] < 0.7


def test_a_wall_whose_end_is_pulled_off_it_is_not_carried_along() -> None:
    """A sheet with edges of five pixels: at its end by a pixel within its plane, or off it."""
    side, pixel = 21, 0.2
    x, y = (part.ravel() for part in np.meshgrid(np.arange(side), np.arange(side)))
    sheet = np.stack([x, y, np.zeros(len(x))], axis=1).astype(np.float64)
    rings = MeshRings(grid(side, side), len(sheet))
    last = np.flatnonzero((x[rings.faces] == side - 1).any(axis=1))
    holds = outlines._holds(sheet, rings, np.full(len(sheet), pixel), np.ones(len(sheet), np.bool_))

    def pulled(way: tuple[float, float, float]) -> board.Floats:
        """How far columns go that way, px."""
        at_end = (x[rings.faces[last]] == side - 1).astype(np.float64)
        answers = Answers(
            last,
            at_end / at_end.sum(axis=1, keepdims=True),
            np.tile(way, (len(last), 1)),
            np.full(len(last), pixel),
            np.full(len(last), pixel),
            np.ones(len(last)),
        )
        moves = outlines._moves(answers, rings, 0.3, *holds) @ np.array(way)
        return moves.reshape(side, side).mean(axis=0) / pixel

    within, off = pulled((1.0, 0.0, 0.0)), pulled((0.0, 0.0, 1.0))
    assert within[-1] > 0.5
    assert off[-1] > 0.1
    assert np.abs(off[:-3]).max() < min(0.05, 0.3 * np.abs(within[:-3]).max())
    assert np.abs(within[:-7]).max() < 0.15
