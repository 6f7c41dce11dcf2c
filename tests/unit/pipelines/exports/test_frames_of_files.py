"""Files of one frame lie in one place, whichever it is, and say which it is and how to get back."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import laspy
import numpy as np
import open3d
import pycolmap
import pytest
import trimesh
from numpy.typing import NDArray
from pxr import Sdf, Usd, UsdGeom

from pipelines.exports.catalogue import get_export
from pipelines.exports.formats import glb, las, obj, ply, usdz, xyz
from pipelines.exports.formats.glb import GlbStyle
from pipelines.exports.frame import WORLDS, FrameName, back_to_world, matrix_of
from pipelines.exports.kinds.cameras import CamerasOptions
from pipelines.exports.mesh import TriangleMesh, unit_normals
from pipelines.exports.placement import Placement, placement_of, to_world
from pipelines.scene.cameras_file import CamerasFile
from tests.gltf_validator import problems_of
from tests.unit.pipelines.captures.archives import context
from tests.unit.pipelines.exports.formats import solids
from tests.unit.pipelines.exports.test_placement import MOVED, TURN, around, centers

Floats = NDArray[np.float64]
NAMES: tuple[FrameName, ...] = get_args(FrameName)
MAP = {"applied_transform": np.column_stack([np.eye(3), [-5e5, -4e6, -120.0]]).tolist()}
"""Of a capture in map coordinates, 4,000 km from the origin of its own world."""


@dataclass
class Scene:
    """Of a trained scene what the export of cameras asks for."""

    cameras: CamerasFile


def _usd(path: Path) -> tuple[Floats, str]:
    stage = Usd.Stage.Open(str(path))
    made = UsdGeom.Mesh(stage.GetPrimAtPath("/scene/mesh"))
    points = np.asarray(made.GetPointsAttr().Get(), np.float64)
    moved = np.asarray(UsdGeom.XformCache().GetLocalToWorldTransform(made.GetPrim()))
    comment: str = Sdf.Layer.FindOrOpen(str(path)).comment
    return points @ moved[:3, :3] + moved[3, :3], comment


def _obj(path: Path) -> tuple[Floats, str]:
    with zipfile.ZipFile(path) as archive:
        lines = archive.read("mesh.obj").decode().splitlines()
    rows = [[float(word) for word in line.split()[1:4]] for line in lines if line.startswith("v ")]
    return np.asarray(rows), ";".join(line for line in lines if line.startswith("#"))


def _glb(path: Path) -> tuple[Floats, str]:
    document, _ = glb._parts(path)
    extras = document["asset"]["extras"]
    rows = np.asarray(extras.get("from_world", [])).reshape(-1).tolist()
    told = f"{extras['frame']};from_world {' '.join(map(repr, rows))}"
    return np.asarray(trimesh.load_mesh(path, process=False).vertices, np.float64), told


def _ply(path: Path) -> tuple[Floats, str]:
    header = path.read_bytes().split(b"end_header")[0].decode().splitlines()
    told = ";".join(line.removeprefix("comment ") for line in header)
    legacy: Any = open3d.io.read_triangle_mesh(path)
    return np.asarray(legacy.vertices), told


def _las(path: Path) -> tuple[Floats, str]:
    cloud = laspy.read(path)
    (record,) = (one for one in cloud.header.vlrs if one.user_id == "nerfworks")
    return np.asarray(cloud.xyz), record.record_data_bytes().decode()


def _xyz(path: Path) -> tuple[Floats, str]:
    return np.loadtxt(path)[:, :3], path.read_text("ascii").splitlines()[0]


READERS: dict[str, Callable[[Path], tuple[Floats, str]]] = {
    "mesh.glb": _glb,
    "mesh.ply": _ply,
    "mesh.obj.zip": _obj,
    "mesh.usdz": _usd,
    "points.las": _las,
    "points.xyz": _xyz,
}


def _write(folder: Path, place: Placement, mesh: TriangleMesh) -> None:
    frame, there = place.frame(), place.mesh(mesh)
    glb.write_mesh(folder / "mesh.glb", there, frame)
    ply.write_mesh(folder / "mesh.ply", there, frame)
    obj.write_mesh(folder / "mesh.obj.zip", there, frame)
    usdz.write_mesh(folder / "mesh.usdz", there, frame)
    colors = np.zeros(there.vertices.shape, np.uint8)
    las.write_points(folder / "points.las", there.vertices, colors, there.normals, frame)
    xyz.write_points(folder / "points.xyz", there.vertices, colors, there.normals, frame)


def _told_matrix(text: str) -> Floats:
    """The one that a file tells, in words."""
    found = [matrix_of(part.strip(" #")) for part in text.split(";")]
    (matrix,) = (one for one in found if one is not None)
    return matrix


@pytest.mark.parametrize("notes", [MOVED, MAP], ids=["moved", "map"])
@pytest.mark.parametrize("name", ["source", "normalised"])
def test_every_file_leads_back_to_the_world_by_itself(
    tmp_path: Path, name: FrameName, notes: dict[str, Any]
) -> None:
    place, mesh = placement_of(name, around(notes=notes)), solids.coloured()
    _write(tmp_path, place, mesh)
    for file, read in READERS.items():
        there, told = read(tmp_path / file)
        back = back_to_world(there, _told_matrix(told))
        np.testing.assert_allclose(back, mesh.vertices, atol=2e-5, err_msg=file)
        assert WORLDS[name] in told, file
    assert problems_of(tmp_path / "mesh.glb") == []
    for style in (GlbStyle(), GlbStyle(quantized=True)):
        glb.write_mesh(tmp_path / "again.glb", place.mesh(mesh), place.frame(), style)
        again = glb.read_mesh(tmp_path / "again.glb")
        np.testing.assert_allclose(again.vertices, mesh.vertices, atol=1e-4)
        wanted = unit_normals(solids.NORMALS[:3])  # the last one has no direction
        np.testing.assert_allclose(again.normals[:3], wanted, atol=0.02)
    read_back = ply.read_ply(tmp_path / "mesh.ply")
    assert read_back.from_world is not None
    found = back_to_world(read_back.points, read_back.from_world)
    np.testing.assert_allclose(found, mesh.vertices, atol=2e-5)


def test_the_world_itself_is_written_as_before(tmp_path: Path) -> None:
    _write(tmp_path, placement_of("gravity", around(notes=MAP)), solids.coloured())
    for file, read in READERS.items():
        _, told = read(tmp_path / file)
        assert not any(matrix_of(part.strip(" #")) is not None for part in told.split(";")), file
        assert "up, the world of cameras.json; 1 unit is 1 metre" in told, file
    assert b"property float x" in (tmp_path / "mesh.ply").read_bytes()


@pytest.mark.parametrize(
    "up", [(0, 0, 1), (0, 1, 0), (0, -1, 0), (1, 0, 0), (-1, 0, 0), (0, 0, -1)]
)
def test_what_is_up_in_the_captures_own_world_is_up_in_a_glb(
    tmp_path: Path, up: tuple[int, int, int]
) -> None:
    """Whatever axis the capture's own world has for it; the file stays right-handed."""
    axis = np.asarray(up, np.float64)
    other = np.roll(axis, 1)
    turn = np.stack([other, np.cross(axis, other), axis])
    notes = {"applied_transform": np.column_stack([turn, np.zeros(3)]).tolist()}
    place, mesh = placement_of("source", around(notes=notes)), solids.coloured()
    np.testing.assert_allclose(place.directions(np.array([[0.0, 0.0, 1.0]])), [axis], atol=1e-12)
    glb.write_mesh(tmp_path / "mesh.glb", place.mesh(mesh), place.frame())
    matrix = _told_matrix(_glb(tmp_path / "mesh.glb")[1])
    np.testing.assert_allclose(matrix[:, 2], [0.0, 1.0, 0.0], atol=1e-12)
    assert np.linalg.det(matrix[:, :3]) == pytest.approx(1.0)
    back = back_to_world(_glb(tmp_path / "mesh.glb")[0], matrix)
    np.testing.assert_allclose(back, mesh.vertices, atol=1e-5)


