"""3D Scanner App exports: frames pair by number, with a lens and depth of their own."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit.pipelines.captures.archives import (
    depth_png,
    picture,
    pose,
    scanner_app_files,
)
from tests.unit.pipelines.captures.ingesting import (
    cameras,
    depth_of,
    failure,
    ingest,
    sources,
    warning_with,
)


def changed(number: int, **values: Any) -> str:
    """The file of a frame with other values."""
    return json.dumps(json.loads(str(scanner_app_files(11, 1, **values)[_frame(number)])))


def _frame(number: int, kind: str = "frame", suffix: str = "json") -> str:
    return f"All_Data/{kind}_{number:05d}.{suffix}"


def test_pictures_depth_and_poses_pair_by_number(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, scanner_app_files(5))
    file = cameras(ctx)
    assert sources(ctx) == [_frame(n, suffix="jpg") for n in (0, 3, 6, 9, 12)]
    # ARKit's (x, y, z) is (z, x, y) here.
    places = [[row[3] for row in image.world_from_camera] for image in file.images]
    assert places == [[-2.0, n, 0.5] for n in (0, 3, 6, 9, 12)]
    assert file.images[2].timestamp_s == pytest.approx(100.6)
    (lens,) = file.cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (60.0, 61.0, 31.5, 23.5)
    assert (file.metric, summary["num_depths"], summary["num_poses"]) == (True, 5, 15)
    z = depth_of(ctx, 2)
    assert not z[0].any()  # of confidence 1
    np.testing.assert_allclose(z[1:], 1.06, rtol=1e-6)
    (told,) = summary["warnings"]
    assert "20 pictures in All_Data/ and 10 files in All_Data/" in told
    assert "a picture of some frames only" in told


def test_intrinsics_are_for_the_size_that_the_projection_tells(tmp_path: Path) -> None:
    """Pictures stored at a quarter of the phone's size."""
    large: dict[str, Any] = {
        "intrinsics": [240.0, 0, 125.5, 0, 244.0, 93.5, 0, 0, 1],
        "projectionMatrix": [480 / 256, *[0.0] * 4, 488 / 192, *[0.0] * 10],
    }
    _, ctx = ingest(tmp_path, scanner_app_files(4, **large))
    (lens,) = cameras(ctx).cameras
    assert (lens.width, lens.height) == (64, 48)
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (60.0, 61.0, 31.5, 23.5)


def test_a_projection_for_an_upright_screen_says_nothing_of_the_picture(tmp_path: Path) -> None:
    upright: dict[str, Any] = {"projectionMatrix": [122 / 48, *[0.0] * 4, 120 / 64, *[0.0] * 10]}
    _, ctx = ingest(tmp_path, scanner_app_files(4, **upright))
    (lens,) = cameras(ctx).cameras
    assert (lens.fl_x, lens.cx) == (60.0, 31.5)


def test_frames_without_depth_or_confidence_are_told(tmp_path: Path) -> None:
    files = scanner_app_files(5)
    del files[_frame(3, "depth", "png")], files[_frame(6, "conf", "png")]
    summary, ctx = ingest(tmp_path, files)
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, False, True, True, True]
    assert warning_with(summary, "1 of 5 pictures have no depth map: 3.")
    assert warning_with(summary, "1 of 4 depth maps have no confidence", "depth_00006.png")
    assert depth_of(ctx, 2)[0].all()


def test_pictures_without_a_pose_are_told(tmp_path: Path) -> None:
    files = scanner_app_files(6)
    del files[_frame(6)]
    summary, ctx = ingest(tmp_path, files)
    assert _frame(6, suffix="jpg") not in sources(ctx)
    assert warning_with(summary, "1 pictures have no pose", "frame_00006.jpg")


