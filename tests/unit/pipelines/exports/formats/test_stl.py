"""STL files, read back by trimesh and Open3D."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import numpy as np
import open3d
import pytest
import trimesh

from pipelines.exports.formats import stl
from pipelines.exports.frame import Frame
from tests.unit.pipelines.exports.formats import solids


@pytest.mark.parametrize("up", ["z", "y"])
def test_other_programs_read_the_solid_with_its_outside_out(
    tmp_path: Path, up: Literal["z", "y"]
) -> None:
    path = tmp_path / "mesh.stl"
    stl.write_mesh(path, solids.coloured(), Frame(up))
    wanted = solids.VERTICES if up == "z" else solids.y_up(solids.VERTICES)
    mesh = trimesh.load_mesh(path)
    np.testing.assert_allclose(mesh.bounds, [wanted.min(0), wanted.max(0)], atol=1e-6)
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(1.5 * 3.0 * 5.0 / 6.0)
    np.testing.assert_allclose(
        np.sort(mesh.face_normals, axis=0), np.sort(_normals(wanted), axis=0), atol=1e-6
    )
    read = open3d.io.read_triangle_mesh(path)
    np.testing.assert_allclose(read.get_min_bound(), wanted.min(0), atol=1e-6)
    header = path.read_bytes()[:80]
    assert not header.startswith(b"solid")
    assert f"+{up.upper()} up".encode() in header


def test_a_slicer_gets_the_millimetres_that_it_takes_a_unit_for(tmp_path: Path) -> None:
    path = tmp_path / "mesh.stl"
    stl.write_mesh(path, solids.coloured(), Frame(metric=True), in_millimetres=True)
    mesh = trimesh.load_mesh(path)
    wanted = 1000.0 * solids.VERTICES
    np.testing.assert_allclose(mesh.bounds, [wanted.min(0), wanted.max(0)], rtol=1e-6)
    length = np.linalg.norm(np.frombuffer(path.read_bytes()[84:96], "<f4"))
    assert length == pytest.approx(1.0), "normals have no unit"
    header = path.read_bytes()[:80].rstrip(b"\0")
    assert header.endswith(b"; 1 unit is 1 mm")
    with pytest.raises(ValueError, match="metres alone"):
        stl.write_mesh(path, solids.coloured(), Frame(), in_millimetres=True)


def test_a_face_without_area_does_not_spoil_the_file(tmp_path: Path) -> None:
    mesh = solids.coloured()
    mesh.faces[0] = [1, 1, 2]
    path = tmp_path / "mesh.stl"
    try:
        stl.write_mesh(path, mesh, Frame())
    finally:
        mesh.faces[0] = [0, 2, 1]
    assert len(path.read_bytes()) == 84 + 50 * 4
    assert np.isfinite(np.frombuffer(path.read_bytes()[84 : 84 + 48], "<f4")).all()


def _normals(vertices: np.ndarray) -> np.ndarray:
    corners = vertices[solids.FACES]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return normals / np.linalg.norm(normals, axis=1, keepdims=True)
