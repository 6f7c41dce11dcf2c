"""RGB-D folders: three layouts, frames that pair by number, lists whose order is checked."""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.captures.orders import frame_number
from pipelines.options import IngestOptions
from pipelines.sample.scene import pose_matrix
from tests.app_writers import write_replica
from tests.unit.pipelines.captures.archives import (
    K,
    depth_png,
    picture,
    pose,
    rgbd_files,
    rows_of,
)
from tests.unit.pipelines.captures.ingesting import (
    Files,
    cameras,
    depth_of,
    failure,
    ingest,
    poses_as_sent,
    sources,
    warning_with,
)

LAYOUTS = ("beside", "folder", "list")
LOST = rows_of(np.full((4, 4), -np.inf))


def at(x: float) -> str:
    return rows_of(pose(x, 0.5, -2.0))


def one_list(rows: Any) -> str:
    return rows_of([np.ravel(row) for row in rows])


@pytest.mark.parametrize("layout", LAYOUTS)
def test_each_layout_gives_metres_and_opengl_cameras(tmp_path: Path, layout: str) -> None:
    summary, ctx = ingest(tmp_path, rgbd_files(5, layout))
    file = cameras(ctx)
    assert (summary["kind"], file.metric, summary["num_depths"]) == ("rgbd", True, 5)
    for n, found in enumerate(poses_as_sent(ctx)):
        # The OpenCV camera's axes are the world's: ours look along +Z, upside down.
        expected = [[1, 0, 0, n], [0, -1, 0, 0.5], [0, 0, -1, -2]]
        np.testing.assert_allclose(found, np.array(expected, float), atol=1e-12)
        np.testing.assert_allclose(depth_of(ctx, n), 1 + 0.01 * n, rtol=1e-6)
    (lens,) = file.cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (60.0, 61.0, 31.5, 23.5)


@pytest.mark.parametrize("layout", ["beside", "folder"])
def test_frames_pair_by_number_and_gaps_are_told(tmp_path: Path, layout: str) -> None:
    files = rgbd_files(8, layout)
    of = {
        "beside": ("frame-000002.color.png", "frame-000005.pose.txt", "frame-000006.depth.png"),
        "folder": ("color/2.png", "pose/5.txt", "depth/6.png"),
    }[layout]
    for name in of:
        del files[name]
    summary, ctx = ingest(tmp_path, files)
    images = cameras(ctx).images
    assert list(poses_as_sent(ctx)[:, 0, 3]) == [0, 1, 3, 4, 6, 7]
    assert [bool(image.depth) for image in images] == [True, True, True, True, False, True]
    assert float(depth_of(ctx, 5)[0, 0]) == pytest.approx(1.07)
    assert warning_with(summary, "1 pictures have no pose")
    assert warning_with(summary, "1 poses have no picture")
    assert warning_with(summary, "1 of 6 pictures have no depth map")


def test_poses_and_depth_of_another_recording_are_not_taken_for_this_ones(tmp_path: Path) -> None:
    """As NSVF names its splits: pictures 1_n, and poses and depth of 0_n before theirs."""
    files: Files = {"K.txt": rgbd_files(1, "list")["K.txt"]}
    for name, data in rgbd_files(6).items():
        if name[-5].isdigit():
            for split in (1, 0) if not name.startswith("color") else (1,):
                other = data if split else rgbd_files(1)[name.replace(name[-5], "0")]
                files[name.replace("/", f"/{split}_000")] = other
    summary, ctx = ingest(tmp_path, files)
    assert list(poses_as_sent(ctx)[:, 0, 3]) == [0, 1, 2, 3, 4, 5]
    assert [round(float(depth_of(ctx, n)[0, 0]), 2) for n in (0, 3, 5)] == [1.0, 1.03, 1.05]
    assert warning_with(summary, "6 poses have no picture", "0_0000.txt")


def test_numbers_that_come_twice_are_no_pairing(tmp_path: Path) -> None:
    """Of poses they refuse the capture, of depth they cost the depth, and both are told."""
    files = rgbd_files(4)
    twice = {f"depth/{side}_{n}.png": files[f"depth/{n}.png"] for n in range(4) for side in "lr"}
    kept = {name: data for name, data in files.items() if not name.startswith("depth")}
    summary, _ = ingest(tmp_path, kept | twice)
    assert (summary["num_posed"], summary["num_depths"]) == (4, 0)
    assert warning_with(summary, "8 depth maps are not used", "cannot be told")
    poses = {f"pose/{side}_{n}.txt": files[f"pose/{n}.txt"] for n in range(4) for side in "lr"}
    kept = {name: data for name, data in files.items() if not name.startswith("pose")}
    error = failure(tmp_path / "poses", kept | poses)
    assert error.code == "poses_malformed"
    assert "same number, and no names are equal" in error.message


