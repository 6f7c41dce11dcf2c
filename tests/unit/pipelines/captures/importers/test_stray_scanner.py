"""Stray Scanner recordings: frames of a film pair with rows and depth by number."""

from __future__ import annotations

from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest

from pipelines.options import IngestOptions
from tests.unit.pipelines.captures.archives import depth_png, picture, stray_files
from tests.unit.pipelines.captures.ingesting import (
    cameras,
    depth_of,
    failure,
    ingest,
    sources,
    warning_with,
)
from tests.unit.pipelines.tools.clips import ffmpeg, marked_pictures, number_in

LIST = "scan/odometry.csv"


@cache
def film(count: int = 12) -> bytes:
    """An MP4 whose frame n shows its number."""
    with TemporaryDirectory() as folder:
        marked_pictures(Path(folder) / "marked", count, set())
        target = Path(folder) / "rgb.mp4"
        ffmpeg("-framerate", "30", "-i", Path(folder) / "marked" / "%04d.png", target)
        return target.read_bytes()


def recording(**changes: str) -> dict[str, bytes | str]:
    """A recording whose list of poses has some words replaced."""
    files = stray_files(film())
    text = str(files[LIST])
    for old, new in changes.items():
        assert old in text
        text = text.replace(old, new)
    return files | {LIST: text}


def with_row(number: int, row: str) -> dict[str, bytes | str]:
    """A recording with another row for a frame."""
    files = stray_files(film())
    lines = str(files[LIST]).splitlines()
    lines[1 + number] = row
    return files | {LIST: "\n".join(lines)}


def test_frames_rows_and_depth_pair_by_number(tmp_path: Path) -> None:
    files = recording()
    lines = str(files[LIST]).splitlines()
    del lines[1 + 3], files["scan/depth/000005.png"], files["scan/confidence/000006.png"]
    summary, ctx = ingest(tmp_path, files | {LIST: "\n".join([lines[0], *reversed(lines[1:])])})
    numbers = [n for n in range(12) if n != 3]
    file = cameras(ctx)
    assert sources(ctx) == [f"scan/rgb.mp4 frame {n}" for n in numbers]
    assert [number_in(ctx.out / image.file) for image in file.images] == numbers
    for n, image in zip(numbers, file.images, strict=True):
        # A half turn around X makes ARKit's camera the list's: here it stands upright.
        expected = [[0, 0, 1, -2.0], [1, 0, 0, n], [0, 1, 0, 0.5]]
        np.testing.assert_allclose(image.world_from_camera, np.array(expected), atol=1e-12)
    (lens,) = file.cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (300.0, 301.0, 158.5, 94.5)
    assert (file.metric, summary["num_depths"], summary["num_poses"]) == (True, 10, 11)
    assert file.images[1].timestamp_s == pytest.approx(100 + 1 / 30)
    z = depth_of(ctx, 1)
    assert not z[0].any()  # of confidence 1
    np.testing.assert_allclose(z[1:], 1.01, rtol=1e-6)
    assert depth_of(ctx, 5)[0].all()  # frame 6, which has no confidence
    assert warning_with(summary, "1 of 11 frames have no depth map: 5.")
    assert warning_with(summary, "1 of 11 depth maps have no confidence", "000006")
    assert not list(ctx.out.glob(".film"))


def test_rows_without_a_lens_have_that_of_the_matrix(tmp_path: Path) -> None:
    """Older versions of the app stop at qw."""
    files = recording(**{", fx, fy, cx, cy, distortion_center_x": "", ", 300, 301, 158, 94, ": ""})
    _, ctx = ingest(tmp_path, files)
    (lens,) = cameras(ctx).cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (310.0, 311.0, 158.5, 94.5)
    del files["scan/camera_matrix.csv"]
    error = failure(tmp_path / "without", files)
    assert (error.code, "camera_matrix.csv" in error.message) == ("poses_missing", True)


def test_long_recordings_are_thinned_and_take_their_depth_with_them(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, recording(), IngestOptions(max_posed_images=4))
    images = cameras(ctx).images
    assert [number_in(ctx.out / image.file) for image in images] == [0, 4, 7, 11]
    assert float(depth_of(ctx, 1)[5, 5]) == pytest.approx(1.04)
    assert warning_with(summary, "8 pictures in scan/depth/", "at even distances")


