"""PLY round trips, and files that other programs write."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.exports.formats.ply import read_ply, write_mesh, write_points
from pipelines.exports.mesh import TriangleMesh


def _cloud(num: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    rng = np.random.default_rng(7)
    points = rng.normal(size=(num, 3)).astype(np.float32)
    normals = rng.normal(size=(num, 3))
    normals = (normals / np.linalg.norm(normals, axis=1, keepdims=True)).astype(np.float32)
    colors = rng.integers(0, 256, size=(num, 3)).astype(np.uint8)
    return points, colors, normals


def test_points_come_back_with_colors_and_normals(tmp_path: Path) -> None:
    points, colors, normals = _cloud(1000)
    write_points(tmp_path / "a.ply", points, colors, normals)
    back = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.points, points)
    np.testing.assert_array_equal(back.colors, colors)
    np.testing.assert_array_equal(back.normals, normals)
    assert back.faces.shape == (0, 3)


def test_bare_points_have_neither_colors_nor_normals(tmp_path: Path) -> None:
    points, _, _ = _cloud(5)
    write_points(tmp_path / "a.ply", points.astype(np.float64))
    back = read_ply(tmp_path / "a.ply")
    np.testing.assert_array_equal(back.points, points)
    assert back.colors is None
    assert back.normals is None


def test_no_points_at_all_can_be_written_and_read(tmp_path: Path) -> None:
    write_points(tmp_path / "a.ply", np.zeros((0, 3), np.float32), np.zeros((0, 3), np.uint8))
    assert read_ply(tmp_path / "a.ply").points.shape == (0, 3)


def test_a_mesh_comes_back_with_its_faces(tmp_path: Path) -> None:
    vertices, colors, normals = _cloud(50)
    faces = np.random.default_rng(1).integers(0, 50, size=(80, 3), dtype=np.int32)
    write_mesh(tmp_path / "m.ply", TriangleMesh(vertices, faces, colors / 255.0, normals))
    back = read_ply(tmp_path / "m.ply")
    np.testing.assert_array_equal(back.points, vertices)
    np.testing.assert_array_equal(back.faces, faces)
    np.testing.assert_array_equal(back.colors, colors)
    np.testing.assert_array_equal(back.normals, normals)


def test_quads_become_two_triangles(tmp_path: Path) -> None:
    header = (
        "ply\nformat binary_little_endian 1.0\ncomment by hand\nelement vertex 5\n"
        "property double x\nproperty double y\nproperty double z\nproperty uchar quality\n"
        "element face 2\nproperty list uchar uint vertex_index\nend_header\n"
    )
    vertices = np.zeros(5, dtype=[("p", "<f8", (3,)), ("q", "u1")])
    vertices["p"] = np.arange(15).reshape(5, 3)
    body = (
        vertices.tobytes()
        + bytes([4])
        + np.array([0, 1, 2, 3], "<u4").tobytes()
        + bytes([3])
        + np.array([2, 3, 4], "<u4").tobytes()
    )
    (tmp_path / "q.ply").write_bytes(header.encode() + body)
    back = read_ply(tmp_path / "q.ply")
    np.testing.assert_array_equal(back.points, np.arange(15).reshape(5, 3))
    assert back.faces.tolist() == [[0, 1, 2], [0, 2, 3], [2, 3, 4]]


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    points, colors, _ = _cloud(10)
    write_points(tmp_path / "a.ply", points, colors)
    whole = (tmp_path / "a.ply").read_bytes()
    (tmp_path / "a.ply").write_bytes(whole[:-1])
    with pytest.raises(ValueError, match="cut short"):
        read_ply(tmp_path / "a.ply")


@pytest.mark.parametrize(
    ("content", "problem"),
    [
        (b"solid stl\n", "not a PLY"),
        (b"ply\nformat ascii 1.0\nend_header\n", "ascii"),
        (b"ply\nformat binary_little_endian 1.0\nelement vertex 1\nproperty half x\n", "half"),
        (b"ply\nformat binary_little_endian 1.0\n", "bad header line"),
        (b"ply\nformat binary_little_endian 1.0\nend_header\n", "no vertex positions"),
    ],
)
def test_other_files_are_refused_with_the_reason(
    tmp_path: Path, content: bytes, problem: str
) -> None:
    (tmp_path / "a.ply").write_bytes(content)
    with pytest.raises(ValueError, match=problem):
        read_ply(tmp_path / "a.ply")


def test_what_does_not_fit_together_is_not_written(tmp_path: Path) -> None:
    points, colors, normals = _cloud(4)
    with pytest.raises(ValueError, match="colors"):
        write_points(tmp_path / "a.ply", points, colors[:3])
    with pytest.raises(ValueError, match="uint8"):
        write_points(tmp_path / "a.ply", points, colors.astype(np.float32))
    with pytest.raises(ValueError, match="normals"):
        write_points(tmp_path / "a.ply", points, colors, normals[:, :2])
    with pytest.raises(ValueError, match="vertices 0 to 4"):
        write_mesh(tmp_path / "a.ply", TriangleMesh(points, np.array([[0, 1, 4]]), points, normals))
    assert not list(tmp_path.iterdir())
