"""Record3D exports: frames pair with poses by number."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.unit.pipelines.captures.archives import picture, record3d_files
from tests.unit.pipelines.captures.ingesting import cameras, code_of, ingest, warning_with


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


def test_record3d_depth_is_not_read_and_told(tmp_path: Path) -> None:
    files = record3d_files(4) | {f"EXR_RGBD/depth/{n}.exr": "exr" for n in range(4)}
    summary, _ = ingest(tmp_path, files)
    assert "4 EXR files in EXR_RGBD/depth/" in warning_with(summary, "phone's depth")