def test_frames_in_which_the_camera_was_lost_are_told_and_no_fault(tmp_path: Path) -> None:
    files = rgbd_files(9) | {f"pose/{n}.txt": LOST for n in range(4)}
    summary, ctx = ingest(tmp_path, files)
    assert [image.world_from_camera[0][3] for image in cameras(ctx).images] == [4, 5, 6, 7, 8]
    assert warning_with(summary, "4 of 9 pictures", "lost its way", "color/0.png")
    error = failure(tmp_path / "all", files | {f"pose/{n}.txt": LOST for n in range(9)})
    assert error.code == "poses_missing"


PLAIN = np.array(pose(6.0, 0.5, -2.0))
NAN, SCALED, MIRRORED, TURNED = (PLAIN.copy() for _ in range(4))
NAN[1, 3] = np.nan
SCALED[:3, :3] *= 1.5
MIRRORED[0, 0] = -1
TURNED = TURNED.T


@pytest.mark.parametrize(
    ("text", "why"),
    [
        (rows_of(NAN), "not finite"),
        (rows_of(SCALED), "no rotation"),
        (rows_of(MIRRORED), "no rotation"),
        (rows_of(TURNED), "last row"),
        (rows_of(PLAIN[:3, :3]), "9 numbers"),
        (rows_of(PLAIN[:2]), "8 numbers"),
        ("", "0 numbers"),
        ("1 0 0 0\n0 one 0 0\n", "Row 2"),
        ("\xff\x00 1 2 3", "Row 1"),
    ],
)
def test_a_pose_that_is_none_is_left_out_by_name(tmp_path: Path, text: str, why: str) -> None:
    summary, ctx = ingest(tmp_path, rgbd_files(11) | {"pose/6.txt": text})
    assert "color/6.png" not in sources(ctx)
    assert len(cameras(ctx).images) == 10
    assert warning_with(summary, "Left out", "6.", why)


def test_many_of_them_are_refused(tmp_path: Path) -> None:
    files = rgbd_files(8) | {f"pose/{n}.txt": rows_of(SCALED) for n in (1, 2)}
    error = failure(tmp_path, files)
    assert (error.code, "2 of 8" in error.message) == ("poses_malformed", True)


@pytest.mark.parametrize(
    ("text", "code", "why"),
    [
        ("", "poses_malformed", "0 numbers"),
        ("f = 500", "poses_malformed", "Row 1"),
        ("60 0 31 0 61 23 0 0 nan", "poses_malformed", "not finite"),
        ("60 0 0 0 61 0 31 23 1", "poses_malformed", "last row"),
        ("60 0 31", "poses_malformed", "3 numbers"),
        ("240 0 126 0 240 95 0 0 1", "poses_malformed", "for a picture of about 252x190"),
        ("0 0 31 0 61 23 0 0 1", "poses_malformed", "focal length"),
        (None, "poses_missing", "no intrinsics"),
    ],
)
def test_intrinsics_that_are_none_are_refused(
    tmp_path: Path, text: str | None, code: str, why: str
) -> None:
    files = rgbd_files(5)
    del files["intrinsic/intrinsic_color.txt"]
    if text is not None:
        files["intrinsic/intrinsic_color.txt"] = text
    error = failure(tmp_path, files)
    assert error.code == code
    assert why in error.message


@pytest.mark.parametrize(
    "values", [[value for row in K for value in row], [60.0, 61.0, 31.0, 23.0]]
)
@pytest.mark.parametrize("place", ["scan/K.txt", "camera-intrinsics.txt"])
def test_intrinsics_may_lie_above_and_in_one_row(
    tmp_path: Path, values: list[float], place: str
) -> None:
    files: Files = {f"scan/{name}": data for name, data in rgbd_files(4, "beside").items()}
    del files["scan/K.txt"]
    _, ctx = ingest(tmp_path, files | {place: rows_of([values])})
    assert cameras(ctx).cameras[0].fl_y == 61.0


