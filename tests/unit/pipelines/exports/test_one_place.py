"""Every artifact of a job lies in one place: meshes of all formats, the cloud and the cameras."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import open3d
import pycolmap
import pytest
import trimesh
from PIL import Image
from pxr import Usd, UsdGeom

from pipelines.exports.formats import glb
from pipelines.exports.formats.ply import read_ply
from pipelines.exports.frame import back_to_world
from pipelines.nerf.training.checkpoint import DESCRIPTION_NAME
from pipelines.workspace import Workspace
from tests.gltf_validator import problems_of
from tests.unit.pipelines.exports.test_placement import MOVED
from tests.unit.pipelines.stages import tiny_job

# open3d's type stubs refuse its own documented calls, so its modules are used untyped.
_core: Any = open3d.core

FORMATS = ("glb", "ply", "obj", "stl", "usdz")


def _z_up(points: np.ndarray) -> np.ndarray:
    return np.stack([points[:, 0], -points[:, 2], points[:, 1]], axis=1)


def _by_trimesh(path: Path) -> np.ndarray:
    if path.name.endswith(".zip"):
        with zipfile.ZipFile(path) as archive:
            text = io.BytesIO(archive.read("mesh.obj"))
        return np.asarray(trimesh.load_mesh(text, file_type="obj", process=False).vertices)
    loaded: Any = trimesh.load_mesh(path, process=False)
    return np.asarray(loaded.vertices)


def _by_open3d(path: Path) -> np.ndarray:
    if path.name.endswith(".zip"):
        with zipfile.ZipFile(path) as archive:
            archive.extractall(path.parent / "obj")
        path = path.parent / "obj" / "mesh.obj"
    return np.asarray(open3d.io.read_triangle_mesh(path).vertices)


def _by_usd(path: Path) -> np.ndarray:
    stage = Usd.Stage.Open(str(path))
    (found,) = (prim for prim in stage.Traverse() if prim.IsA(UsdGeom.Mesh))
    return np.asarray(UsdGeom.Mesh(found).GetPointsAttr().Get(), np.float64)


READERS: tuple[tuple[str, Callable[[Path], np.ndarray], bool], ...] = (
    ("mesh.glb", _by_trimesh, True),
    ("mesh.glb", _by_open3d, True),
    ("mesh.ply", _by_trimesh, False),
    ("mesh.ply", _by_open3d, False),
    ("mesh.obj.zip", _by_trimesh, False),
    ("mesh.obj.zip", _by_open3d, False),
    ("mesh.stl", _by_trimesh, False),
    ("mesh.stl", _by_open3d, False),
    ("mesh.usdz", _by_usd, True),
)
"""File, who reads it, and whether it is Y up by custom."""


@pytest.mark.parametrize("up", ["auto", "z", "y"])
def test_all_meshes_have_the_same_bounds_in_other_programs(job: Workspace, up: str) -> None:
    unit = "millimetre" if up == "auto" else "frame"
    summary = tiny_job.run(job, "mesh", formats=FORMATS, up_axis=up, stl_unit=unit)["summary"]
    folder = job.stage("mesh")
    assert summary["formats"] == list(FORMATS)
    assert problems_of(folder / "mesh.glb") == []
    wanted = read_ply(folder / "mesh.ply").points
    wanted = _z_up(wanted) if up == "y" else wanted
    for name, read, always_y in READERS:
        found = read(folder / name)
        if name == "mesh.stl" and unit == "millimetre":
            found = found / 1000.0
        if always_y or up == "y" or (up == "auto" and name == "mesh.obj.zip"):
            found = _z_up(found)
        for end in (np.min, np.max):
            off = np.abs(end(found, axis=0) - end(wanted, axis=0)).max()
            assert off < summary["voxel"], f"{name} by {read.__name__} is {off:g} off"


@pytest.mark.parametrize("frame", ["gravity", "source"])
def test_the_meshs_surface_the_cloud_and_the_cameras_are_where_the_photos_saw_them(
    job: Workspace, tmp_path: Path, frame: str
) -> None:
    _came_from_another_world(job)
    for stage in ("mesh", "pointcloud", "cameras"):
        summary = tiny_job.run(job, stage, frame=frame)["summary"]
        assert (summary["frame"]["name"], summary["frame"]["metric"]) == (frame, frame == "gravity")
    mesh = open3d.t.io.read_triangle_mesh(str(job.stage("mesh") / "mesh.ply"))
    caster: Any = open3d.t.geometry.RaycastingScene()
    caster.add_triangles(mesh)
    cloud = read_ply(job.stage("pointcloud") / "pointcloud.ply")
    points = cloud.points.astype(np.float64)
    away = caster.compute_distance(_core.Tensor(points.astype(np.float32))).numpy()
    assert np.median(away) < 0.01 * float(np.linalg.norm(np.ptp(points, axis=0)))
    # What reads the mesh back finds it in the world of cameras.json, whatever the frame.
    read = glb.read_mesh(job.stage("mesh") / "mesh.glb").vertices
    back = back_to_world(read_ply(job.stage("mesh") / "mesh.ply").points, cloud.from_world)
    for end in (np.min, np.max):
        np.testing.assert_allclose(end(read, axis=0), end(back, axis=0), atol=1e-4)
    own = summary["frame"]["from_world"]
    assert cloud.from_world is None or cloud.from_world.tolist() == own
    with zipfile.ZipFile(job.stage("cameras") / "colmap.zip") as archive:
        archive.extractall(tmp_path / "colmap")
    model: Any = pycolmap.Reconstruction(tmp_path / "colmap" / "sparse" / "0")
    off: list[float] = []
    by_chance: list[float] = []
    there: list[float] = []
    beside: list[float] = []
    for image in model.images.values():
        center, lens = image.projection_center(), model.cameras[image.camera_id]
        with Image.open(job.images_root / "images" / image.name) as opened:
            photo = np.asarray(opened.convert("RGB")).astype(float)
        rays = np.concatenate([np.broadcast_to(center, points.shape), points - center], axis=1)
        met = caster.cast_rays(_core.Tensor(rays.astype(np.float32)))["t_hit"].numpy()
        # Farther from the mesh a point of this blurred model is no surface, and has any colour.
        visible = np.flatnonzero(np.abs(met - 1.0) < 0.02)[::3]
        pixels = [image.project_point(points[index]) for index in visible]
        inside = [
            pixel is not None and 0 <= pixel[0] < lens.width and 0 <= pixel[1] < lens.height
            for pixel in pixels
        ]
        at = np.asarray([p for p, seen in zip(pixels, inside, strict=True) if seen]).astype(int)
        assert cloud.colors is not None
        wanted = cloud.colors[visible[inside]].astype(float)
        seen = photo[at[:, 1], at[:, 0]]
        elsewhere = photo[at[:, 0] % lens.height, at[:, 1] % lens.width]
        off.append(np.abs(seen - wanted).mean())
        by_chance.append(np.abs(elsewhere - wanted).mean())
        aside = photo[at[:, 1], (at[:, 0] + lens.width // 6) % lens.width]
        there.append(_likeness(seen, wanted))
        beside.append(_likeness(aside, wanted))
    # By how this blurred model keeps light it is .48 to .51, by the number of threads that train.
    assert np.mean(off) < 0.55 * np.mean(by_chance), (np.mean(off), np.mean(by_chance))
    # A sixth of the picture beside it, photos look like something else.
    assert np.mean(there) > 0.6
    assert np.mean(beside) < 0.5 * np.mean(there)


def _likeness(photo: np.ndarray, cloud: np.ndarray) -> float:
    """Correlation of colours, which a blurred model keeps where it does not keep their range."""
    return float(np.corrcoef(photo.ravel(), cloud.ravel())[0, 1])


def _came_from_another_world(job: Workspace) -> None:
    """As if the capture's own world had been turned, moved and scaled into the one of the job."""
    path = job.stage("train") / "model.zip"
    with zipfile.ZipFile(path) as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    description = json.loads(files[DESCRIPTION_NAME])
    description["extras"]["cameras"]["notes"] = MOVED
    files[DESCRIPTION_NAME] = json.dumps(description).encode()
    with zipfile.ZipFile(path, "w", zipfile.ZIP_STORED) as archive:
        for name, data in files.items():
            archive.writestr(name, data)
