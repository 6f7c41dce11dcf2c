"""Meshes of fewer triangles: how many, where they are, and what of borders and colours stays."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pytest
from scipy.spatial import cKDTree

from pipelines.errors import Cancelled, ToolError
from pipelines.exports import decimation, reduction
from pipelines.exports.mesh import TriangleMesh, joined
from pipelines.exports.reduction import reduced

_geometry: Any = open3d.geometry
_utility: Any = open3d.utility
_FAR = np.array([4000.0, -900.0, 20.0])


def ball(center: np.ndarray, radius: float, resolution: int) -> TriangleMesh:
    made = _geometry.TriangleMesh.create_sphere(radius, resolution)
    points = np.asarray(made.vertices, np.float64)
    unit = points / radius
    return TriangleMesh(points + center, np.asarray(made.triangles, np.int32), _hue(unit), unit)


def sheet(side: int = 60) -> TriangleMesh:
    """A wavy square from (0, 0) to (1, 1) with a square hole, open all round."""
    grid = np.linspace(0.0, 1.0, side)
    x, y = (axis.reshape(-1) for axis in np.meshgrid(grid, grid, indexing="ij"))
    vertices = np.stack([x, y, 0.05 * np.sin(6.0 * x)], axis=1) + _FAR
    index = np.arange(side * side).reshape(side, side)
    quads = np.stack([index[:-1, :-1], index[1:, :-1], index[1:, 1:], index[:-1, 1:]], axis=-1)
    solid = np.ones(quads.shape[:2], bool)
    solid[side // 3 : side // 2, side // 3 : side // 2] = False
    quads = quads[solid]
    faces = np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]]).astype(np.int32)
    up = np.tile([0.0, 0.0, 1.0], (len(vertices), 1))
    return TriangleMesh(vertices, faces, np.full_like(vertices, 0.5), up)


def _hue(unit: np.ndarray) -> np.ndarray:
    return np.clip(0.5 + 0.4 * unit, 0.0, 1.0)


def sampled(mesh: TriangleMesh, origin: np.ndarray, num: int = 40_000) -> np.ndarray:
    made = _geometry.TriangleMesh(
        _utility.Vector3dVector(mesh.vertices - origin), _utility.Vector3iVector(mesh.faces)
    )
    return np.asarray(made.sample_points_uniformly(num).points)


def f_score(mesh: TriangleMesh, truth: TriangleMesh, origin: np.ndarray, within: float) -> float:
    found, wanted = sampled(mesh, origin), sampled(truth, origin)
    precision = np.mean(cKDTree(wanted).query(found)[0] < within)
    recall = np.mean(cKDTree(found).query(wanted)[0] < within)
    return float(2 * precision * recall / (precision + recall))


@pytest.mark.parametrize("mesh", [ball(_FAR, 1.0, 60), sheet()], ids=["ball", "sheet"])
def test_a_tenth_of_the_triangles_shows_the_same_surface(mesh: TriangleMesh) -> None:
    few = reduced(mesh, len(mesh.faces) // 10)
    assert len(few.faces) == pytest.approx(len(mesh.faces) / 10, rel=0.02)
    within = 0.02
    assert f_score(mesh, mesh, _FAR, within) - f_score(few, mesh, _FAR, within) <= 0.01
    np.testing.assert_allclose(np.linalg.norm(few.normals, axis=1), 1.0, atol=1e-6)


def test_open_borders_stay_where_they_are() -> None:
    mesh = sheet()
    few = reduced(mesh, len(mesh.faces) // 20)
    np.testing.assert_allclose(few.vertices.min(0)[:2], mesh.vertices.min(0)[:2], atol=1e-9)
    np.testing.assert_allclose(few.vertices.max(0)[:2], mesh.vertices.max(0)[:2], atol=1e-9)
    rim = cKDTree(_border(few))
    assert rim.query(_border(mesh))[0].max() < 1e-6, "the hole's border, too"


def test_borders_give_way_where_there_would_be_nothing_but_borders() -> None:
    mesh = sheet()
    few = reduced(mesh, 60)
    assert 40 < len(few.faces) <= 61


def _border(mesh: TriangleMesh) -> np.ndarray:
    """Points along edges that one face alone has."""
    edges = np.sort(mesh.faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2), axis=1)
    unique, times = np.unique(edges, axis=0, return_counts=True)
    begin, end = (mesh.vertices[unique[times == 1][:, k]] - _FAR for k in (0, 1))
    along = np.linspace(0.0, 1.0, 30)[:, None, None]
    return np.asarray((begin + along * (end - begin)).reshape(-1, 3))


def test_what_is_far_and_coarse_takes_nothing_from_the_subject() -> None:
    subject, wall = ball(_FAR, 1.0, 40), ball(_FAR + 100.0, 50.0, 40)
    few = reduced(joined([subject, wall]), 1000)
    near = np.linalg.norm(few.vertices - _FAR, axis=1) < 2.0
    of_subject = near[few.faces[:, 0]].sum()
    assert of_subject == pytest.approx(500, rel=0.02)
    assert len(few.faces) == pytest.approx(1000, rel=0.02)
    off = np.abs(few.colors[near] - _hue(few.vertices[near] - _FAR))
    assert off.max() < 0.1


def test_many_small_pieces_are_reduced_together() -> None:
    crumbs = joined([ball(_FAR + 3.0 * i, 1.0, 5) for i in range(30)])
    few = reduced(crumbs, len(crumbs.faces) // 2)
    assert 0.4 * len(crumbs.faces) < len(few.faces) <= len(crumbs.faces) // 2


def test_each_piece_keeps_enough_to_be_seen_however_few_are_asked_for() -> None:
    """A floor of each one's share left none of them."""
    places = [_FAR + 3.0 * i for i in range(30)]
    for few_to_keep, left in ((64, 120), (60 * 30, 60 * 30)):
        few = reduced(joined([ball(place, 1.0, 12) for place in places]), few_to_keep)
        assert len(few.faces) == left
        at = few.vertices[few.faces].mean(axis=1)
        counts = [(np.linalg.norm(at - place, axis=1) < 1.0).sum() for place in places]
        assert min(counts) >= 4