def test_depth_of_another_view_is_not_used_and_told(tmp_path: Path) -> None:
    other = np.diag([45.0, 46.0, 1.0])
    other[:2, 2] = 31.0, 23.0
    summary, _ = ingest(tmp_path, rgbd_files(4) | {"intrinsic/intrinsic_depth.txt": rows_of(other)})
    assert (summary["num_posed"], summary["num_depths"]) == (4, 0)
    assert warning_with(summary, "4 pictures in depth/", "sees another view")


def test_seven_scenes_has_the_published_lenses_of_pictures_and_depth(tmp_path: Path) -> None:
    files = rgbd_files(4, "beside")
    del files["K.txt"]
    summary, ctx = ingest(tmp_path, files)
    (lens,) = cameras(ctx).cameras
    assert (lens.width, lens.fl_x, lens.cx) == (64, 52.5, 32.0)
    assert summary["num_depths"] == 4
    for image in cameras(ctx).images:
        assert image.depth_lens is not None
        assert (image.depth_lens.width, image.depth_lens.fl_x) == (64, 58.5)
    assert warning_with(summary, "published for 7-Scenes", "525")
    assert warning_with(summary, "that of depth 585")


def test_depth_that_the_pictures_lens_shows_names_no_other(tmp_path: Path) -> None:
    _, ctx = ingest(tmp_path, rgbd_files(4, "beside"))
    assert all(image.depth and image.depth_lens is None for image in cameras(ctx).images)


def test_cam_params_tell_size_and_unit(tmp_path: Path) -> None:
    """Replica's: 6553.5 counts to a metre, for pictures of twice the size."""
    files = rgbd_files(4, "list")
    files["traj.txt"] = files.pop("poses.txt")
    del files["K.txt"]
    values: dict[str, Any] = {"w": 128, "h": 96, "fx": 120.0, "fy": 122.0, "cx": 62.5, "cy": 46.5}
    files["cam_params.json"] = json.dumps({"camera": {**values, "scale": 2000.0}})
    _, ctx = ingest(tmp_path, files)
    (lens,) = cameras(ctx).cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (60.0, 61.0, 31.5, 23.5)
    assert float(depth_of(ctx, 2)[0, 0]) == pytest.approx(0.51)


@pytest.mark.parametrize("content", ["[]", "{", '{"camera": 1}', '{"camera": {"w": 64}}'])
def test_cam_params_that_are_none_are_refused(tmp_path: Path, content: str) -> None:
    files = rgbd_files(4, "list") | {"cam_params.json": content}
    del files["K.txt"]
    assert failure(tmp_path, files).code == "poses_malformed"


ROWS = [pose(float(n), 0.5, -2.0) for n in range(11)]


@pytest.mark.parametrize(
    ("text", "code", "why"),
    [
        ("# nothing\n", None, ""),
        ("0 0 0\n", "poses_malformed", "3 numbers"),
        (one_list(ROWS[:1]), "poses_malformed", "cannot be told"),
        (one_list([row[:2] for row in ROWS]), "poses_malformed", "8 numbers"),
        (one_list([[[np.nan] * 4] * 4] * 11), "poses_missing", "None of the 11"),
        (one_list(ROWS).replace("10.0", "ten"), "poses_malformed", "Row 11"),
    ],
)
def test_a_list_that_is_none_is_refused_or_no_list(
    tmp_path: Path, text: str, code: str | None, why: str
) -> None:
    files = rgbd_files(11, "list") | {"poses.txt": text}
    if code is None:
        summary, _ = ingest(tmp_path, files)
        assert summary["kind"] == "images"
    else:
        error = failure(tmp_path, files)
        assert error.code == code
        assert why in error.message


def test_lists_of_absurdly_many_rows_are_refused_before_they_are_read(tmp_path: Path) -> None:
    """Rows of one number would take hundreds of times their bytes."""
    digits = np.random.default_rng(1).integers(0, 10, 200_002)
    for number, end in enumerate(("\n", "\r", "\r\n")):
        files = rgbd_files(11, "list") | {"poses.txt": end.join(map(str, digits))}
        error = failure(tmp_path / str(number), files)
        assert (error.code, "200000 rows" in error.message) == ("too_large", True)
    files = rgbd_files(11, "list") | {"poses.txt": " ".join(map(str, digits))}
    error = failure(tmp_path / "long", files)
    assert (error.code, "too long" in error.message) == ("poses_malformed", True)


