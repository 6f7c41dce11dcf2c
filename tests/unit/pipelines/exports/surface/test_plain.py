"""A plain table with bumps of several edges becomes plane beside a floor; a painted one, a curved
one and one that the photos speak of stay."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.surface.flatness import NOWHERE, Answers, find_flat_parts, flattened
from pipelines.exports.surface.plain import with_plain_parts
from pipelines.exports.surface.rings import MeshRings
from tests.unit.pipelines.exports.surface.test_flatness import STEP, X, Y, Z, faces_of, sheet

Floats = NDArray[np.float64]
FLOOR, TOP = 121, 22


def scene(bumps: float, curve: float = 0.0) -> tuple[Floats, MeshRings, NDArray[np.bool_]]:
    """A flat floor, and above it a table whose top goes up and down by so many edges."""
    floor = sheet(0 * X, X, Y, FLOOR)
    table = sheet(0.3 * (X + Y + Z), X, Y, TOP)
    across, along = ((table[:, axis] - 0.3) / (STEP * (TOP - 1)) for axis in (0, 1))
    table[:, 2] += bumps * STEP * np.sin(14.0 * across) * np.cos(11.0 * along)
    table[:, 2] -= curve * STEP * 4.0 * (across - 0.5) ** 2
    points = np.concatenate([floor, table])
    faces = np.concatenate([faces_of(FLOOR), faces_of(TOP, len(floor))])
    return (
        points - points.mean(axis=0),
        MeshRings(faces, len(points)),
        np.arange(len(points)) >= len(floor),
    )


def spread_of(points: Floats) -> float:
    return float(np.abs(points[:, 2] - np.median(points[:, 2])).mean())


def laid(points: Floats, rings: MeshRings, colors: Floats, trust: Floats) -> Floats:
    parts = with_plain_parts(find_flat_parts(points, rings), points, rings, colors, trust)
    answers = Answers(np.zeros(len(points)), trust, np.full(len(points), 0.1 * STEP))
    return flattened(points, parts, rings, answers)


def test_a_plain_table_is_flat_and_where_it_was() -> None:
    points, rings, table = scene(2.5)
    grey, untold = np.full_like(points, 0.8), np.zeros(len(points))
    found = find_flat_parts(points, rings)
    assert (found.plane_of[table] == NOWHERE).all()
    flat = laid(points, rings, grey, untold)
    assert spread_of(flat[table]) < 0.2 * spread_of(points[table])
    assert np.median(flat[table, 2]) == pytest.approx(np.mean(points[table, 2]), abs=STEP)
    np.testing.assert_allclose(flat[~table], points[~table], atol=1e-6)


def test_it_stays_where_photos_speak_of_it() -> None:
    points, rings, table = scene(2.5)
    flat = laid(points, rings, np.full_like(points, 0.8), np.ones(len(points)))
    assert spread_of(flat[table]) > 0.8 * spread_of(points[table])


def test_it_stays_where_it_is_painted() -> None:
    points, rings, table = scene(2.5)
    painted = np.full_like(points, 0.8)
    painted[table] = np.random.default_rng(0).uniform(0.2, 0.9, (int(table.sum()), 3))
    flat = laid(points, rings, painted, np.zeros(len(points)))
    assert spread_of(flat[table]) > 0.6 * spread_of(points[table])


def test_a_plain_dome_stays_round() -> None:
    points, rings, table = scene(0.0, curve=4.0)
    flat = laid(points, rings, np.full_like(points, 0.8), np.zeros(len(points)))
    assert spread_of(flat[table]) > 0.9 * spread_of(points[table])
