"""The real samples, with the quirks that their README lists; needs NERFWORKS_CAPTURES."""

from __future__ import annotations

import json
import os
import re
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.sniff import sniff
from pipelines.errors import CaptureError
from pipelines.manifest import run_job_locally
from pipelines.scene.cameras_file import CamerasFile
from pipelines.scene.sensor_depth import load_sensor_depth
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.archives import picture, write_zip
from tests.unit.pipelines.captures.depth_agreement import disagreement

pytestmark = [
    pytest.mark.captures,
    pytest.mark.skipif(
        "NERFWORKS_CAPTURES" not in os.environ,
        reason="real captures are NOT tested: NERFWORKS_CAPTURES does not name their folder",
    ),
]


def captures() -> Path:
    return Path(os.environ["NERFWORKS_CAPTURES"])


def zip_of(target: Path, folder: Path, files: Iterable[Path]) -> Path:
    return write_zip(
        target, {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}, 0
    )


def prepared(tmp_path: Path, source: Path) -> tuple[Workspace, dict[str, Any]]:
    """The workspace after `frames`, and what ingest said."""
    workspace = Workspace(tmp_path / "job")
    workspace.capture_file.parent.mkdir(parents=True)
    workspace.capture_file.symlink_to(source)
    kind = sniff(workspace.capture_file, source.name).kind
    manifests = run_job_locally(workspace, "preview", {}, kind=kind, until="frames")
    return workspace, manifests["ingest"]["summary"]


def test_box_video_gives_frames_at_even_times(tmp_path: Path) -> None:
    workspace, summary = prepared(tmp_path, captures() / "video-phone-box" / "box.mp4")
    assert (summary["kind"], summary["width"], summary["height"]) == ("video", 960, 544)
    listed = json.loads((workspace.stage("frames") / "frames.json").read_text())
    assert (listed["num_source_frames"], len(listed["frames"])) == (698, 72)
    times = np.array([row["timestamp_s"] for row in listed["frames"]])
    indices = np.array([row["source_frame_index"] for row in listed["frames"]])
    np.testing.assert_allclose(times, indices / 30, atol=0.5 / 30)
    assert (np.floor(times / (698 / 30 / 72) + 1e-6) == np.arange(72)).all()


def test_fox_poses_pair_with_the_files_that_are_there(tmp_path: Path) -> None:
    folder = captures() / "photos-fox"
    source = zip_of(tmp_path / "fox.zip", folder, [p for p in folder.rglob("*") if p.is_file()])
    workspace, summary = prepared(tmp_path, source)
    found = (summary["kind"], summary["num_images"], summary["num_missing"])
    assert found == ("nerfstudio", 50, 17)
    file = CamerasFile.load(workspace.posed_cameras)
    (lens,) = file.cameras
    assert (lens.model, lens.width, lens.height) == ("OPENCV", 1080, 1920)
    listed = json.loads((folder / "transforms.json").read_text())["frames"]
    poses = {frame["file_path"]: frame["transform_matrix"] for frame in listed}
    record = json.loads((workspace.stage("ingest") / "capture.json").read_text())
    for image, stored in zip(file.images, record["images"], strict=True):
        assert image.file == stored["file"]
        np.testing.assert_allclose(
            image.world_from_camera, np.array(poses[stored["source"]])[:3], atol=1e-4
        )


def test_blender_scene_is_posed_and_white_where_it_was_clear(tmp_path: Path) -> None:
    folder = captures() / "blender-lego-reduced"
    source = zip_of(tmp_path / "lego.zip", folder, [p for p in folder.rglob("*") if p.is_file()])
    workspace, summary = prepared(tmp_path, source)
    assert (summary["kind"], summary["num_images"], summary["warnings"]) == ("blender", 30, [])
    file = CamerasFile.load(workspace.posed_cameras)
    (lens,) = file.cameras
    assert (lens.width, lens.cy, round(lens.fl_x, 2)) == (800, 400.0, 1111.11)
    poses = np.array([image.world_from_camera for image in file.images])
    # All cameras are 4.03 from the middle, above the ground, and look at the middle.
    distances = np.linalg.norm(poses[:, :, 3], axis=1)
    np.testing.assert_allclose(distances, 4.031, atol=1e-3)
    assert (poses[:, 2, 3] > 0).all()
    np.testing.assert_allclose(poses[:, :, 2], poses[:, :, 3] / distances[:, None], atol=1e-4)
    with PIL.Image.open(workspace.images_root / file.images[0].file) as image:
        assert (image.mode, image.getpixel((2, 2))) == ("RGB", (255, 255, 255))