def test_faults_of_a_long_capture_are_weighed_against_all_of_it(tmp_path: Path) -> None:
    """3 of 40 are few, also where only 6 of the rest are taken; 8 of 40 are many."""
    options = IngestOptions(max_posed_images=6)
    files = rgbd_files(40)
    summary, _ = ingest(
        tmp_path / "few", files | {f"pose/{n}.txt": rows_of(NAN) for n in (3, 9, 22)}, options
    )
    assert summary["num_posed"] == 6
    many = files | {f"pose/{n}.txt": rows_of(NAN) for n in range(8)}
    error = failure(tmp_path / "many", many, options)
    assert (error.code, "8 of 40 pictures" in error.message) == ("poses_malformed", True)


def test_a_row_of_a_list_that_is_no_pose_is_left_out(tmp_path: Path) -> None:
    rows = [*ROWS[:6], NAN.tolist(), *ROWS[7:]]
    summary, ctx = ingest(tmp_path, rgbd_files(11, "list") | {"poses.txt": one_list(rows)})
    assert "images/000006.png" not in sources(ctx)
    assert warning_with(summary, "Left out", "Row 6 of poses.txt", "not finite")
    assert warning_with(summary, "Too few of the pictures match")


def test_rows_that_may_be_several_pictures_are_refused_where_nothing_tells(tmp_path: Path) -> None:
    files: Files = {
        name.replace("images/0000", "images/").replace("images/0", "images/"): data
        for name, data in rgbd_files(11, "list").items()
    }
    assert "images/10.png" in files
    error = failure(tmp_path, files)
    assert error.code == "poses_malformed"
    assert "as text" in error.message
    assert "leading zeros" in error.hint


@pytest.mark.parametrize(("first", "rule"), [(0, "from 0"), (1, "from 1")])
def test_numbers_in_names_tell_rows_where_pictures_are_missing(
    tmp_path: Path, first: int, rule: str
) -> None:
    """Rows for 12 frames, pictures of seven, named by the number of their row."""
    truth = write_replica(tmp_path / "whole.zip", num=12)
    kept = [0, 2, 3, 5, 8, 9, 11]
    files: Files = {}
    with zipfile.ZipFile(tmp_path / "whole.zip") as archive:
        for name in archive.namelist():
            number = frame_number(name) if "results" in name else None
            if number is None:
                files[name] = archive.read(name)
            elif number in kept:
                digits = f"{number:06d}", f"{number + first:06d}"
                files[name.replace(*digits)] = archive.read(name)
    summary, ctx = ingest(tmp_path, files)
    assert rule in summary["pose_order"]
    expected = [pose_matrix(truth.images[number]) for number in kept]
    np.testing.assert_allclose(poses_as_sent(ctx), expected, atol=1e-9)
    assert warning_with(summary, "traj.txt has 12 poses, and there are 7 pictures")


@pytest.mark.parametrize("data", [b"", b"\x89PNG\r\n\x1a\n", picture(16, 12)])
def test_depth_that_cannot_be_used_costs_no_picture(tmp_path: Path, data: bytes) -> None:
    summary, ctx = ingest(tmp_path, rgbd_files(4) | {"depth/2.png": data})
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, True, False, True]
    assert warning_with(summary, "1 of 4 depth maps cannot be used", "depth/2.png")


def test_counts_at_the_end_of_their_range_are_unknown(tmp_path: Path) -> None:
    counts = np.full((12, 16), 1500, np.uint16)
    counts[:6] = 65535
    _, ctx = ingest(
        tmp_path, rgbd_files(4, "beside") | {"frame-000002.depth.png": depth_png(counts)}
    )
    z = depth_of(ctx, 2)
    assert (z[:6] == 0).all()
    np.testing.assert_allclose(z[6:], 1.5, rtol=1e-6)


@pytest.mark.parametrize(
    "text",
    ["the poses of the dancers\n", "0 0.5 0.5 0.1 0.1\n"],
)
def test_photos_beside_other_texts_stay_photos(tmp_path: Path, text: str) -> None:
    """Poses are only poses with intrinsics or depth beside; others note how people stand."""
    files: Files = {f"images/{n}.jpg": picture(seed=n) for n in range(8)}
    for folder in ("labels", "poses", "pose"):
        files |= {f"{folder}/{n}.txt": "0 0.5 0.5 0.1 0.1" for n in range(8)}
    summary, _ = ingest(tmp_path, files | {"poses.txt": text})
    assert summary["kind"] == "images"