def test_what_small_pieces_keep_comes_from_the_large_one() -> None:
    mesh = joined(
        [ball(_FAR + 300.0, 100.0, 60), *(ball(_FAR + 3.0 * i, 1.0, 11) for i in range(8))]
    )
    few = reduced(mesh, 150)
    assert len(few.faces) <= 150
    near = np.linalg.norm(few.vertices - _FAR, axis=1) < 50.0
    assert near[few.faces].all(axis=1).sum() >= 8 * 4


def test_a_mesh_that_is_small_enough_stays_as_it_is() -> None:
    mesh = sheet(10)
    assert reduced(mesh, len(mesh.faces)) is mesh


def test_a_large_piece_is_reduced_elsewhere_to_the_same(monkeypatch: pytest.MonkeyPatch) -> None:
    mesh = joined([sheet(), ball(_FAR, 1.0, 20)])
    here = reduced(mesh, len(mesh.faces) // 10)
    monkeypatch.setattr(reduction, "LARGE", 1000)
    told: list[float] = []
    elsewhere = reduced(mesh, len(mesh.faces) // 10, told.append)
    for name in ("vertices", "faces", "colors", "normals"):
        np.testing.assert_array_equal(getattr(elsewhere, name), getattr(here, name))
    assert told == sorted(told)
    assert told[-1] == 1.0


def test_a_long_reduction_is_told_of_and_can_be_cancelled(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    """A program that never ends in place of one that takes minutes."""
    script, pid = tmp_path / "endless.py", tmp_path / "pid"
    script.write_text(
        f"import os, time\nopen({str(pid)!r}, 'w').write(str(os.getpid()))\ntime.sleep(600)\n"
    )
    monkeypatch.setattr(decimation, "__file__", str(script))
    monkeypatch.setattr(reduction, "LARGE", 1000)
    told: list[float] = []

    def tell(done: float) -> None:
        told.append(done)
        if len(told) > 2 and pid.exists() and pid.read_text():
            raise Cancelled("Nobody wants it any more.")

    with pytest.raises(Cancelled):
        reduced(sheet(), 500, tell)
    assert sorted(set(told)) == told, "it moves"
    assert 0.0 < told[0] < told[-1] < 1.0
    with pytest.raises(ProcessLookupError):
        os.kill(int(pid.read_text()), 0)


def test_a_reduction_that_fails_elsewhere_says_so(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    script = tmp_path / "broken.py"
    script.write_text("raise MemoryError('no room')")
    monkeypatch.setattr(decimation, "__file__", str(script))
    monkeypatch.setattr(reduction, "LARGE", 1000)
    with pytest.raises(ToolError, match="no room"):
        reduced(sheet(), 500)
