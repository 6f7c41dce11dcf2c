"""A bumpy mesh of a painted wall comes to lie on it; what no camera shows is left out."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.mesh import TriangleMesh
from pipelines.exports.surface.refinement import refined
from pipelines.exports.surface.rings import MeshRings
from pipelines.nerf.stereo.views import StereoView
from tests.unit.pipelines.nerf.stereo.painted_wall import SLOPE, WALL, Floats, look

ORIGIN = np.array([300.0, -40.0, 7.0])
STEP = 0.025


def views(*, plain: bool = False) -> list[StereoView]:
    """Seven cameras before the wall, in a world whose origin is far away."""
    places = (
        (-0.6, 0.0),
        (0.0, -0.5),
        (0.6, 0.1),
        (0.3, 0.5),
        (-0.3, 0.4),
        (0.0, 0.0),
        (0.5, -0.4),
    )
    made = [look(x, y, with_box=False, size=3)[0] for x, y in places]
    return [
        StereoView(
            np.full_like(view.picture, 0.5) if plain else view.picture,
            view.lens,
            np.column_stack([view.world_from_camera[:, :3], view.center + ORIGIN]),
        )
        for view in made
    ]


def grid(rows: int, columns: int) -> NDArray[np.int32]:
    """Triangles of a sheet of vertices, that face -Z."""
    index = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:])
    faces = np.concatenate(
        [np.stack([a, c, b], axis=-1).reshape(-1, 3), np.stack([b, c, d], axis=-1).reshape(-1, 3)]
    )
    return faces.astype(np.int32)


def sheet(bumps: float, behind: float = 0.0) -> TriangleMesh:
    """The wall's middle, 41 x 41 vertices, off by smooth bumps of that height."""
    side = STEP * (np.arange(41) - 20)
    x, y = np.meshgrid(side, side)
    z = WALL + SLOPE * x + behind + bumps * np.sin(9.0 * x) * np.cos(7.0 * y)
    vertices = np.stack([x, y, z], axis=-1).reshape(-1, 3) + ORIGIN
    faces = grid(41, 41)
    return TriangleMesh(
        vertices,
        faces,
        np.full_like(vertices, 0.5),
        MeshRings(faces, len(vertices)).normals(vertices),
    )


def height(vertices: Floats) -> Floats:
    """How far before or behind the wall vertices are."""
    local = vertices - ORIGIN
    found: Floats = (local[:, 2] - WALL - SLOPE * local[:, 0]) / np.hypot(1.0, SLOPE)
    return found


def test_bumps_are_moved_onto_the_wall() -> None:
    mesh = sheet(0.05)
    better = refined(mesh, views())
    assert np.abs(height(better.vertices)).mean() < 0.3 * np.abs(height(mesh.vertices)).mean()
    rings = MeshRings(better.faces, len(better.vertices))
    np.testing.assert_allclose(better.normals, rings.normals(better.vertices), atol=1e-9)
    assert len(better.faces) == len(mesh.faces)


def test_a_surface_that_is_right_stays() -> None:
    mesh = sheet(0.0)
    moved = height(refined(mesh, views()).vertices)
    assert np.abs(moved).max() < 0.2 * STEP


def test_nothing_moves_where_photos_say_nothing() -> None:
    mesh = sheet(0.05)
    colors = np.random.default_rng(0).uniform(size=mesh.vertices.shape)
    for still, flat in ((mesh, False), (replace(mesh, colors=colors), True)):
        moved = refined(still, views(plain=True), flat=flat)
        np.testing.assert_allclose(moved.vertices, mesh.vertices, atol=1e-9)


def test_what_is_of_one_colour_besides_becomes_smooth() -> None:
    mesh = sheet(0.05)
    rough = np.random.default_rng(0).normal(scale=0.2 * STEP, size=len(mesh.vertices))
    vertices = mesh.vertices + rough[:, None] * mesh.normals
    smooth = refined(replace(mesh, vertices=vertices), views(plain=True))
    rings = MeshRings(mesh.faces, len(vertices))
    turned = [(rings.normals(of) * mesh.normals).sum(axis=1) for of in (vertices, smooth.vertices)]
    before, after = (np.median(np.degrees(np.arccos(np.clip(each, -1.0, 1.0)))) for each in turned)
    assert after < 0.5 * before


def test_borders_stay() -> None:
    mesh = sheet(0.05)
    border = (np.abs(mesh.vertices[:, :2] - ORIGIN[:2]) > 19.5 * STEP).any(axis=1)
    moves = np.linalg.norm(refined(mesh, views(), flat=False).vertices - mesh.vertices, axis=1)
    # They are held, not nailed down: their neighbours pull.
    assert np.median(moves[border]) < 0.6 * np.median(moves[~border])


def test_what_no_camera_shows_is_left_out() -> None:
    front, back = sheet(0.0), sheet(0.0, behind=0.5)
    hidden = TriangleMesh(
        np.concatenate([front.vertices, 0.8 * (back.vertices - ORIGIN) + ORIGIN + [0, 0, 0.9]]),
        np.concatenate([front.faces, back.faces + len(front.vertices)]).astype(np.int32),
        np.concatenate([front.colors, back.colors]),
        np.concatenate([front.normals, back.normals]),
    )
    seen = refined(hidden, views())
    assert len(front.faces) <= len(seen.faces) < len(front.faces) + 0.3 * len(back.faces)


def test_without_photos_or_faces_it_stays() -> None:
    mesh = sheet(0.05)
    assert refined(mesh, []) is mesh
    none = TriangleMesh(
        np.zeros((0, 3)), np.zeros((0, 3), np.int32), np.zeros((0, 3)), np.zeros((0, 3))
    )
    assert refined(none, views()) is none


def test_progress_rises_and_may_stop_it() -> None:
    told: list[float] = []
    refined(sheet(0.02), views(), told.append)
    assert told == sorted(told)
    assert told[-1] == pytest.approx(1.0)
    assert len(told) > 10


def test_photos_that_would_carry_a_surface_far_away_are_not_believed() -> None:
    """Every picture is shifted as if the wall were three edges nearer."""
    right = views()
    wrong = []
    for view in right:
        away = (view.center - ORIGIN)[:2] / WALL
        fx, fy, cx, cy = view.lens
        near = WALL / (WALL - 3.0 * STEP) - 1.0
        shift = (cx + fx * away[0] * near, cy + fy * away[1] * near)
        wrong.append(replace(view, lens=(fx, fy, *shift)))
    moved = refined(sheet(0.0), wrong, flat=False)
    # Believed, they carry it away by 2.9 edges.
    assert abs(np.median(height(moved.vertices))) < STEP
