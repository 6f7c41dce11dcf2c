"""The delivered mesh, filmed."""

from __future__ import annotations

import zipfile
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.errors import ExportError
from pipelines.exports.formats import glb
from pipelines.exports.mesh import TriangleMesh
from pipelines.options import OptionsError, resolve_options
from pipelines.scene.cameras_file import CamerasFile
from pipelines.tools.ffmpeg import probe
from pipelines.workspace import Workspace
from tests.unit.pipelines.stages import tiny_job


def still(job: Workspace, **changes: Any) -> dict[str, Any]:
    """Options of a flight that stays at one of the captured poses."""
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    image = cameras.images[4]
    lens = cameras.cameras[image.camera]
    pose = np.vstack([image.world_from_camera, [0.0, 0.0, 0.0, 1.0]]).ravel().tolist()
    fov = float(np.degrees(2.0 * np.arctan(lens.height / (2.0 * lens.fl_y))))
    file = {"render_width": lens.width, "render_height": lens.height, "fps": 10}
    frames = [{"camera_to_world": pose, "fov": fov}] * 2
    return {"path": "camera_path", "camera_path": {**file, "camera_path": frames, **changes}}


@pytest.mark.parametrize("frame", ["gravity", "normalised"])
def test_the_mesh_is_seen_where_the_scene_is(job: Workspace, frame: str) -> None:
    tiny_job.run(job, "mesh", formats=("glb",), frame=frame)
    summary = tiny_job.run(job, "meshvideo", outputs=("rgb", "mesh"), codec="png", **still(job))[
        "summary"
    ]
    with zipfile.ZipFile(job.stage("meshvideo") / "mesh-video-frames.zip") as archive:
        assert len(archive.namelist()) == 2
        both = np.asarray(Image.open(archive.open("side_by_side/00002.png"))).astype(float)
    assert (summary["width"], summary["height"]) == both.shape[1::-1]
    rgb, mesh = np.split(both, 2, axis=1)
    covered = np.abs(mesh - 31.0).max(axis=-1) > 0
    assert covered.mean() > 0.2
    right = np.abs(rgb - mesh)[covered].mean()
    assert right < 0.6 * np.abs(rgb - mesh[:, ::-1])[covered].mean()


def test_it_shows_the_delivered_file_from_any_lens(job: Workspace) -> None:
    """A red ball round the camera in place of the mesh fills each picture."""
    tiny_job.run(job, "mesh", formats=("glb",))
    cameras = CamerasFile.load(job.stage("train") / "cameras.json")
    eye = np.asarray(cameras.images[4].world_from_camera)[:, 3]
    corners = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]], float) * 5.0
    faces = np.array([[0, 1, 2], [0, 3, 1], [0, 2, 3], [1, 3, 2]], np.int32)
    red = np.tile([1.0, 0.0, 0.0], (4, 1))
    path = job.stage("mesh") / "mesh.glb"
    glb.write_mesh(path, TriangleMesh(corners + eye, faces, red, corners))
    for kind, size in (("fisheye", (64, 64)), ("equirectangular", (64, 32))):
        options = still(job, camera_type=kind, render_width=size[0], render_height=size[1])
        tiny_job.run(job, "meshvideo", **options, codec="png")
        with zipfile.ZipFile(job.stage("meshvideo") / "mesh-video-frames.zip") as archive:
            picture = np.asarray(Image.open(archive.open("mesh/00001.png")))
        middle = picture[size[1] // 2, size[0] // 2]
        np.testing.assert_allclose(middle, [255, 0, 0], atol=2)
        if kind == "equirectangular":
            assert (np.abs(picture.astype(int) - [255, 0, 0]) <= 2).all()


def test_alone_it_is_a_video(job: Workspace) -> None:
    tiny_job.run(job, "mesh", formats=("glb",))
    tiny_job.run(job, "meshvideo", num_frames=8, long_side_px=64)
    info = probe(job.stage("meshvideo") / "mesh-video.mp4")
    assert (info.codec, info.width, info.height) == ("h264", 36, 64)


def test_a_job_without_a_mesh_is_told_so(job: Workspace) -> None:
    with pytest.raises(ExportError) as caught:
        tiny_job.run(job, "meshvideo", num_frames=8, long_side_px=64)
    assert caught.value.code == "no_mesh"


def test_what_has_no_mesh_in_it_is_another_kind() -> None:
    with pytest.raises(OptionsError) as caught:
        resolve_options("preview", {"meshvideo": {"outputs": ["rgb"]}})
    assert "must have mesh among them" in str(caught.value)