ROWS = [value for row in pose(1.0, 0.5, -2.0) for value in row]
NOISE = np.random.default_rng(0).integers(500, 9000, (12, 16), np.uint16)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"cameraPoseARFrame": None}, "cameraPoseARFrame"),
        ({"cameraPoseARFrame": ROWS[:12]}, "16 numbers"),
        ({"cameraPoseARFrame": [float("nan"), *ROWS[1:]]}, "cameraPoseARFrame"),
        ({"cameraPoseARFrame": np.reshape(ROWS, (4, 4)).T.ravel().tolist()}, "last row"),
        ({"cameraPoseARFrame": [2.0, *ROWS[1:]]}, "no rotation"),
        ({"cameraPoseARFrame": [-1.0, *ROWS[1:]]}, "no rotation"),
        ({"intrinsics": None}, "intrinsics"),
        ({"intrinsics": [60.0, 0, 0, 0, 61.0, 0, 31.0, 23.0, 1]}, "intrinsics"),
        ({"intrinsics": [0.0, 0, 31.0, 0, 61.0, 23.0, 0, 0, 1]}, "intrinsics"),
        ({"projectionMatrix": [1.0]}, "projectionMatrix"),
        ({"projectionMatrix": [0.0] * 16}, "projectionMatrix"),
        ({"time": "noon"}, "time"),
    ],
)
def test_a_frame_that_makes_no_sense_is_left_out(
    tmp_path: Path, values: dict[str, Any], words: str
) -> None:
    summary, ctx = ingest(tmp_path, scanner_app_files(11, 1) | {_frame(6): changed(6, **values)})
    assert _frame(6, suffix="jpg") not in sources(ctx)
    assert "frame_00006" in warning_with(summary, "Left out", words)


def test_an_export_of_such_frames_is_refused(tmp_path: Path) -> None:
    scaled = [2.0, *ROWS[1:]]
    error = failure(tmp_path, scanner_app_files(4, 1, cameraPoseARFrame=scaled))
    assert (error.code, "4 of 4" in error.message) == ("poses_malformed", True)
    assert "frame_00000" in error.message


def test_an_export_whose_numbers_never_meet_is_refused(tmp_path: Path) -> None:
    files = scanner_app_files(4, 1)
    for n in range(4):
        del files[_frame(n)]
    files |= {"All_Data/frame_7.json": "{}", "All_Data/frame_7.jpg": "none"}
    summary, _ = ingest(tmp_path, files | {f"{n}.jpg": picture(seed=n) for n in range(8)})
    assert summary["kind"] == "images"


@pytest.mark.parametrize("content", ["", "[]", "{", "null", '{"intrinsics": 1e999}'])
def test_a_frames_file_that_is_none_is_left_out(tmp_path: Path, content: str) -> None:
    summary, _ = ingest(tmp_path, scanner_app_files(11, 1) | {_frame(6): content})
    assert (summary["num_posed"], summary["num_depths"]) == (10, 10)
    assert warning_with(summary, "Left out", "frame_00006.json")


@pytest.mark.parametrize(
    ("kind", "data", "why"),
    [
        ("depth", depth_png(NOISE)[:200], "decode"),
        ("depth", depth_png(np.ones((12, 16), np.uint8)), "has 8 bits"),
        ("depth", depth_png(np.ones((16, 12), np.uint16)), "not the same view"),
        ("depth", picture(16, 12, kind="PNG"), "has colours"),
        ("conf", depth_png(np.ones((6, 8), np.uint8)), "the depth map that it is for"),
        ("conf", depth_png(np.ones((12, 16), np.uint8)), "can be trusted"),
    ],
)
def test_depth_that_cannot_be_used_costs_no_picture(
    tmp_path: Path, kind: str, data: bytes, why: str
) -> None:
    files = scanner_app_files(5) | {_frame(6, kind, "png"): data}
    summary, ctx = ingest(tmp_path, files)
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, True, False, True, True]
    assert warning_with(summary, "1 of 5 depth maps cannot be used", why)


def test_labels_beside_pictures_are_not_this_app(tmp_path: Path) -> None:
    """Programs for drawing labels write `frame_00000.json` beside `frame_00000.jpg` too."""
    files: dict[str, bytes | str] = {}
    for n in range(8):
        files |= {f"set/frame_{n:05d}.jpg": picture(seed=n), f"set/frame_{n:05d}.json": "{}"}
    summary, _ = ingest(tmp_path, files)
    assert summary["kind"] == "images"
