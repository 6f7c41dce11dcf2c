"""OBJ archives, read back by trimesh and Open3D."""

from __future__ import annotations

import zipfile
from pathlib import Path
from typing import Any, Literal

import numpy as np
import open3d
import pytest
import trimesh

from pipelines.errors import Cancelled
from pipelines.exports.formats import numbers, obj
from pipelines.exports.frame import Frame
from pipelines.exports.mesh import TexturedMesh, TriangleMesh, unit_normals
from pipelines.exports.surface.watertight import is_closed
from pipelines.exports.texture.unwrap import unwrap
from tests.unit.pipelines.exports.formats import solids


def unpacked(folder: Path, mesh: TriangleMesh | TexturedMesh, up: Literal["z", "y"] = "z") -> Path:
    """The archive of a mesh, unpacked; its OBJ."""
    obj.write_mesh(folder / "mesh.obj.zip", mesh, Frame(up, metric=True))
    with zipfile.ZipFile(folder / "mesh.obj.zip") as archive:
        archive.extractall(folder / "out")
    return folder / "out" / "mesh.obj"


@pytest.mark.parametrize("up", ["z", "y"])
def test_a_textured_mesh_shows_its_picture_the_right_way_up(
    tmp_path: Path, up: Literal["z", "y"]
) -> None:
    path = unpacked(tmp_path, solids.textured(), up)
    wanted = solids.VERTICES if up == "z" else solids.y_up(solids.VERTICES)
    mesh: Any = trimesh.load_mesh(path, process=False)
    np.testing.assert_allclose(mesh.bounds, [wanted.min(0), wanted.max(0)], atol=1e-6)
    shown = mesh.visual.to_color().vertex_colors[:, :3]
    for point, color in zip(wanted, solids.QUARTERS.values(), strict=True):
        (index,) = np.flatnonzero(np.abs(mesh.vertices - point).max(axis=1) < 1e-6)[:1]
        assert tuple(shown[index]) == color
    assert f"+{up.upper()} up" in path.read_text().splitlines()[0]
    assert "1 unit is 1 metre" in path.read_text().splitlines()[0]
    read = open3d.io.read_triangle_mesh(path, enable_post_processing=True)
    assert read.has_triangle_uvs()
    np.testing.assert_allclose(read.get_max_bound(), wanted.max(0), atol=1e-6)
    assert np.asarray(read.textures[0]).shape == (64, 64, 3)


def test_a_mesh_without_a_picture_keeps_its_vertices_colours(tmp_path: Path) -> None:
    path = unpacked(tmp_path, solids.coloured())
    read = open3d.io.read_triangle_mesh(path)
    corners = np.asarray(read.triangles)
    # Open3D numbers vertices as faces name them.
    for values, wanted in (
        (read.vertices, solids.VERTICES),
        (read.vertex_colors, solids.COLORS),
        (read.vertex_normals, unit_normals(solids.NORMALS)),
    ):
        np.testing.assert_allclose(np.asarray(values)[corners], wanted[solids.FACES], atol=1e-4)
    assert sorted(entry.name for entry in path.parent.iterdir()) == ["mesh.mtl", "mesh.obj"]
    assert "map_Kd" not in (path.parent / "mesh.mtl").read_text()


def test_a_closed_surface_with_a_picture_stays_closed(tmp_path: Path) -> None:
    """A ball, cut into charts for its picture, whose seams are in no index of a place."""
    ball = trimesh.creation.icosphere(3)
    faces = np.asarray(ball.faces, np.int32)
    chart = unwrap(ball.vertices, faces, np.full(len(faces), 100.0), 1024)
    assert len(chart.vertex) > 1.2 * len(ball.vertices), "there are seams"
    picture = np.zeros((chart.size[1], chart.size[0], 3), np.uint8)
    painted = TexturedMesh(
        np.asarray(ball.vertices)[chart.vertex],
        chart.faces,
        np.asarray(ball.vertex_normals)[chart.vertex],
        chart.uv / np.array(chart.size),
        picture,
    )
    path = unpacked(tmp_path, painted)
    lines = [line.split() for line in path.read_text().splitlines()]
    places = np.array([words[1:] for words in lines if words[0] == "v"], float)
    named = [[word.split("/") for word in words[1:]] for words in lines if words[0] == "f"]
    corners = np.array(named, int) - 1
    assert is_closed(corners[..., 0])
    assert len(places) == len(ball.vertices)
    np.testing.assert_allclose(places[corners[..., 0]], painted.vertices[painted.faces], atol=1e-8)
    textures = np.array([words[1:] for words in lines if words[0] == "vt"], float)
    wanted = painted.uv[painted.faces] * [1.0, -1.0] + [0.0, 1.0]
    np.testing.assert_allclose(textures[corners[..., 1]], wanted, atol=1e-8)
    normals = np.array([words[1:] for words in lines if words[0] == "vn"], float)
    wanted = painted.normals[painted.faces]
    np.testing.assert_allclose(normals[corners[..., 2]], wanted, atol=1e-6)
    by_place: Any = trimesh.load_mesh(path, maintain_order=True, process=False)
    assert len(by_place.faces) == len(faces)
    read = open3d.io.read_triangle_mesh(path)
    read.remove_duplicated_vertices()
    assert read.is_watertight()


def test_more_rows_than_are_written_at_once_are_all_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numbers, "_ROWS", 3)
    mesh = trimesh.load_mesh(unpacked(tmp_path, solids.coloured()), process=False)
    assert mesh.vertices.shape == (4, 3)
    np.testing.assert_array_equal(mesh.faces, solids.FACES)


def test_it_tells_how_far_it_is_and_stops_where_it_is_cancelled(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(numbers, "_ROWS", 2)
    told: list[float] = []
    obj.write_mesh(tmp_path / "mesh.obj.zip", solids.textured(), Frame(), told.append)
    assert told == sorted(told)
    assert told[-1] == 1.0
    assert len(told) == 2 + 2 + 2 + 2 + 1, "places, their places in the picture, normals, faces"

    def cancel(done: float) -> None:
        raise Cancelled("The job was cancelled.")

    with pytest.raises(Cancelled):
        obj.write_mesh(tmp_path / "mesh.obj.zip", solids.textured(), Frame(), cancel)


def test_the_same_mesh_gives_the_same_bytes(tmp_path: Path) -> None:
    for name in ("a", "b"):
        obj.write_mesh(tmp_path / name, solids.textured(), Frame())
    assert (tmp_path / "a").read_bytes() == (tmp_path / "b").read_bytes()