def test_corridor_depth_of_one_frame_is_that_of_the_others(tmp_path: Path) -> None:
    """3D Scanner App: pictures, 16-bit depth, 8-bit confidence and poses in one folder."""
    folder = captures() / "3dscannerapp-corridor"
    some = [p for p in folder.rglob("*") if p.is_file() and p.stem[-5:] < "00060"]
    workspace, summary = prepared(tmp_path, zip_of(tmp_path / "scan.zip", folder, some))
    assert (summary["kind"], summary["metric"]) == ("3dscannerapp", True)
    assert (summary["num_images"], summary["num_depths"], summary["num_poses"]) == (20, 20, 60)
    (told,) = summary["warnings"]
    assert "80 pictures in All_Data/ and 40 files in All_Data/ were not used" in told
    record = json.loads((workspace.stage("ingest") / "capture.json").read_text())
    numbers = [int(Path(image["source"]).stem[-5:]) for image in record["images"]]
    assert numbers == list(range(0, 60, 3))
    file = CamerasFile.load(workspace.posed_cameras)
    assert len(file.cameras) == 20  # each frame has a lens of its own
    assert all(image.world_from_camera[2][1] > 0.9 for image in file.images)  # held upright
    assert disagreement(file, workspace.images_root, 1) < 0.007
    assert disagreement(file, workspace.images_root, 3) < 0.012


def test_fox_photos_alone_are_images(tmp_path: Path) -> None:
    folder = captures() / "photos-fox" / "images"
    _, summary = prepared(tmp_path, zip_of(tmp_path / "fox.zip", folder, folder.iterdir()))
    assert (summary["kind"], summary["num_images"]) == ("images", 50)


def test_sceaux_photos_lose_their_exif(tmp_path: Path) -> None:
    folder = captures() / "photos-sceaux-castle" / "images"
    source = zip_of(tmp_path / "castle.zip", folder, folder.iterdir())
    workspace, summary = prepared(tmp_path, source)
    assert (summary["kind"], summary["num_images"]) == ("images", 11)
    for path in (workspace.images_root / "images").iterdir():
        with PIL.Image.open(path) as image:
            assert image.size == (2832, 2128)
            assert not image.getexif()


def test_office_keeps_the_depth_of_its_sensor(tmp_path: Path) -> None:
    folder = captures() / "rgbd-hololens-office"
    source = zip_of(tmp_path / "office.zip", folder, [p for p in folder.rglob("*") if p.is_file()])
    workspace, summary = prepared(tmp_path, source)
    assert (summary["kind"], summary["num_images"], summary["num_depths"]) == ("nerfstudio", 94, 94)
    file = CamerasFile.load(workspace.posed_cameras)
    images = file.images
    assert file.notes["up"] == "+Y"
    assert any("+Y of the file's world is up" in warning for warning in summary["warnings"])
    ups = np.array([[row[1] for row in image.world_from_camera] for image in images])
    assert ups[:, 2].mean() > 0.85
    depths = [load_sensor_depth(workspace.images_root / str(image.depth)) for image in images]
    for z, path in zip(depths, sorted((folder / "depth").iterdir()), strict=True):
        with PIL.Image.open(path) as counts:
            np.testing.assert_allclose(z, np.asarray(counts) * 0.001, rtol=1e-6)
    # The sensor sees rings and what is far off not at all: 40 to 81 % of a frame are known.
    known = np.array([(z > 0).mean() for z in depths])
    assert 0.4 < known.min() < known.max() < 0.82
    assert 0.59 < np.median(known) < 0.78


def test_office_by_its_list_of_poses_is_the_same_office(tmp_path: Path) -> None:
    """`poses.txt`, `K.txt`: OpenCV cameras, metres. Half of the pictures, rows cut to match."""
    folder = captures() / "rgbd-hololens-office"
    every = sorted((folder / "images").iterdir())[::2]
    files = {f"scan/images/{path.name}": path.read_bytes() for path in every}
    for path in every:
        files[f"scan/depth/{path.name}"] = (folder / "depth" / path.name).read_bytes()
    rows = (folder / "poses.txt").read_text().splitlines()[::2]
    files |= {"scan/poses.txt": "\n".join(rows).encode()}
    files |= {"scan/K.txt": (folder / "K.txt").read_bytes()}
    workspace, summary = prepared(tmp_path, write_zip(tmp_path / "office.zip", files, 0))
    found = (summary["kind"], summary["num_images"], summary["num_depths"], summary["metric"])
    assert found == ("rgbd", 47, 47, True)
    assert max(summary["epipolar_error"].values()) < 0.0015
    file = CamerasFile.load(workspace.posed_cameras)
    assert file.notes["up"] == "+Y"
    assert disagreement(file, workspace.images_root, 1) < 0.006
    listed = json.loads((folder / "transforms.json").read_text())["frames"]
    poses = {frame["file_path"]: frame["transform_matrix"] for frame in listed}
    turn = np.array(file.notes["applied_transform"])[:, :3]
    for image, path in zip(file.images, every, strict=True):
        expected = turn @ np.array(poses[f"images/{path.name}"])[:3]
        np.testing.assert_allclose(image.world_from_camera, expected, atol=1e-4)


