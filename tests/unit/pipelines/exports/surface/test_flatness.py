"""Bumpy floors and walls become plane; what is curved, or stands out in the photos, stays."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from pipelines.exports.surface.flatness import NOWHERE, Answers, find_flat_parts, flattened
from pipelines.exports.surface.rings import MeshRings

Floats = NDArray[np.float64]
STEP = 0.02
HALF_PIXEL = 0.3 * STEP
SIDE = 61


def sheet(origin: Floats, along: Floats, across: Floats, side: int = SIDE) -> Floats:
    """[side^2, 3]: a square of vertices STEP apart."""
    steps = STEP * np.arange(side)
    u, v = (axis.reshape(-1, 1) for axis in np.meshgrid(steps, steps))
    square: Floats = np.asarray(origin) + u * np.asarray(along) + v * np.asarray(across)
    return square


def faces_of(side: int, start: int = 0) -> NDArray[np.int32]:
    index = start + np.arange(side * side).reshape(side, side)
    a, b, c, d = index[:-1, :-1], index[:-1, 1:], index[1:, :-1], index[1:, 1:]
    triangles = [np.stack(part, axis=-1).reshape(-1, 3) for part in ((a, b, c), (b, d, c))]
    return np.concatenate(triangles).astype(np.int32)


X, Y, Z = np.eye(3)


def room(bumps: float) -> tuple[Floats, MeshRings, NDArray[np.intp], Floats]:
    """Floor and two walls (vertices of one edge length), each with noise across it, a table top of
    a twentieth of their area; and of each vertex which it is of, and where it truly lies."""
    rng = np.random.default_rng(1)
    sheets = [
        (sheet(0 * X, X, Y), faces_of(SIDE), Z),
        (sheet(0 * X, X, Z), faces_of(SIDE), Y),
        (sheet(0 * X, Y, Z), faces_of(SIDE), X),
        (sheet(0.4 * (X + Y + Z), X, Y, 24), faces_of(24), Z),
    ]
    true = np.concatenate([points for points, _, _ in sheets])
    starts = np.cumsum([0] + [len(points) for points, _, _ in sheets])[:-1]
    faces = np.concatenate([f + np.int32(s) for (_, f, _), s in zip(sheets, starts, strict=True)])
    which = np.repeat(np.arange(4), [len(points) for points, _, _ in sheets])
    normals = np.stack([normal for _, _, normal in sheets])[which]
    bumpy = true + bumps * STEP * rng.normal(size=(len(true), 1)) * normals
    middle = true.mean(axis=0)
    return bumpy - middle, MeshRings(faces.astype(np.int32), len(true)), which, true - middle


def tilt_deg(vertices: Floats, rings: MeshRings, normal: Floats) -> float:
    cosine = np.abs(rings.normals(vertices) @ normal)
    return float(np.degrees(np.arccos(np.clip(np.median(cosine), 0.0, 1.0))))


def test_floor_and_walls_become_plane_where_they_are() -> None:
    bumpy, rings, which, true = room(0.4)
    parts = find_flat_parts(bumpy, rings)
    flat = flattened(bumpy, parts, rings)
    assert (parts.plane_of != NOWHERE).mean() > 0.9
    assert tilt_deg(bumpy[which == 0], MeshRings(faces_of(SIDE), SIDE**2), Z) > 10.0
    assert tilt_deg(flat[which == 0], MeshRings(faces_of(SIDE), SIDE**2), Z) < 0.5
    error = np.abs(((flat - true) * np.stack([Z, Y, X, Z])[which]).sum(axis=1))
    assert np.median(error) < 0.05 * STEP
    assert np.abs(flat - bumpy).max() < 3.0 * STEP


def test_a_small_plane_takes_the_slope_of_a_larger_one() -> None:
    bumpy, rings, which, true = room(0.4)
    table = which == 3
    slope = 0.05 * (true[table, 0] - true[table, 0].mean())
    bumpy[table, 2] += slope
    parts = find_flat_parts(bumpy, rings)
    plane = parts.planes[parts.plane_of[table][0]]
    floor = parts.planes[parts.plane_of[which == 0][0]]
    assert np.abs(plane[:3] @ floor[:3]) == pytest.approx(1.0, abs=1e-9)


def test_a_steep_ramp_keeps_its_slope() -> None:
    bumpy, rings, which, true = room(0.3)
    table = which == 3
    bumpy[table, 2] += 0.2 * (true[table, 0] - true[table, 0].mean())
    parts = find_flat_parts(bumpy, rings)
    plane = parts.planes[parts.plane_of[table][100]]
    assert np.degrees(np.arccos(np.abs(plane[2]))) == pytest.approx(11.3, abs=1.0)


def ball() -> tuple[Floats, MeshRings]:
    """A sphere of radius 1 by latitude and longitude, without its poles."""
    side = 121
    theta, phi = np.meshgrid(np.linspace(0.2, np.pi - 0.2, side), np.linspace(0.0, 6.2, side))
    points = np.stack(
        [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], axis=-1
    ).reshape(-1, 3)
    return points, MeshRings(faces_of(side), side * side)


def test_a_ball_stays_a_ball() -> None:
    points, rings = ball()
    noisy = points * (1.0 + 0.003 * np.random.default_rng(0).normal(size=(len(points), 1)))
    flat = flattened(noisy, find_flat_parts(noisy, rings), rings)
    assert np.abs(np.linalg.norm(flat, axis=1) - 1.0).max() < 0.02


def test_the_bumpy_side_of_a_barrel_stays_round() -> None:
    """Of what lies near a plane there half is bumps; laid on planes it would be a prism."""
    side = 140
    angle, height = np.meshgrid(np.linspace(-0.6, 0.6, side), np.linspace(0.0, 1.2, side))
    bumps = np.random.default_rng(0).normal(size=(side, side))
    for _ in range(12):  # as wide as those that depth has on dark bronze
        around = [np.roll(bumps, shift, axis) for axis in (0, 1) for shift in (-1, 1)]
        bumps = np.mean([bumps, *around], axis=0)
    radius = 1.0 + 0.005 * bumps / bumps.std()
    points = np.stack([radius * np.sin(angle), radius * np.cos(angle), height], axis=-1)
    points = points.reshape(-1, 3)
    parts = find_flat_parts(points, MeshRings(faces_of(side), side * side))
    assert (parts.plane_of != NOWHERE).mean() < 0.02


def told(points: Floats, trust: float) -> Answers:
    """Photos that are as sure that all is where it is."""
    count = len(points)
    return Answers(np.zeros(count), np.full(count, trust), np.full(count, HALF_PIXEL))


def with_relief() -> tuple[Floats, MeshRings, NDArray[np.bool_]]:
    """A floor with a slab of 1.5 edges on it."""
    points = sheet(0 * X, X, Y) - 0.5 * SIDE * STEP * (X + Y)
    slab = np.asarray((np.abs(points[:, :2]) < 0.2).all(axis=1), np.bool_)
    points[slab, 2] += 1.5 * STEP
    points[:, 2] += 0.1 * STEP * np.random.default_rng(0).normal(size=len(points))
    return points, MeshRings(faces_of(SIDE), len(points)), slab


def test_what_stands_out_in_the_photos_stays() -> None:
    points, rings, slab = with_relief()
    parts = find_flat_parts(points, rings)
    blind = flattened(points, parts, rings, told(points, 0.0))
    sure = flattened(points, parts, rings, told(points, 1.0))
    inside = (np.abs(points[:, :2]) < 0.1).all(axis=1)
    assert np.abs(blind[inside, 2] - np.median(blind[~slab, 2])).max() < 0.2 * STEP
    assert np.median(sure[inside, 2]) - np.median(sure[~slab, 2]) > 1.2 * STEP


def test_a_textured_floor_stays_as_bent_as_its_pictures_say() -> None:
    points = sheet(0 * X, X, Y) - 0.5 * SIDE * STEP * (X + Y)
    bow = 0.5 * STEP * np.cos(4.0 * points[:, 0])
    noise = 0.2 * STEP * np.random.default_rng(0).normal(size=len(points))
    points[:, 2] += bow + noise
    rings = MeshRings(faces_of(SIDE), len(points))
    parts = find_flat_parts(points, rings)
    assert (parts.plane_of != NOWHERE).mean() > 0.95
    bent = flattened(points, parts, rings, told(points, 1.0))[:, 2]
    blind = flattened(points, parts, rings, told(points, 0.0))
    assert np.abs(bent - bent.mean() - (bow - bow.mean())).mean() < 0.4 * np.abs(noise).mean()
    assert np.linalg.svd(blind - blind.mean(axis=0), full_matrices=False)[1][2] < 1e-6


def test_a_vertex_that_photos_are_sure_of_alone_does_not_stick_out() -> None:
    """They have mistaken it for another; of five by five together they have not."""
    points = sheet(0 * X, X, Y) - 0.5 * SIDE * STEP * (X + Y)
    points[:, 2] += 0.02 * STEP * np.random.default_rng(0).normal(size=len(points))
    square = np.arange(SIDE * SIDE).reshape(SIDE, SIDE)
    alone = square[10:50:8, 10:50:8].ravel()
    knob = square[53:58, 20:25].ravel()
    answers = told(points, 1.0)
    answers.offset[alone] = 1.5 * STEP
    answers.offset[knob] = 0.4 * STEP
    answers.half_pixel[knob] = 0.05 * STEP
    rings = MeshRings(faces_of(SIDE), len(points))
    parts = find_flat_parts(points, rings)
    assert (parts.plane_of[np.concatenate([alone, knob])] != NOWHERE).all()
    flat = flattened(points, parts, rings, answers)
    height = (flat[:, 2] - np.median(flat[:, 2])) / STEP
    assert np.abs(height[alone]).max() < 0.35
    assert height[square[54:57, 21:24]].min() > 0.25


def test_it_can_be_stopped_while_it_looks() -> None:
    bumpy, rings, _, _ = room(0.4)

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        find_flat_parts(bumpy, rings, stop)


def test_bumps_are_measured_by_what_made_them_not_by_finer_edges() -> None:
    """Bumps of four edges' width and more than one's height, as a mesh of half the edges has."""
    points = sheet(0 * X, X, Y) - 0.5 * SIDE * STEP * (X + Y)
    bumps = gaussian_filter(np.random.default_rng(0).normal(size=(SIDE, SIDE)), 2.0).ravel()
    points[:, 2] += 1.2 * STEP * bumps / bumps.std()
    faces = faces_of(SIDE)
    assert (find_flat_parts(points, MeshRings(faces, len(points))).plane_of == NOWHERE).all()
    told = MeshRings(faces, len(points), noise=2.5 * STEP)
    flat = flattened(points, find_flat_parts(points, told), told)
    assert tilt_deg(points, told, Z) > 10.0
    assert tilt_deg(flat, told, Z) < 1.0
