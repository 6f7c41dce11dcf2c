"""Depth and normals of training cameras, read back as other programs read them."""

from __future__ import annotations

import dataclasses
import io
import json
import zipfile
from pathlib import Path
from typing import Any

import ffmpeg
import numpy as np
import OpenEXR
import pytest
from PIL import Image

from pipelines.exports.formats import depth_pictures
from pipelines.options import OptionsError, resolve_options
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.trained_scene import TrainedScene
from pipelines.tools.ffmpeg import run_ffmpeg
from pipelines.workspace import Workspace
from tests.unit.pipelines.scene.synthetic_views import look_at, sphere_view
from tests.unit.pipelines.stages import tiny_job


def exr(data: bytes, folder: Path) -> dict[str, np.ndarray]:
    """The channels of a file."""
    (folder / "read.exr").write_bytes(data)
    with OpenEXR.File(str(folder / "read.exr"), separate_channels=True) as file:
        return {name: np.array(channel.pixels) for name, channel in file.channels().items()}


def test_every_view_is_there_in_all_formats_and_they_agree(job: Workspace, tmp_path: Path) -> None:
    summary = tiny_job.run(job, "views")["summary"]
    assert summary["num_views"] == 3
    assert {path.name for path in job.stage("views").iterdir()} == {"views.zip", "manifest.json"}
    with zipfile.ZipFile(job.stage("views") / "views.zip") as archive:
        files = {name: archive.read(name) for name in archive.namelist()}
    told = json.loads(files.pop("transforms.json"))
    expected = {
        f"{content}/{number:05d}.{ending}"
        for number in (1, 2, 3)
        for content, ending in (
            *(("rgb", "png"), ("depth", "png"), ("depth", "exr")),
            *(("normals", "png"), ("normals", "exr")),
        )
    }
    assert set(files) == expected
    assert {name for frame in told["frames"] for name in frame["files"]} == expected
    unit = told["depth_unit_scale_factor"]
    assert unit == summary["depth_unit"] == 0.001, "the world is metric"
    scene, beyond = TrainedScene.load(job.stage("train") / "model.zip"), 0
    for frame in told["frames"]:
        lens = Pinhole(*(frame[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")))
        pose = np.asarray(frame["transform_matrix"])[:3]
        view = scene.depth_view(lens, pose)
        with Image.open(io.BytesIO(files[frame["depth_file_path"]])) as picture:
            assert picture.mode == "I;16"
            steps = np.asarray(picture).astype(float)
        channels = exr(files[frame["depth_file_path"].replace("png", "exr")], tmp_path)
        exact = channels["Z"]
        for color in "RGB":
            np.testing.assert_array_equal(channels[color], exact)
        np.testing.assert_allclose(exact, view.z_depth, rtol=1e-5)
        assert (steps > 0).mean() > 0.5
        fits = exact / unit < 65_535.5
        np.testing.assert_array_equal(steps > 0, (exact > 0) & fits)
        assert np.abs(steps * unit - exact)[fits].max() <= 0.51 * unit
        beyond += (~fits).sum()
        with Image.open(io.BytesIO(files[frame["file_path"]])) as picture:
            assert np.abs(np.asarray(picture).astype(int) - view.rgb).max() <= 1
        name = frame["file_path"].replace("rgb", "normals").replace("png", "exr")
        normals = exr(files[name], tmp_path)
        length = np.sqrt(sum(normals[axis] ** 2 for axis in "XYZ"))
        assert ((length < 1e-6) | (np.abs(length - 1.0) < 1e-4)).all()
        assert (length > 0.5).any()
        towards = sum(normals[axis] * lens.directions()[..., k] for k, axis in enumerate("XYZ"))
        assert np.max(towards) <= 1e-5, "normals face the camera"
    assert summary["num_pixels_beyond_png"] == beyond < 100


def test_what_is_not_asked_for_is_not_written(job: Workspace) -> None:
    tiny_job.run(job, "views", contents=["depth"], formats=["png"], num_views=1, depth_unit=0.25)
    with zipfile.ZipFile(job.stage("views") / "views.zip") as archive:
        assert sorted(archive.namelist()) == ["depth/00001.png", "transforms.json"]
        told = json.loads(archive.read("transforms.json"))
    assert told["depth_unit_scale_factor"] == 0.25
    assert "file_path" not in told["frames"][0], "there is no such picture"


def test_a_world_without_metres_has_steps_that_fit_and_says_so(
    job: Workspace, monkeypatch: pytest.MonkeyPatch
) -> None:
    load = TrainedScene.load

    def unmeasured(*arguments: Any) -> TrainedScene:
        scene = load(*arguments)
        scene.cameras = dataclasses.replace(scene.cameras, metric=False)
        return scene

    monkeypatch.setattr(TrainedScene, "load", unmeasured)
    summary = tiny_job.run(job, "views", contents=["depth"], num_views=1)["summary"]
    assert summary["metric"] is False
    assert summary["depth_unit"] != 0.001
    assert summary["num_pixels_beyond_png"] == 0
    with zipfile.ZipFile(job.stage("views") / "views.zip") as archive:
        assert "length is unknown" in json.loads(archive.read("transforms.json"))["frame"]


def test_depth_is_seen_by_programs_that_know_colours_alone(tmp_path: Path) -> None:
    z = np.random.default_rng(0).uniform(0.1, 0.9, (48, 64)).astype(np.float32)
    path = tmp_path / "depth.exr"
    depth_pictures.write_exr(path, depth_pictures.as_seen(z))
    # As Blender does, ffmpeg takes the colours of a picture, and none where there are none.
    stream = ffmpeg.input(str(path)).output("pipe:", format="rawvideo", pix_fmt="gbrpf32le")
    seen: list[bytes] = []
    run_ffmpeg(stream, on_stdout=seen.append)
    planes = np.frombuffer(b"".join(seen), "<f4").reshape(3, 48, 64)
    np.testing.assert_array_equal(planes, np.broadcast_to(z, planes.shape))


def test_depths_beyond_16_bits_are_unknown_and_counted_and_near_ones_are_known(
    tmp_path: Path,
) -> None:
    z = np.array([[0.0, 0.0001, 0.5, 65.535, 65.6, 900.0]], np.float32)
    assert depth_pictures.write_png(tmp_path / "a.png", z, 0.001) == 2
    with Image.open(tmp_path / "a.png") as picture:
        np.testing.assert_array_equal(np.asarray(picture), [[0, 1, 500, 65535, 0, 0]])


@pytest.mark.parametrize("distance", [3.0, 40.0, 9000.0])
def test_the_unit_is_the_least_power_of_ten_that_has_room(distance: float) -> None:
    lens = Pinhole(32, 32, 32.0, 32.0, 16.0, 16.0)
    center = np.array([0.0, distance, 0.0])
    view = sphere_view(lens, look_at(np.zeros(3), center), center)
    unit = depth_pictures.unit_of([view])
    farthest = float(view.z_depth.max())
    if farthest > 0:
        assert 2.0 * farthest / unit <= 65_535 < 20.0 * farthest / unit
    assert np.isclose(np.log10(unit), round(np.log10(unit)))
    assert depth_pictures.unit_of([]) == 0.001


@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ({"contents": []}, "at least 1"),
        ({"contents": ["semantics"]}, "'rgb', 'depth' or 'normals'"),
        ({"formats": ["tiff"]}, "'png' or 'exr'"),
        ({"depth_unit": 0}, "greater than 0"),
        ({"long_side_px": 0}, "greater than or equal to 16"),
        ({"long_side_px": 100_000}, "less than or equal to 8192"),
    ],
)
def test_wrong_requests_are_refused_with_the_range(wrong: dict[str, Any], told: str) -> None:
    with pytest.raises(OptionsError) as caught:
        resolve_options("preview", {"views": wrong})
    assert told in str(caught.value)


def test_a_path_has_depth_and_normals_of_each_frame(job: Workspace, tmp_path: Path) -> None:
    place = {"look_at": [0.0, 0.0, 0.3]}
    keyframes = [{"position": [x, -1.5, 1.0], **place, "fov_deg": 50} for x in (-0.5, 0.5)]
    path = {"cameras": "path", "path": "keyframes", "keyframes": keyframes, "num_frames": 4}
    summary = tiny_job.run(job, "views", **path)["summary"]
    assert summary["num_views"] == 4
    with zipfile.ZipFile(job.stage("views") / "views.zip") as archive:
        told = json.loads(archive.read("transforms.json"))
        depth = exr(archive.read("depth/00001.exr"), tmp_path)["Z"]
    first = told["frames"][0]
    assert "of" not in first
    np.testing.assert_allclose(np.asarray(first["transform_matrix"])[:3, 3], [-0.5, -1.5, 1.0])
    fov = 2.0 * np.degrees(np.arctan(first["h"] / 2.0 / first["fl_y"]))
    assert fov == pytest.approx(50.0)
    scene = TrainedScene.load(job.stage("train") / "model.zip")
    lens = Pinhole(*(first[key] for key in ("w", "h", "fl_x", "fl_y", "cx", "cy")))
    view = scene.depth_view(lens, np.asarray(first["transform_matrix"])[:3])
    np.testing.assert_allclose(depth, view.z_depth, rtol=1e-5)


def test_views_of_a_wide_lens_are_refused() -> None:
    pose = np.eye(4).ravel().tolist()
    file = {"render_width": 64, "render_height": 32, "fps": 10, "camera_type": "equirectangular"}
    wish = {
        "path": "camera_path",
        "camera_path": {**file, "camera_path": [{"camera_to_world": pose, "fov": 50}]},
    }
    with pytest.raises(OptionsError) as caught:
        resolve_options("preview", {"views": wish})
    assert "views are perspective" in str(caught.value)