def test_juice_box_has_its_poses_in_the_order_of_names_as_text(tmp_path: Path) -> None:
    folder = captures() / "photos-juicebox-white-table"
    source = zip_of(tmp_path / "box.zip", folder, [p for p in folder.rglob("*") if p.is_file()])
    workspace, summary = prepared(tmp_path, source)
    assert (summary["kind"], summary["num_images"], summary["metric"]) == ("llff", 64, False)
    assert "as text" in summary["pose_order"]
    right = summary["epipolar_error"].pop(summary["pose_order"])
    (wrong,) = summary["epipolar_error"].values()
    assert right < 0.0005
    assert wrong > 0.005
    file = CamerasFile.load(workspace.posed_cameras)
    record = json.loads((workspace.stage("ingest") / "capture.json").read_text())
    numbers = [int(Path(image["source"]).stem.rpartition("_")[2]) for image in record["images"]]
    assert numbers == list(range(64))  # in the order of the film
    # Neighbours in the film are neighbours in the room, and it was filmed upright.
    centers = np.array([[row[3] for row in image.world_from_camera] for image in file.images])
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 0.4 * np.linalg.norm(np.ptp(centers, axis=0))
    assert np.mean([image.world_from_camera[2][1] for image in file.images]) > 0.7


def test_door_handle_skips_the_frame_that_is_missing(tmp_path: Path) -> None:
    folder = captures() / "record3d-door-handle-first100"
    source = zip_of(tmp_path / "door.zip", folder, [p for p in folder.rglob("*") if p.is_file()])
    workspace, summary = prepared(tmp_path, source)
    assert (summary["kind"], summary["num_images"], summary["num_poses"]) == ("record3d", 99, 100)
    file = CamerasFile.load(workspace.posed_cameras)
    record = json.loads((workspace.stage("ingest") / "capture.json").read_text())
    numbers = [int(Path(image["source"]).stem) for image in record["images"]]
    assert numbers == [n for n in range(100) if n != 60]
    poses = json.loads((folder / "EXR_RGBD" / "metadata.json").read_text())["poses"]
    centers = np.array([[row[3] for row in image.world_from_camera] for image in file.images])
    expected = np.array([[poses[n][6], poses[n][4], poses[n][5]] for n in numbers])
    np.testing.assert_allclose(centers, expected, atol=1e-9)
    assert summary["num_depths"] == 99
    for image in file.images:
        z = load_sensor_depth(workspace.images_root / str(image.depth))
        assert z.shape == (256, 192)
        assert (z > 0).mean() > 0.99
        assert 0.1 < np.median(z) < 1.0
    # The pictures show the floor at their lower edge: a camera's up is the world's up.
    assert all(image.world_from_camera[2][1] > 0.5 for image in file.images)


def test_turntable_without_its_photos_says_which_it_wants(tmp_path: Path) -> None:
    folder = captures() / "metashape-turntable"
    with pytest.raises(CaptureError) as caught:
        prepared(tmp_path, zip_of(tmp_path / "turn.zip", folder, folder.iterdir()))
    assert caught.value.code == "poses_missing"
    assert "cameras.xml lists 94 pictures" in caught.value.message
    assert "001, 002, 003, 004, 005 and 89 more" in caught.value.message


def test_turntable_cameras_look_at_what_metashape_calls_the_region(tmp_path: Path) -> None:
    """With pictures of the photos' shape in their place: the region's middle is in front of all."""
    folder = captures() / "metashape-turntable"
    files: dict[str, bytes | str] = {
        f"{n:03d}.jpg": picture(216, 144, seed=n) for n in range(1, 95)
    }
    text = (folder / "cameras.xml").read_text()
    source = write_zip(tmp_path / "turn.zip", files | {"cameras.xml": text}, 0)
    workspace, summary = prepared(tmp_path, source)
    assert (summary["kind"], summary["num_posed"], summary["metric"]) == ("metashape", 94, False)
    file = CamerasFile.load(workspace.posed_cameras)
    center = re.search("<center>(.*?)</center>", text)
    assert center is not None
    move = np.array(file.notes["applied_transform"])
    middle = move[:, :3] @ [float(word) for word in center[1].split()] + move[:, 3]
    inside = 0
    for image in file.images:
        lens, pose = file.cameras[image.camera], np.array(image.world_from_camera)
        x, y, z = pose[:, :3].T @ (middle - pose[:, 3])
        assert -6.0 < z < -3.0, "OpenGL cameras look along -Z"
        u, v = lens.cx - lens.fl_x * x / z, lens.cy + lens.fl_y * y / z
        inside += 0 < u < lens.width and 0 < v < lens.height
    assert inside > 70
