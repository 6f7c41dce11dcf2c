"""The verdict on a reconstruction, and the reasons for images left out."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from pipelines.errors import PosesError
from pipelines.options import PosesOptions
from pipelines.scene.cameras_file import Intrinsics
from pipelines.sfm.report import (
    Attempt,
    Outcome,
    check_features,
    check_usable,
    gaps,
    unregistered_images,
)
from pipelines.sfm.rungs import RUNGS
from pipelines.sfm.source import Source
from pipelines.tools.colmap_results import PairStatistics, SparseModel, best_model


def model(indices: tuple[int, ...], num_points: int = 100, angle_deg: float = 15.0) -> SparseModel:
    return SparseModel(
        indices=indices,
        cameras=(Intrinsics(640, 480, 500.0, 500.0, 320.0, 240.0),),
        camera_of=(0,) * len(indices),
        world_from_camera=np.zeros((len(indices), 3, 4)),
        points=np.zeros((num_points, 3)),
        colors=np.zeros((num_points, 3), np.uint8),
        track_lengths=np.full(num_points, 3),
        error_px=0.7,
        angle_deg=angle_deg,
    )


def film(num: int) -> Source:
    files = tuple(f"images/{i:03d}.jpg" for i in range(num))
    return Source(Path("."), files, tuple(0.5 * i for i in range(num)), is_video=True)


def outcome(models: list[SparseModel], num: int = 20, **changed: dict[int, int]) -> Outcome:
    features, inliers = np.full(num, 2000), np.full(num, 300)
    for index, value in changed.get("features", {}).items():
        features[index] = value
    for index, value in changed.get("inliers", {}).items():
        inliers[index] = value
    statistics = PairStatistics(features, inliers, 100, 90, np.zeros((0, 3, 3)))
    return Outcome((Attempt(RUNGS[0], "sequential", tuple(models), 1.0),), statistics)


def test_the_largest_model_is_chosen_wherever_it_stands() -> None:
    small, large, sparse = model((0, 1, 2)), model(tuple(range(9))), model(tuple(range(9)), 5)
    assert best_model([small, sparse, large]) is large
    assert best_model([]) is None


def test_the_best_attempt_is_chosen_and_the_first_among_equals() -> None:
    attempts = tuple(
        Attempt(RUNGS[0], name, (model(tuple(range(size))),), 1.0)
        for name, size in (("a", 3), ("b", 9), ("c", 9))
    )
    assert Outcome(attempts, outcome([]).statistics).chosen.matcher == "b"


def test_each_image_left_out_has_its_reason() -> None:
    placed = tuple(range(4, 20))
    result = outcome([model((0, 5, 6)), model(placed)], features={1: 12}, inliers={2: 17})
    reasons = {entry["timestamp_s"]: entry for entry in unregistered_images(result, film(20))}
    assert reasons[0.0]["reason"] == "in another, smaller model of 3 images"
    assert reasons[0.5]["reason"] == "too few features (12)"
    assert reasons[1.0]["reason"] == "too few matches with its neighbours (at most 17)"
    assert reasons[1.5]["code"] == "pose_rejected"
    assert len(reasons) == 4


def test_gaps_are_stretches_of_the_film() -> None:
    placed = tuple(i for i in range(20) if i not in (3, 4, 5, 12, 19))
    assert gaps(outcome([model(placed)]), film(20)) == [(1.5, 2.5), (6.0, 6.0), (9.5, 9.5)]


def test_photos_have_no_gaps() -> None:
    photos = Source(Path("."), film(20).files, (None,) * 20, is_video=False)
    assert gaps(outcome([model((0, 1))]), photos) == []


def test_too_few_registered_says_how_many_of_how_many() -> None:
    with pytest.raises(PosesError) as caught:
        check_usable(outcome([model(tuple(range(14)))], num=210), film(210), PosesOptions())
    assert caught.value.code == "too_few_registered"
    assert caught.value.message == "14 of 210 frames registered, at least 63 are needed."
    assert caught.value.details["reasons"] == {"pose_rejected": 196}


def test_enough_is_enough() -> None:
    found = model(tuple(range(8)))
    assert check_usable(outcome([found]), film(20), PosesOptions()) is found


def test_tiny_angles_are_no_parallax() -> None:
    found = model(tuple(range(20)), angle_deg=1.7)
    with pytest.raises(PosesError, match=r"1\.7 degrees") as caught:
        check_usable(outcome([found]), film(20), PosesOptions())
    assert caught.value.code == "no_parallax"


def test_features_are_judged_before_matching() -> None:
    few = outcome([], features=dict.fromkeys(range(13), 20)).statistics
    with pytest.raises(PosesError, match="7 of 20 images") as caught:
        check_features(few, PosesOptions())
    assert caught.value.code == "no_features"
    check_features(outcome([], features=dict.fromkeys(range(12), 20)).statistics, PosesOptions())
