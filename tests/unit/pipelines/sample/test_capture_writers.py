"""The test captures are what their formats say, and their cameras fit their pictures."""

from __future__ import annotations

import io
import json
import subprocess
import zipfile
from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageOps
from scipy.spatial.transform import Rotation

from pipelines.sample.scene import pose_matrix, render
from pipelines.scene.cameras_file import CamerasFile
from pipelines.tools.ffmpeg import ffmpeg_executable
from tests.capture_writers import (
    write_hdr_hevc,
    write_nerfstudio,
    write_photos,
    write_polycam,
    write_record3d,
)


def _assert_pictures_fit(archive: zipfile.ZipFile, truth: CamerasFile) -> None:
    for image in truth.images:
        stored = ImageOps.exif_transpose(Image.open(io.BytesIO(archive.read(image.file))))
        expected = render(truth.cameras[image.camera], pose_matrix(image)).astype(float)
        assert np.abs(np.asarray(stored).astype(float) - expected).mean() < 6.0


def test_polycam_poses_are_in_arkits_frame_and_pair_by_name(tmp_path: Path) -> None:
    truth = write_polycam(tmp_path / "p.zip", num=7, width=160)
    with zipfile.ZipFile(tmp_path / "p.zip") as archive:
        _assert_pictures_fit(archive, truth)
        assert len(truth.images) == 5
        for image in truth.images:
            name = image.file.replace("corrected_images", "corrected_cameras")
            camera = json.loads(archive.read(name.replace(".jpg", ".json")))
            rows = np.array([[camera[f"t_{r}{c}"] for c in range(4)] for r in range(3)])
            assert rows[[2, 0, 1]] == pytest.approx(pose_matrix(image))
            assert int(Path(image.file).stem) == camera["timestamp"]
        depth = next(n for n in archive.namelist() if n.startswith("keyframes/depth/"))
        metres = np.asarray(Image.open(io.BytesIO(archive.read(depth)))) / 1000.0
        assert metres.shape == (30, 40)
        assert 0.8 < metres[metres > 0].min() < 2.0


def test_record3d_numbers_name_poses_though_one_is_missing(tmp_path: Path) -> None:
    truth = write_record3d(tmp_path / "r.zip", num=12, long_side_px=160)
    with zipfile.ZipFile(tmp_path / "r.zip") as archive:
        _assert_pictures_fit(archive, truth)
        metadata = json.loads(archive.read("EXR_RGBD/metadata.json"))
    assert len(metadata["poses"]) == 12
    assert len(truth.images) == 11
    camera = truth.cameras[0]
    k = np.array(metadata["K"]).reshape(3, 3).T
    assert k[0, 2] == camera.cx
    assert k[1, 2] == camera.cy
    for image in truth.images:
        row = metadata["poses"][int(Path(image.file).stem)]
        expected = pose_matrix(image)
        assert Rotation.from_quat(row[:4]).as_matrix()[[2, 0, 1]] == pytest.approx(
            expected[:, :3], abs=1e-9
        )
        assert np.array(row[4:])[[2, 0, 1]] == pytest.approx(expected[:, 3])


def test_nerfstudio_lists_a_picture_that_is_not_there(tmp_path: Path) -> None:
    truth = write_nerfstudio(tmp_path / "n.zip", num=6, long_side_px=160)
    with zipfile.ZipFile(tmp_path / "n.zip") as archive:
        _assert_pictures_fit(archive, truth)
        listed = json.loads(archive.read("transforms.json"))["frames"]
        matrices = {frame["file_path"]: frame["transform_matrix"] for frame in listed}
        missing = set(matrices) - set(archive.namelist())
    assert missing == {"images/frame_00004.jpg"}
    for image in truth.images:
        assert np.array(matrices[image.file])[:3] == pytest.approx(pose_matrix(image))


@pytest.mark.parametrize("orientation", [1, 6])
def test_photos_are_upright_by_their_exif(tmp_path: Path, orientation: int) -> None:
    truth = write_photos(tmp_path / "i.zip", num=3, long_side_px=160, exif_orientation=orientation)
    with zipfile.ZipFile(tmp_path / "i.zip") as archive:
        assert len(archive.namelist()) == 3
        _assert_pictures_fit(archive, truth)


@pytest.mark.parametrize(("transfer", "tag"), [("hlg", "arib-std-b67"), ("pq", "smpte2084")])
def test_hdr_clip_carries_its_tags_and_shows_the_scene(
    tmp_path: Path, transfer: str, tag: str
) -> None:
    path = tmp_path / "clip.mov"
    truth = write_hdr_hevc(path, num=3, long_side_px=240, transfer=transfer)
    ffmpeg = [ffmpeg_executable(), "-hide_banner", "-i", str(path)]
    described = subprocess.run(ffmpeg, capture_output=True, text=True, check=False).stderr
    assert f"yuv420p10le(tv, bt2020nc/bt2020/{tag}" in described
    assert "Main 10" in described
    assert "hvc1" in described
    assert "rotation of -90.00 degrees" in described
    to_sdr = (
        "zscale=t=linear:npl=203,format=gbrpf32le,zscale=p=bt709,"
        "zscale=t=iec61966-2-1:m=gbr:r=full,format=gbrp,format=rgb24"
    )
    ffmpeg += ["-v", "error", "-vf", to_sdr, "-f", "rawvideo", "-"]
    raw = subprocess.run(ffmpeg, capture_output=True, check=True).stdout
    camera = truth.cameras[0]
    frames = np.frombuffer(raw, np.uint8).reshape(3, camera.height, camera.width, 3)
    for image, frame in zip(truth.images, frames.astype(float), strict=True):
        expected = render(camera, pose_matrix(image)).astype(float)
        assert 10 * np.log10(255.0**2 / np.mean((frame - expected) ** 2)) > 24.0