@pytest.mark.parametrize(
    ("num_frames", "told"), [(10, "10 frames, and poses are there for 12"), (14, "14 frames")]
)
def test_a_film_a_little_shorter_or_longer_is_used_and_told(
    tmp_path: Path, num_frames: int, told: str
) -> None:
    files = recording() | {"scan/rgb.mp4": film(num_frames)}
    if num_frames < 12:  # 2 of 12 frames are not there: too many for so short a recording
        error = failure(tmp_path, files)
        assert (error.code, "no frame 10" in error.message) == ("image_undecodable", True)
        return
    summary, ctx = ingest(tmp_path, files)
    assert warning_with(summary, told, "counted from the first")
    assert len(cameras(ctx).images) == 12


@pytest.mark.parametrize("num_frames", [8, 20])
def test_a_film_with_another_number_of_frames_is_refused(tmp_path: Path, num_frames: int) -> None:
    error = failure(tmp_path, recording() | {"scan/rgb.mp4": film(num_frames)})
    assert error.code == "poses_malformed"
    assert f"has {num_frames} frames, and poses are there for 12" in error.message


ROW = "100.2, 000006, 6.0, 0.5, -2.0, 1, 0, 0, 0, 300, 301, 158, 94, "


@pytest.mark.parametrize(
    ("row", "words"),
    [
        (ROW.replace("6.0", "nan"), "not a finite number"),
        (ROW.replace("6.0", "six"), "not a number"),
        (ROW.replace("1, 0, 0, 0", "0, 0, 0, 0"), "no rotation"),
        (ROW.replace("000006", "-6"), "no number of a frame"),
        (ROW.replace("000006", "99999999999"), "no number of a frame"),
        (ROW.replace("000006", "000005"), "second one of frame 5"),
        (ROW.replace("158, 94", "20, 94"), "for a picture of about"),
        (ROW[:30], "is not a number"),
    ],
)
def test_a_row_that_makes_no_sense_is_left_out(tmp_path: Path, row: str, words: str) -> None:
    summary, ctx = ingest(tmp_path, with_row(6, row))
    assert len(cameras(ctx).images) == 11
    assert "scan/rgb.mp4 frame 6" not in sources(ctx)
    assert warning_with(summary, "Left out", words)


@pytest.mark.parametrize(
    ("name", "data", "code", "words"),
    [
        (LIST, "timestamp, frame, x, y, z\n", "poses_malformed", "qx, qy, qz, qw"),
        (LIST, "timestamp, frame, x, y, z, qx, qy, qz, qw\n", "poses_missing", "no poses"),
        ("scan/rgb.mp4", None, "no_images", "no film rgb.mp4"),
        ("scan/rgb.mp4", b"text", "no_images", "no film rgb.mp4"),
        ("scan/rgb.mp4", "cut", "video_truncated", "cut off"),
        ("scan/camera_matrix.csv", "1 2 3", "poses_malformed", "3 numbers"),
    ],
)
def test_a_recording_that_cannot_be_used_is_refused(
    tmp_path: Path, name: str, data: bytes | str | None, code: str, words: str
) -> None:
    files = recording()
    del files[name]
    data = film()[:900] if data == "cut" else data
    error = failure(tmp_path, files if data is None else files | {name: data})
    assert error.code == code
    assert words in error.message


@pytest.mark.parametrize("data", [b"", depth_png(np.ones((24, 24), np.uint16)), picture(40, 24)])
def test_depth_that_cannot_be_used_costs_no_picture(tmp_path: Path, data: bytes) -> None:
    summary, ctx = ingest(tmp_path, recording() | {"scan/depth/000004.png": data})
    assert [n for n, image in enumerate(cameras(ctx).images) if not image.depth] == [4]
    assert warning_with(summary, "1 of 12 depth maps cannot be used")


def test_a_table_of_another_program_is_not_this_app(tmp_path: Path) -> None:
    files: dict[str, bytes | str] = {f"{n}.jpg": picture(seed=n) for n in range(8)}
    summary, _ = ingest(tmp_path, files | {"odometry.csv": "time,x,y,z\n", "rgb.mp4": film()})
    assert summary["kind"] == "images"


def test_lists_of_absurdly_many_rows_are_refused_before_they_are_read(tmp_path: Path) -> None:
    head = str(stray_files(b"")[LIST]).splitlines()[0]
    digits = np.random.default_rng(1).integers(0, 10, 200_002)
    error = failure(tmp_path, recording() | {LIST: "\n".join([head, *map(str, digits)])})
    assert (error.code, "200000 rows" in error.message) == ("too_large", True)
    # Each of these would be a line of its own for `str.splitlines`.
    rows = "\n".join([head, "\x1c".join(map(str, digits))])
    error = failure(tmp_path / "odd", recording() | {LIST: rows})
    assert (error.code, "Row 2" in error.message) == ("poses_malformed", True)