@pytest.mark.parametrize("name", NAMES)
def test_cameras_lead_back_to_one_world(tmp_path: Path, name: FrameName) -> None:
    cameras = around(notes=MOVED)
    ctx = context(tmp_path, "cameras")
    made = get_export("cameras").run(Scene(cameras), CamerasOptions(frame=name), ctx)  # type: ignore[arg-type]
    assert made["frame"]["name"] == name
    with zipfile.ZipFile(ctx.out / "colmap.zip") as archive:
        archive.extractall(tmp_path / "colmap")
    model = pycolmap.Reconstruction(str(tmp_path / "colmap" / "sparse" / "0"))
    by_name = {image.name: image.projection_center() for image in model.images.values()}
    content = json.loads((ctx.out / "transforms.json").read_text("utf-8"))
    frusta = ply.read_ply(ctx.out / "cameras.ply")
    found = {
        "colmap.zip": np.array([by_name[image.file.split("/")[1]] for image in cameras.images]),
        "transforms.json": np.array([one["transform_matrix"] for one in content["frames"]])[
            :, :3, 3
        ],
        "cameras.ply": frusta.points[::6],
    }
    for file, there in found.items():
        np.testing.assert_allclose(to_world(there, made), centers(cameras), atol=1e-5, err_msg=file)
    assert (tmp_path / "colmap" / "frame.txt").exists() == (name != "gravity")
    # A reader takes +Z for up where the file says so, and looks for it where it does not.
    assert ("orientation_override" in content) == (name != "source")
    if name == "gravity":
        assert frusta.from_world is None
        assert "from_world" not in content
        return
    told = (tmp_path / "colmap" / "frame.txt").read_text("ascii").replace("\n", ";")
    for matrix in (_told_matrix(told), frusta.from_world, content["from_world"]):
        np.testing.assert_array_equal(matrix, made["frame"]["from_world"])


def test_a_world_that_leans_is_not_said_to_stand() -> None:
    lean = np.array([[1.0, 0.0, 0.0], [0.0, 0.8, -0.6], [0.0, 0.6, 0.8]])
    notes = {"applied_transform": np.column_stack([lean, np.zeros(3)]).tolist()}
    frame = placement_of("source", around(notes=notes)).frame()
    assert not frame.is_upright()
    assert "up" not in frame.note()
    assert placement_of("normalised", around(notes=notes)).frame().is_upright()
    assert replace(frame, from_world=None).is_upright()
    assert (
        not placement_of("source", around(notes={"applied_transform": _rigid(TURN)}))
        .frame()
        .is_upright()
    )


def _rigid(turn: Floats) -> list[list[float]]:
    matrix: list[list[float]] = np.column_stack([turn, np.zeros(3)]).tolist()
    return matrix
