"""What the benchmark of poses makes of poses and reports, and the captures it writes."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from pipelines.sample.align import path_extent, similarity
from pipelines.sample.film import walk
from pipelines.sample.scene import pose_matrix
from tests.benchmarks.pose_accuracy import (
    Judged,
    PoseErrors,
    compare,
    error_px_of,
    row_of,
    rungs_of,
)
from tests.benchmarks.pose_captures import CASES, DRIFT, DRIFT_DEG, drifted, shrunk

TRUTH = walk(12)
POSES = np.array([pose_matrix(image) for image in TRUTH.images])


def judged(errors: PoseErrors | None, scale: float | None = None) -> Judged:
    return Judged("room", "plain", 0, 72, 70, errors, scale, 0.3, 4.0, 30.0, "quick 70")


def test_another_frame_is_no_error_and_its_scale_is_told() -> None:
    turn = Rotation.from_rotvec((0.3, -0.2, 1.0)).as_matrix()
    found = np.concatenate([turn @ POSES[:, :, :3], 1.02 * (turn @ POSES[:, :, 3:]) + 4.0], axis=2)
    errors = compare(found, POSES)
    assert errors.center_90_percent < 1e-9
    assert errors.rotation_90_deg < 1e-6
    assert errors.scale == pytest.approx(1.02)


def test_medians_and_the_worst_tenth_are_told_apart() -> None:
    found = POSES.copy()
    found[:2, :, :3] = found[:2, :, :3] @ Rotation.from_rotvec((0.0, 0.0, 0.1)).as_matrix()
    errors = compare(found, POSES)
    assert errors.rotation_deg < 1e-6
    assert errors.rotation_90_deg > 1.0


def test_drifted_poses_are_off_by_what_is_said() -> None:
    found = np.array([pose_matrix(image) for image in drifted(TRUTH).images])
    assert similarity(found[:, :, 3], POSES[:, :, 3]).scale == pytest.approx(1.0)
    away = np.linalg.norm(found[:, :, 3] - POSES[:, :, 3], axis=1) / path_extent(POSES[:, :, 3])
    cosines = ((found[:, :, :3] * POSES[:, :, :3]).sum((1, 2)) - 1) / 2
    turned = np.degrees(np.arccos(np.clip(cosines, -1, 1)))
    assert 0.3 * DRIFT < np.median(away) < 2 * DRIFT
    assert 0.3 * DRIFT_DEG < np.median(turned) < 2 * DRIFT_DEG
    assert np.abs(np.linalg.det(found[:, :, :3]) - 1).max() < 1e-9


def test_the_same_drift_as_it_comes_makes_the_path_smaller() -> None:
    found = np.array([pose_matrix(image) for image in shrunk(TRUTH).images])
    assert similarity(found[:, :, 3], POSES[:, :, 3]).scale > 1.01


@pytest.mark.parametrize(
    ("rotation", "center", "scale", "fine"),
    [
        (0.1, 0.4, None, True),
        (0.3, 0.4, None, False),
        (0.1, 0.6, None, False),
        (0.1, 0.4, -1.5, False),
        (0.1, 0.4, 0.5, True),
    ],
)
def test_what_is_wanted(rotation: float, center: float, scale: float | None, fine: bool) -> None:
    errors = PoseErrors(70, rotation, 1.0, center, 2.0, 1.0)
    assert judged(errors, scale).is_as_wanted is fine


def test_nothing_found_is_a_line_all_the_same() -> None:
    assert row_of(judged(None))[2:4] == ["-", "-"]
    assert row_of(judged(None))[-1] == "no"


def test_rungs_are_told_with_what_each_placed() -> None:
    attempts = [{"rung": "quick", "num_registered": 31}, {"rung": "thorough", "num_registered": 72}]
    assert rungs_of({"attempts": attempts}) == "quick 31, thorough 72"
    assert rungs_of({"attempts": [], "given": {"verdict": "refined"}}) == "refined"


def test_the_error_of_given_poses_is_what_matches_miss_those_by_that_were_taken() -> None:
    fits = {"before": {"error_px": 1.2}, "after": {"error_px": 0.1}}
    given = {"sampled": {"error_px": 0.7}, "refinement": fits | {"taken": True}}
    assert error_px_of({"given": given}) == 0.1
    assert error_px_of({"given": given | {"refinement": fits | {"taken": False}}}) == 1.2
    assert error_px_of({"given": given | {"refinement": None}}) == 0.7
    assert error_px_of({"given": {"sampled": None, "refinement": None}}) is None
    assert error_px_of({"mean_reprojection_error_px": 0.3}) == 0.3


def test_metric_cases_are_those_that_come_with_poses() -> None:
    assert {case.name for case in CASES.values() if case.metric} == {
        "polycam",
        "polycam-shrunk",
        "record3d",
        "scanner-app",
    }
    assert not any(case.metric and case.is_plain for case in CASES.values())
