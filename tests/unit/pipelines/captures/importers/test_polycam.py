"""Polycam raw exports: metric, +Z up, the corrected poses, the sharp frames."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.options import IngestOptions
from tests.unit.pipelines.captures.archives import depth_png, polycam_files
from tests.unit.pipelines.captures.ingesting import (
    cameras,
    code_of,
    depth_of,
    ingest,
    warning_with,
)


@pytest.mark.parametrize("corrected", [True, False])
def test_polycam_poses_become_metric_and_z_up(tmp_path: Path, corrected: bool) -> None:
    summary, ctx = ingest(tmp_path, polycam_files(corrected=corrected))
    file = cameras(ctx)
    assert (summary["kind"], summary["corrected"], file.metric) == ("polycam", corrected, True)
    pose_of_third = np.array(file.images[2].world_from_camera)
    # ARKit (2, 0.5, -2): 0.5 m high. The camera's up (+Y) is the world's up (+Z).
    np.testing.assert_allclose(pose_of_third[:, 3], [-2.0, 2.0, 0.5])
    np.testing.assert_allclose(pose_of_third[:, 1], [0.0, 0.0, 1.0])
    assert np.linalg.det(pose_of_third[:, :3]) == pytest.approx(1.0)
    assert file.images[2].timestamp_s == pytest.approx(2.0)
    drifts = any("drift" in warning for warning in summary["warnings"])
    assert drifts is not corrected


def test_polycam_prefers_corrected_poses(tmp_path: Path) -> None:
    raw = polycam_files(6, corrected=False)
    summary, ctx = ingest(tmp_path, raw | polycam_files(4, corrected=True))
    assert (summary["corrected"], len(cameras(ctx).images)) == (True, 4)


def test_polycam_takes_corrected_poses_without_corrected_pictures(tmp_path: Path) -> None:
    """With the phone's lens, which is that of its pictures."""
    corrected = {
        name: text.replace('"fx": 60.0', '"fx": 61.5').replace('"t_13": 0.5', '"t_13": 0.7')
        for name, text in polycam_files(6).items()
        if isinstance(text, str)
    }
    summary, ctx = ingest(tmp_path, polycam_files(6, corrected=False) | corrected)
    file = cameras(ctx)
    assert (summary["corrected"], len(file.images)) == (True, 6)
    assert {image.world_from_camera[2][3] for image in file.images} == {0.7}
    assert [lens.fl_x for lens in file.cameras] == [60.0]
    assert not any(".json" in warning or "drift" in warning for warning in summary["warnings"][:-1])
    # And cameras of which only the phone's are there stay the phone's.
    lone = {name: data for name, data in corrected.items() if not name.endswith("1000000.json")}
    _, ctx = ingest(tmp_path / "lone", polycam_files(6, corrected=False) | lone)
    assert len(cameras(ctx).images) == 5


def test_polycam_drops_blurred_frames_if_enough_remain(tmp_path: Path) -> None:
    scores = [10.0 if n % 5 == 0 else 90.0 for n in range(30)]
    summary, _ = ingest(tmp_path, polycam_files(30, blur_scores=scores))
    assert summary["num_posed"] == 24
    assert warning_with(summary, "6 pictures", "blurred")


def test_polycam_keeps_blurred_frames_if_few_would_remain(tmp_path: Path) -> None:
    summary, _ = ingest(tmp_path, polycam_files(8, blur_scores=[10.0] * 8))
    assert summary["num_posed"] == 8
    assert any("blurred" in warning for warning in summary["warnings"])


def test_polycam_without_cameras_misses_its_poses(tmp_path: Path) -> None:
    files = {name: data for name, data in polycam_files().items() if "cameras" not in name}
    assert code_of(tmp_path, files) == "poses_missing"


@pytest.mark.parametrize("value", ['{"fx": 1}', "[]", "{"])
def test_polycam_with_a_malformed_camera_is_refused(tmp_path: Path, value: str) -> None:
    files = polycam_files()
    files["keyframes/corrected_cameras/1500000.json"] = value
    assert code_of(tmp_path, files) == "poses_malformed"


