"""Meshes closed all over."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import trimesh
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh, empty_mesh, joined
from pipelines.exports.surface.borders import border_loops
from pipelines.exports.surface.watertight import is_closed, made_watertight
from tests.unit.pipelines.exports.surface.torn import SIDE, ball, coloured, sheet, within

Floats = NDArray[np.float64]


def solid(mesh: TriangleMesh) -> trimesh.Trimesh:
    """As a slicer reads it: in 32 bits, vertices at one place as one."""
    return trimesh.Trimesh(mesh.vertices.astype(np.float32), mesh.faces)


def heap(points: Floats) -> Floats:
    return np.asarray(0.8 * np.exp(-(points[:, :2] ** 2).sum(axis=1) / 0.1))


def test_closed_is_where_each_edge_has_two_faces_that_go_opposite_ways() -> None:
    whole = ball(within(0.0), 2)
    assert is_closed(whole.faces)
    assert not is_closed(whole.faces[1:])
    turned = whole.faces.copy()
    turned[0] = turned[0, ::-1]
    assert not is_closed(turned)
    assert not is_closed(np.concatenate([whole.faces, whole.faces[:1]]))
    assert not is_closed(empty_mesh().faces)


def test_a_closed_mesh_stays_as_it_is() -> None:
    whole = ball(within(0.0), 2)
    made = made_watertight(whole)
    np.testing.assert_array_equal(made.vertices, whole.vertices)
    np.testing.assert_array_equal(made.faces, whole.faces)


def test_what_stands_on_a_piece_of_table_gets_a_plinth() -> None:
    """A heap on a table with holes, without its underside."""

    def gone(points: Floats) -> NDArray[np.bool_]:
        return np.asarray(np.linalg.norm(points - [0.7, 0.7], axis=1) < 0.2)

    table = sheet(gone, num=20)
    raised = replace(table, vertices=table.vertices + heap(table.vertices)[:, None] * [0, 0, 1])
    made = made_watertight(raised)
    assert is_closed(made.faces)
    read = solid(made)
    assert read.is_watertight
    assert read.is_winding_consistent
    # The base is 2 % of the size below; the heap has 0.8 * pi * 0.1 above.
    size = float(np.linalg.norm(np.ptp(raised.vertices, axis=0)))
    thick = 0.02 * size
    assert read.volume == pytest.approx(0.8 * np.pi * 0.1 + thick * (20 * SIDE) ** 2, rel=0.03)
    assert made.vertices[:, 2].min() == pytest.approx(-thick, rel=0.03)
    down = read.face_normals[:, 2] < -0.99
    assert read.area_faces[down].sum() == pytest.approx((20 * SIDE) ** 2, rel=1e-6)
    assert (made.colors >= 0.0).all()
    assert (made.colors <= 1.0).all()
    np.testing.assert_allclose(np.linalg.norm(made.normals, axis=1), 1.0, atol=1e-9)


def test_a_base_lies_on_what_carries_the_thing_also_where_its_border_is_tilted() -> None:
    table = sheet(lambda points: points[:, 0] > 0.3, num=20)
    tilted = table.vertices[:, [0]] * np.array([0.0, 0.0, 0.4])
    mesh = replace(table, vertices=table.vertices + tilted)
    for down, level in ((np.array([0.0, 0.0, -1.0]), True), (None, False)):
        made = made_watertight(mesh, down)
        assert solid(made).is_watertight
        base = made.vertices[len(mesh.vertices) :, 2]
        assert (np.ptp(base) < 1e-9) == level


def test_a_bowl_gets_its_bottom_and_no_lid_is_folded() -> None:
    dome = ball(lambda points: points[:, 2] < 0.3)
    read = solid(made_watertight(dome))
    assert read.is_watertight
    assert read.volume > 0.0
    open_top = ball(lambda points: points[:, 2] > 0.5)
    read = solid(made_watertight(open_top))
    assert read.is_watertight
    # What is missing of the ball is closed by a bulge, or flat: never more than the ball has.
    assert 0.8 * 4.0 / 3.0 * np.pi < read.volume < 1.02 * 4.0 / 3.0 * np.pi


def test_edges_of_three_faces_are_mended() -> None:
    whole = ball(within(0.0), 3)
    fin = np.array([[*whole.faces[0, :2], len(whole.vertices)]])
    tip = 1.5 * whole.vertices[whole.faces[0, :2]].mean(axis=0)
    mesh = coloured(np.concatenate([whole.vertices, [tip]]), np.concatenate([whole.faces, fin]))
    assert not is_closed(mesh.faces)
    read = solid(made_watertight(mesh))
    assert read.is_watertight
    assert read.volume == pytest.approx(solid(whole).volume, rel=0.01)


def test_a_seam_of_vertices_at_one_place_is_sewn_and_crumbs_go() -> None:
    whole = ball(within(0.0), 3)
    apart = coloured(
        whole.vertices[whole.faces].reshape(-1, 3), np.arange(3 * len(whole.faces)).reshape(-1, 3)
    )
    crumb = sheet(within(0.0), num=2)
    crumb = replace(crumb, vertices=crumb.vertices + np.array([3.0, 0.0, 0.0]))
    made = made_watertight(joined([apart, crumb]))
    read = solid(made)
    assert read.is_watertight
    assert len(made.faces) == len(whole.faces)


def test_holes_that_touch_and_a_pipe_are_closed() -> None:
    def two_squares(points: Floats) -> NDArray[np.bool_]:
        x, y = points.T
        one = (np.abs(x - 2 * SIDE) < 2 * SIDE) & (np.abs(y - 2 * SIDE) < 2 * SIDE)
        other = (np.abs(x + 2 * SIDE) < 2 * SIDE) & (np.abs(y + 2 * SIDE) < 2 * SIDE)
        return np.asarray(one | other)

    assert solid(made_watertight(sheet(two_squares, num=20))).is_watertight
    turn = 2.0 * np.pi * np.arange(16) / 16
    ends = [np.stack([np.cos(turn), np.sin(turn), np.full(16, z)], axis=1) for z in (0.0, 0.5, 2.0)]
    at = np.arange(32)
    beside = at - at % 16 + (at + 1) % 16
    sides = [
        np.stack([at, beside, at + 16], axis=1),
        np.stack([beside, beside + 16, at + 16], axis=1),
    ]
    pipe = coloured(np.concatenate(ends), np.concatenate(sides))
    read = solid(made_watertight(pipe))
    assert read.is_watertight
    assert read.volume > 0.9 * 2.0 * np.pi


def test_nothing_that_can_be_closed_stays_as_it_is() -> None:
    fan = np.array([[0, 1, 2], [0, 1, 3], [0, 1, 4]])
    mesh = coloured(np.random.default_rng(1).normal(size=(5, 3)), fan)
    made = made_watertight(mesh)
    assert made is mesh
    assert not is_closed(made.faces)


def test_torn_at_random_it_is_closed_all_the_same() -> None:
    for seed in range(4):
        chance = np.random.default_rng(seed)
        whole = ball(within(0.0), 3)
        torn = whole.with_faces(whole.faces[chance.random(len(whole.faces)) > 0.2])
        made = made_watertight(torn)
        assert is_closed(made.faces), seed
        assert not border_loops(made.faces)
