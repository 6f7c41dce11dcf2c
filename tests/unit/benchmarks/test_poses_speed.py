"""What the benchmark of poses makes of what its processes say."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.sfm.source import Source
from tests.benchmarks.poses_speed import Measured, compare_poses, pose_errors, print_report
from tests.benchmarks.poses_ways import Phases, described, limited


def turn(angle: float) -> np.ndarray:
    c, s = np.cos(angle), np.sin(angle)
    return np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])


def some_poses(num: int = 6) -> np.ndarray:
    rng = np.random.default_rng(0)
    return np.stack(
        [np.column_stack((turn(rng.uniform(0, 6)), rng.normal(size=3))) for _ in range(num)]
    )


def moved(poses: np.ndarray) -> np.ndarray:
    """The same poses in another world: turned, three times as large, elsewhere."""
    move = turn(0.7)
    centers = 3.0 * poses[:, :, 3] @ move.T + [5.0, -1.0, 2.0]
    return np.concatenate((move @ poses[:, :, :3], centers[:, :, None]), axis=2)


def truth_of(poses: np.ndarray) -> CamerasFile:
    images = tuple(
        PosedImage(f"{i}.jpg", 0, tuple(tuple(row) for row in pose.tolist()), 0.1 * i)
        for i, pose in enumerate(poses)
    )
    lens = Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0)
    return CamerasFile(cameras=(lens,), images=images, metric=True, source="made", notes={})


def test_the_same_poses_in_another_world_have_no_error() -> None:
    poses = some_poses()
    errors = compare_poses(moved(poses), poses)
    assert errors.max_center < 1e-9
    assert errors.mean_rotation_deg < 1e-4


def test_a_turned_camera_counts_by_its_angle() -> None:
    poses = some_poses()
    found = poses.copy()
    found[2, :, :3] = found[2, :, :3] @ turn(np.radians(12.0))
    assert compare_poses(found, poses).mean_rotation_deg == pytest.approx(2.0, abs=1e-6)


def test_centres_count_relative_to_the_extent() -> None:
    poses = some_poses()
    found = poses.copy()
    found[3, :, 3] += [0.0, 0.0, 1e-3]
    wide = compare_poses(10.0 * found, 10.0 * poses)
    assert wide.max_center == pytest.approx(compare_poses(found, poses).max_center, rel=1e-6)
    assert 1e-5 < wide.max_center < 1e-3


def test_poses_are_paired_by_file_or_by_the_nearest_time() -> None:
    poses = some_poses()
    found = [
        {"file": f"{i}.jpg", "timestamp_s": 0.1 * i + 0.02, "world_from_camera": pose.tolist()}
        for i, pose in enumerate(moved(poses))
    ]
    by_file = pose_errors(found[::-1], truth_of(poses), by_time=False)
    by_time = pose_errors(found[1:], truth_of(poses), by_time=True)
    assert by_file is not None
    assert by_time is not None
    assert (by_file.num_images, by_time.num_images) == (6, 5)
    assert max(by_file.max_center, by_time.max_center) < 1e-9
    stranger = [{**pose, "file": "no.jpg"} for pose in found]
    assert pose_errors(stranger, truth_of(poses), by_time=False) is None
    assert pose_errors(found, None, by_time=False) is None


def test_a_limit_takes_images_evenly_with_both_ends() -> None:
    files = tuple(f"{i}.jpg" for i in range(72))
    source = Source(Path("."), files, tuple(float(i) for i in range(72)), is_video=True)
    some = limited(source, 8)
    assert (some.files[0], some.files[-1], len(some.files)) == ("0.jpg", "71.jpg", 8)
    assert set(np.diff([t for t in some.timestamps_s if t is not None])) <= {10.0, 11.0}
    assert limited(source, None) is limited(source, 100) is source


def test_time_goes_to_the_phase_that_the_stage_speaks_of(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = iter([0.0, 3.0, 10.0, 11.0])
    monkeypatch.setattr("tests.benchmarks.poses_ways.time.monotonic", lambda: next(clock))
    monkeypatch.setattr("tests.benchmarks.poses_ways.cpu_seconds", lambda: 0.0)
    phases = Phases()
    for message in ("looking at a few images", "features of image 1 of 9", "matching pair 1 of 9"):
        phases.on_progress(0.0, message, None)
    phases.on_progress(0.0, "placing image 1 of 9", None)
    phases.enter("mapping")
    assert phases.wall_s == {"features": 3.0, "matching": 7.0, "mapping": 1.0}


def test_no_model_is_described_by_zeros() -> None:
    source = Source(Path("."), ("a.jpg",), (None,), is_video=False)
    assert described(None, source)["num_registered"] == 0


def test_the_report_says_how_many_times_faster(capsys: pytest.CaptureFixture[str]) -> None:
    split = dict.fromkeys(("features", "matching", "mapping"), 10.0)
    slow = Measured("c", "defaults", 9, 8, 60.0, 90.0, 2**30, split, split, 0.5, 4.0, None)
    fast = Measured("c", "ours", 9, 9, 20.0, 30.0, 2**29, split, split, None, None, None)
    print_report([slow, fast])
    said = capsys.readouterr().out
    assert "3.0 times the speed of COLMAP's defaults (3.0 in CPU time), +1 images" in said
    assert "0.50" in said