def test_long_export_is_thinned_evenly(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, polycam_files(13), IngestOptions(max_posed_images=4))
    assert summary["num_frames"] == 13
    assert [image.world_from_camera[1][3] for image in cameras(ctx).images] == [0, 4, 8, 12]
    assert warning_with(summary, "9 pictures", "at even distances")


def depths(*frames: int, rated: bool = True) -> dict[str, bytes | str]:
    """Depth [12, 16]: 1.5 m, a column of 0; rows 1 and 2 of medium and of low confidence."""
    counts = np.full((12, 16), 1500, np.uint16)
    confidence = np.full((12, 16), 255, np.uint8)
    confidence[1], confidence[2] = 127, 0
    made: dict[str, bytes | str] = {}
    for n in frames:
        stamp = 1_000_000 + n * 500_000
        known = counts + np.uint16(n)
        known[:, 0] = 0
        made[f"keyframes/depth/{stamp}.png"] = depth_png(known)
        if rated:
            made[f"keyframes/confidence/{stamp}.png"] = depth_png(confidence)
    return made


@pytest.mark.parametrize("corrected", [True, False])
def test_polycam_depth_is_metres_where_it_is_confident(tmp_path: Path, corrected: bool) -> None:
    summary, ctx = ingest(tmp_path, polycam_files(5, corrected) | depths(*range(5)))
    assert summary["num_depths"] == 5
    z = depth_of(ctx, 3)
    assert z[0, 1] == pytest.approx(1.503, abs=0.0005)
    assert (z[:, 0] == 0).all()
    assert list(np.any(z > 0, axis=1)[:4]) == [True, False, False, True]
    assert not any("depth" in text for text in summary["warnings"])


def test_polycam_depth_without_confidence_is_used_whole_and_told(tmp_path: Path) -> None:
    summary, ctx = ingest(tmp_path, polycam_files(4) | depths(0, 1, 2, rated=False))
    assert (depth_of(ctx, 0)[:, 1:] > 0).all()
    assert warning_with(summary, "3 of 3 depth maps have no confidence map")
    assert "2500000.jpg" in warning_with(summary, "1 of 4 pictures have no depth map")


@pytest.mark.parametrize(
    ("confidence", "why"),
    [
        (np.full((12, 16), 2, np.uint8), "can be trusted"),  # ARKit's own numbers, 0 to 2
        (np.full((24, 32), 255, np.uint8), "is 32x24"),
    ],
)
def test_polycam_confidence_of_another_kind_costs_the_depth_alone(
    tmp_path: Path, confidence: Any, why: str
) -> None:
    files = polycam_files(4) | depths(0, 1, 2, 3)
    files["keyframes/confidence/1500000.png"] = depth_png(confidence)
    summary, ctx = ingest(tmp_path, files)
    assert [bool(image.depth) for image in cameras(ctx).images] == [True, False, True, True]
    assert why in warning_with(summary, "1 of 4 depth maps cannot be used")
    assert not any("keyframes/" in text for text in summary["warnings"][1:])


def test_polycam_depth_without_a_picture_is_told(tmp_path: Path) -> None:
    summary, _ = ingest(tmp_path, polycam_files(4) | depths(*range(9)))
    assert summary["num_depths"] == 4
    assert "5 pictures in keyframes/depth/" in warning_with(summary, "no picture that is used")
    assert "5 pictures in keyframes/confidence/" in warning_with(summary, "no depth map that")


def test_polycam_depth_of_blurred_frames_is_left_with_them(tmp_path: Path) -> None:
    scores = [10.0 if n % 5 == 0 else 90.0 for n in range(30)]
    summary, _ = ingest(tmp_path, polycam_files(30, blur_scores=scores) | depths(*range(30)))
    assert summary["num_depths"] == 24
    assert warning_with(summary, "6 pictures in keyframes/depth/", "their pictures are blurred")


def test_polycam_with_one_malformed_camera_in_ten_leaves_it_out(tmp_path: Path) -> None:
    files = polycam_files(10)
    files["keyframes/corrected_cameras/1500000.json"] = "{"
    summary, ctx = ingest(tmp_path, files)
    assert len(cameras(ctx).images) == 9
    assert "1500000.json" in warning_with(summary, "Left out")
