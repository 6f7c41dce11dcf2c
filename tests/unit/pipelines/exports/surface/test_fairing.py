"""A plain drum with fusion's bumps becomes smooth where it was; what is not plain, rims and the
edges of plain boxes stay."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.surface.fairing import faired
from pipelines.exports.surface.rings import MeshRings
from tests.unit.pipelines.exports.surface.test_flatness import STEP, X, Y, Z, faces_of, sheet

Floats = NDArray[np.float64]
COUNT = 80
RADIUS = 40.0 * STEP


def drum(noise: float) -> tuple[Floats, MeshRings]:
    """A quarter of a drum's side and a bit, with noise of so many edges along its normals."""
    flat = sheet(0 * X, X, Z, COUNT)
    angles = flat[:, 0] / RADIUS
    out = np.stack([np.sin(angles), np.cos(angles), np.zeros(len(flat))], axis=-1)
    radii = RADIUS + noise * STEP * np.random.default_rng(0).standard_normal(len(flat))
    points = radii[:, None] * out + np.stack([0 * angles, 0 * angles, flat[:, 2]], axis=-1)
    return points, MeshRings(faces_of(COUNT), len(points))


def radii_of(points: Floats) -> Floats:
    return np.hypot(points[:, 0], points[:, 1]) / STEP


def inner(rings: MeshRings) -> NDArray[np.bool_]:
    """What is farther from the border than bumps are long."""
    return rings.spread(rings.on_border.astype(np.float64)[:, None], 8)[:, 0] == 0.0


def test_a_plain_drum_is_smooth_and_where_it_was() -> None:
    points, rings = drum(0.2)
    fair = radii_of(faired(points, np.ones(len(points), np.bool_), rings))[inner(rings)]
    before = radii_of(points)[inner(rings)]
    assert before.std() > 0.18
    assert fair.std() < 0.25 * before.std()
    assert abs(fair.mean() - RADIUS / STEP) < 0.02


def test_bumps_that_are_wide_stay() -> None:
    points, rings = drum(0.0)
    turn = np.arctan2(points[:, 0], points[:, 1])
    wide = points * (1.0 + 0.02 * np.sin(2.0 * np.pi * turn * RADIUS / (60.0 * STEP)))[:, None]
    fair = faired(wide, np.ones(len(points), np.bool_), rings)
    off = radii_of(fair)[inner(rings)] - radii_of(wide)[inner(rings)]
    assert np.abs(off).mean() < 0.15 * (radii_of(wide) - RADIUS / STEP)[inner(rings)].std()


def test_what_is_not_plain_and_the_border_stay() -> None:
    points, rings = drum(0.2)
    plain = points[:, 2] > np.median(points[:, 2])
    fair = faired(points, plain, rings)
    moved = (fair != points).any(axis=1)
    np.testing.assert_array_equal(fair[~plain | rings.on_border], points[~plain | rings.on_border])
    assert moved[plain & ~rings.on_border].mean() > 0.99
    assert faired(points, np.zeros(len(points), np.bool_), rings) is points


def test_the_edge_of_a_plain_box_is_not_rounded_by_more_than_half_an_edge() -> None:
    length = STEP * (COUNT - 1)
    top, side = sheet(-length * Y, X, Y, COUNT), sheet(0 * X, X, -Z, COUNT)
    points = np.concatenate([top, side])
    faces = np.concatenate([faces_of(COUNT), faces_of(COUNT, len(top))])
    _, first, number = np.unique(points.round(9), axis=0, return_index=True, return_inverse=True)
    points, rings = points[first], MeshRings(number.ravel()[faces].astype(np.int32), len(first))
    fair = faired(points, np.ones(len(points), np.bool_), rings)
    moves = np.linalg.norm(fair - points, axis=1) / STEP
    assert 0.3 < moves.max() < 0.6
    far = np.abs(points[:, 1]) + np.abs(points[:, 2]) > 20.0 * STEP
    assert moves[far].max() < 0.1
