"""Record3D exports: frames pair with poses by number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.options import IngestOptions
from tests.unit.pipelines.captures.archives import depth_exr, picture, record3d_files
from tests.unit.pipelines.captures.ingesting import (
    cameras,
    code_of,
    depth_of,
    ingest,
    warning_with,
)


def test_record3d_frames_pair_with_poses_by_number(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, record3d_files(12, absent=(3,)))
    file = cameras(ctx)
    assert [image.world_from_camera[1][3] for image in file.images] == [
        n for n in range(12) if n != 3
    ]
    assert file.images[3].timestamp_s == pytest.approx(4 / 60)
    (lens,) = file.cameras
    assert (lens.fl_x, lens.fl_y, lens.cx, lens.cy) == (60.0, 61.0, 31.0, 23.0)
    assert (file.metric, summary["num_poses"]) == (True, 12)
    assert any(": 3." in warning for warning in summary["warnings"])


def test_record3d_quaternion_is_x_y_z_w_and_world_is_turned_up(tmp_path: Path) -> None:
    half = float(np.sqrt(0.5))
    poses = [[0, half, 0, half, n, 0.5, -2.0] for n in range(4)]  # 90 degrees about ARKit's +Y
    _, ctx = ingest(tmp_path, record3d_files(4, poses=poses))
    matrix = np.array(cameras(ctx).images[1].world_from_camera)
    # ARKit: camera +X is world -Z, camera +Y is up, camera +Z is world +X.
    np.testing.assert_allclose(matrix[:, 0], [-1, 0, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:, 1], [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(matrix[:, 2], [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(matrix[:, 3], [-2, 1, 0.5])


def test_record3d_uses_each_frames_own_lens(tmp_path: Path) -> None:
    own = [[60.0 + n, 60.0, 32.0, 24.0] for n in range(5)]
    _, ctx = ingest(tmp_path, record3d_files(5, perFrameIntrinsicCoeffs=own))
    file = cameras(ctx)
    assert [file.cameras[image.camera].fl_x for image in file.images] == [60, 61, 62, 63, 64]


def test_record3d_copies_with_other_names_are_no_frames(tmp_path: Path) -> None:
    files = record3d_files(4) | {"EXR_RGBD/rgb/2(1).jpg": picture()}
    summary, _ = ingest(tmp_path, files)
    assert summary["num_posed"] == 4


@pytest.mark.parametrize(
    ("metadata", "code"),
    [
        ({"poses": []}, "poses_missing"),
        ({"poses": [[0, 0, 0, 0, 1, 2, 3]] * 12}, "poses_malformed"),
        ({"poses": [[0, 0, 0, 1, 1, 2]] * 12}, "poses_malformed"),
        ({"poses": [[0, 0, 0, 1, 1, 2, None]] * 12}, "poses_malformed"),
        ({"K": [1, 2, 3]}, "poses_malformed"),
        ({"w": None}, "poses_malformed"),
    ],
)
def test_unusable_record3d_metadata_is_refused(
    tmp_path: Path, metadata: dict[str, Any], code: str
) -> None:
    assert code_of(tmp_path, record3d_files(**metadata)) == code


def test_record3d_frame_without_a_pose_that_is_one_is_left_out(tmp_path: Path) -> None:
    poses: list[list[float]] = [[0, 0, 0, 1, n, 0.5, -2.0] for n in range(12)]
    poses[7][6] = float("nan")
    summary, ctx = ingest(tmp_path, record3d_files(12, poses=poses))
    assert len(cameras(ctx).images) == 11
    assert "frame 7" in warning_with(summary, "Left out")


def depths(*numbers: int) -> dict[str, bytes | str]:
    """Depth [12, 16] of frame n: 1 m and n cm, a column of what is unknown."""
    made: dict[str, bytes | str] = {}
    for n in numbers:
        values = np.full((12, 16), 1.0 + 0.01 * n)
        values[:4, 0] = [0.0, -1.0, np.nan, np.inf]
        made[f"EXR_RGBD/depth/{n}.exr"] = depth_exr(values)
    return made


def test_record3d_depth_pairs_by_number_and_holds_metres(tmp_path: Path) -> None:
    files = record3d_files(12, absent=(3,)) | depths(*range(12))
    files["EXR_RGBD/depth/2(1).exr"] = files["EXR_RGBD/depth/2.exr"]
    summary, ctx = ingest(tmp_path, files)
    assert summary["num_depths"] == 11
    z = depth_of(ctx, 10)
    assert z[0, 1] == pytest.approx(1.11, rel=1e-3)
    assert list(z[:5, 0] > 0) == [False, False, False, False, True]
    assert warning_with(summary, "2 EXR files in EXR_RGBD/depth/", "no picture that is used")


def test_record3d_frames_without_depth_are_told(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, record3d_files(4) | depths(0, 1, 3))
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, True, False, True]
    assert warning_with(summary, "1 of 4 pictures have no depth map: 2.")


def test_record3d_thinned_frames_take_their_depth_with_them(tmp_path: Path) -> None:
    options = IngestOptions(max_posed_images=4)
    summary, ctx = ingest(tmp_path, record3d_files(10) | depths(*range(10)), options)
    assert [float(depth_of(ctx, n)[5, 5]) for n in range(4)] == pytest.approx(
        [1.0, 1.03, 1.06, 1.09], rel=1e-3
    )
    assert warning_with(summary, "6 EXR files", "6 pictures", "at even distances")


HALVES = np.ones((12, 16), np.float16)


@pytest.mark.parametrize(
    ("data", "why"),
    [
        ("exr", "is neither a PNG, a TIFF, OpenEXR nor NumPy"),
        (depth_exr(HALVES)[:200], "does not decode"),
        (depth_exr(HALVES, channel="G"), "no channel Z, V, R"),
        (depth_exr(HALVES, A=HALVES, B=HALVES, G=HALVES, Z=HALVES), "no channel Z, V, R"),
        (depth_exr(HALVES.T), "not the same view"),
        (depth_exr(HALVES * 0), "can be trusted"),
        (depth_exr(np.ones((1200, 1600), np.float16)), "1600x1200 pixels; 1000000 are allowed"),
    ],
)
def test_record3d_depth_that_cannot_be_used_costs_no_picture(
    tmp_path: Path, data: bytes | str, why: str
) -> None:
    files = record3d_files(4) | depths(0, 1, 2, 3) | {"EXR_RGBD/depth/1.exr": data}
    summary, ctx = ingest(tmp_path, files, IngestOptions(max_pixels=1_000_000))
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, False, True, True]
    (told,) = summary["warnings"]
    assert "1 of 4 depth maps cannot be used" in told
    assert why in told


def test_record3d_depth_of_an_r3d_is_not_read_and_told(tmp_path: Path) -> None:
    files = {
        name.replace("EXR_RGBD/metadata.json", "metadata").replace("EXR_RGBD/rgb", "rgbd"): data
        for name, data in record3d_files(4).items()
    }
    files |= {f"rgbd/{n}.{kind}": b"bvx2" for n in range(4) for kind in ("depth", "conf")}
    summary, _ = ingest(tmp_path, files)
    assert (summary["num_posed"], summary["num_depths"]) == (4, 0)
    assert "4 depth files in rgbd/" in warning_with(summary, "LZFSE", "EXR + JPG")
