"""The film: a walk of at least 120 degrees, stored as a phone stores it, poses that fit it."""

from __future__ import annotations

import re
import subprocess
from pathlib import Path

import numpy as np
import pytest

from pipelines.errors import ToolError
from pipelines.sample.__main__ import main
from pipelines.sample.film import (
    arc_degrees,
    encode_sideways,
    film_capture,
    hand_held_pose,
    phone_camera,
    render_all,
    walk,
)
from pipelines.sample.scene import Floats, pose_matrix, raycast, render
from pipelines.scene.cameras_file import CamerasFile
from pipelines.tools.ffmpeg import ffmpeg_executable


def _describe(path: Path) -> str:
    command = [ffmpeg_executable(), "-hide_banner", "-i", str(path)]
    return subprocess.run(command, capture_output=True, text=True, check=False).stderr


def _decode(path: Path, width: int, height: int) -> Floats:
    """All frames as players show them, [N, height, width, 3]."""
    command = [ffmpeg_executable(), "-v", "error", "-i", str(path)]
    command += ["-f", "rawvideo", "-pix_fmt", "rgb24", "-"]
    raw = subprocess.run(command, capture_output=True, check=True).stdout
    return np.frombuffer(raw, np.uint8).reshape(-1, height, width, 3).astype(float)


def _psnr(a: Floats, b: Floats) -> float:
    return float(10 * np.log10(255.0**2 / np.mean((a - b) ** 2)))


def test_the_walk_covers_the_arc_and_sways() -> None:
    centers = np.array([pose_matrix(image)[:, 3] for image in walk(120).images])
    assert arc_degrees(centers) >= 120.0
    assert np.ptp(centers[:, 2]) > 0.3
    assert np.ptp(np.linalg.norm(centers[:, :2], axis=1)) > 0.2
    # A hand's speed: no jumps between frames.
    steps = np.linalg.norm(np.diff(centers, axis=0), axis=1)
    assert steps.max() < 3 * np.median(steps)


def test_poses_are_rotations_that_look_at_the_bowl_with_up_upwards() -> None:
    for progress in np.linspace(0, 1, 30):
        pose = hand_held_pose(progress)
        rotation = pose[:, :3]
        assert rotation @ rotation.T == pytest.approx(np.eye(3), abs=1e-12)
        assert np.linalg.det(rotation) == pytest.approx(1.0)
        assert rotation[2, 1] > 0.7
        gaze = -rotation[:, 2]
        towards = np.array([0.0, 0.0, 0.3]) - pose[:, 3]
        assert gaze @ towards / np.linalg.norm(towards) > np.cos(np.radians(8))
        assert raycast(pose[None, :, 3], gaze[None]).t[0] < 2.6


def test_the_file_is_sideways_with_a_flag_and_plays_upright(tmp_path: Path) -> None:
    path = tmp_path / "walk.mp4"
    seen: list[tuple[int, int]] = []
    truth = film_capture(path, 5, 320, on_frame=lambda done, total: seen.append((done, total)))
    described = _describe(path)
    assert "h264" in described
    assert re.search(r"yuv420p\(tv, bt709[,)]", described), "matrix, primaries and transfer"
    assert re.search(r"\b320x180\b", described)
    assert "rotation of -90.00 degrees" in described
    assert "30 fps" in described
    assert seen == [(index, 5) for index in range(1, 6)]

    camera = truth.cameras[0]
    assert (camera.width, camera.height) == (180, 320)
    frames = _decode(path, camera.width, camera.height)
    assert len(frames) == len(truth.images) == 5
    for image, frame in zip(truth.images, frames, strict=True):
        expected = render(camera, pose_matrix(image)).astype(float)
        assert _psnr(frame, expected) > 28.0
        assert _psnr(frame, expected[::-1]) < 20.0
    assert [image.timestamp_s for image in truth.images] == [i / 30.0 for i in range(5)]
    # The index lies before the pictures, so that players need not read to the end.
    content = path.read_bytes()
    assert content.index(b"moov") < content.index(b"mdat")


def test_fewer_frames_film_the_same_walk() -> None:
    few, many = walk(5), walk(9)
    assert few.images[2].world_from_camera == many.images[4].world_from_camera
    assert few.metric
    with pytest.raises(ValueError, match="at least 2"):
        walk(1)
    with pytest.raises(ValueError, match="even"):
        phone_camera(97)


def test_a_failing_encoder_is_reported_and_leaves_no_file(tmp_path: Path) -> None:
    path = tmp_path / "bad.mp4"
    truth = walk(2, phone_camera(64))
    with pytest.raises(ToolError) as caught:
        encode_sideways(path, render_all(truth), truth, {"c:v": "no_such_codec"})
    assert "no_such_codec" in caught.value.details["log"]
    assert not path.exists()


def test_the_command_writes_film_and_truth(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    film, truth = tmp_path / "out" / "film.mp4", tmp_path / "truth.json"
    arguments = [str(film), "--frames", "3", "--long-side", "96", "--truth", str(truth)]
    assert main(arguments) == 0
    assert film.stat().st_size > 0
    assert len(CamerasFile.load(truth).images) == 3
    assert main([str(film), "--frames", "1"]) == 1
    assert "at least 2" in capsys.readouterr().err
