"""OpenSfM's and OpenDroneMap's reconstructions: every projection, georeferences, points."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.captures import unpack
from pipelines.captures.sniff import sniff
from pipelines.exports.formats.ply import read_ply
from pipelines.registry import skipped_stages
from pipelines.sample.scene import pose_matrix
from pipelines.scene.cameras_file import Intrinsics
from tests.sfm_writers import (
    odm_files,
    opensfm_camera,
    opensfm_reconstruction,
    pictures_of,
    sparse_points,
    walked,
)
from tests.unit.pipelines.captures.archives import write_zip
from tests.unit.pipelines.captures.ingesting import (
    assert_lenses,
    assert_poses,
    cameras,
    failure,
    ingest,
    sources,
    warning_with,
)

LENSES = (
    Intrinsics(64, 48, 61.5, 60.5, 32.75, 23.5, "OPENCV", -0.03, 0.01, 0.002, 0.0, 1e-3, -2e-3),
    Intrinsics(48, 64, 30.0, 31.0, 24.5, 31.0, "OPENCV_FISHEYE", 0.02, -0.01, 0.003, 7e-4),
)
TRUTH = walked(*LENSES)
PICTURES = pictures_of(TRUTH)

Change = Callable[[dict[str, Any]], object]


def files_of(*reconstructions: dict[str, Any], name: str = "reconstruction.json") -> Any:
    return PICTURES | {name: json.dumps(reconstructions).encode()}


@pytest.mark.parametrize("folder", ["", "opensfm/", "project/opensfm/"])
def test_poses_and_lenses_are_those_that_were_written(tmp_path: Path, folder: str) -> None:
    files = files_of(opensfm_reconstruction(TRUTH), name=f"{folder}reconstruction.json")
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "opensfm"
    summary, ctx = ingest(tmp_path / "job", files)
    assert (summary["num_posed"], summary["metric"], summary["warnings"]) == (10, False, [])
    assert skipped_stages("opensfm") == {"frames"}
    assert_poses(ctx, TRUTH)
    assert_lenses(ctx, TRUTH, 1e-12)


def test_its_points_are_kept(tmp_path: Path) -> None:
    _, ctx = ingest(tmp_path, files_of(opensfm_reconstruction(TRUTH)))
    cloud = read_ply(ctx.out / "points.ply")
    places, colors = sparse_points()
    np.testing.assert_allclose(cloud.points, places, atol=1e-6)
    np.testing.assert_array_equal(cloud.colors, colors)


def test_gps_makes_it_metric_and_the_origin_is_kept(tmp_path: Path) -> None:
    _, ctx = ingest(tmp_path, files_of(opensfm_reconstruction(TRUTH, gps=True)))
    assert cameras(ctx).metric is True
    assert cameras(ctx).notes["reference_lla"]["latitude"] == 48.77
    assert_poses(ctx, TRUTH)


@pytest.mark.parametrize(
    ("camera", "wanted"),
    [
        (
            {"projection_type": "perspective", "focal": 0.9, "k1": -0.1, "k2": 0.02},
            Intrinsics(64, 48, 57.6, 57.6, 32.0, 24.0, "OPENCV", -0.1, 0.02),
        ),
        (
            {"projection_type": "fisheye", "focal": 0.5, "k1": -0.1, "k2": 0.02},
            Intrinsics(64, 48, 32.0, 32.0, 32.0, 24.0, "OPENCV_FISHEYE", -0.1, 0.02),
        ),
        (
            {"projection_type": "simple_radial", "focal_x": 0.9, "focal_y": 0.8, "k1": 0.1},
            Intrinsics(64, 48, 57.6, 51.2, 32.0, 24.0, "OPENCV", 0.1),
        ),
        (
            {"projection_type": "radial", "focal_x": 0.9, "focal_y": 0.9, "c_x": 0.25,
             "c_y": -0.125, "k1": 0.1, "k2": 0.2},
            Intrinsics(64, 48, 57.6, 57.6, 48.0, 16.0, "OPENCV", 0.1, 0.2),
        ),
    ],
)  # fmt: skip
def test_every_projection_becomes_its_equal(
    tmp_path: Path, camera: dict[str, Any], wanted: Intrinsics
) -> None:
    truth = walked()
    made = opensfm_reconstruction(truth)
    made["cameras"] = {"v2 maker 0": {"width": 64, "height": 48, **camera}}
    files = pictures_of(truth) | {"reconstruction.json": json.dumps([made]).encode()}
    _, ctx = ingest(tmp_path, files)
    (lens,) = cameras(ctx).cameras
    assert lens == replace(wanted, fl_x=lens.fl_x, fl_y=lens.fl_y)
    assert (lens.fl_x, lens.fl_y) == (pytest.approx(wanted.fl_x), pytest.approx(wanted.fl_y))


def test_map_coordinates_lose_nothing_on_their_way_to_float32(tmp_path: Path) -> None:
    """OpenDroneMap's own outputs; its world is 5,400 km from where map coordinates begin."""
    truth = walked(*LENSES, folder="images/")
    files = pictures_of(truth) | odm_files(truth)
    assert sniff(write_zip(tmp_path / "c.zip", files), "c").kind == "opensfm"
    summary, ctx = ingest(tmp_path / "job", files)
    assert (summary["num_posed"], summary["metric"]) == (10, True)
    assert warning_with(summary, "units from the world's origin", "applied_transform")
    poses = {image.file: pose_matrix(image)[:3] for image in truth.images}
    true = np.array([poses[source] for source in sources(ctx)])
    found = np.array([image.world_from_camera for image in cameras(ctx).images])
    np.testing.assert_allclose(found[:, :, :3], true[:, :, :3], atol=1e-9)
    kept = found[:, :, 3].astype(np.float32).astype(np.float64)
    wanted = true[:, :, 3] - true[:, :, 3].mean(axis=0)
    np.testing.assert_allclose(kept, wanted, atol=1e-6)
    shift = np.array(cameras(ctx).notes["applied_transform"])[:, 3]
    np.testing.assert_allclose(
        found[:, :, 3] - shift, true[:, :, 3] + [449_123.0, 5_411_804.0, 80.0], atol=1e-8
    )


def test_the_largest_reconstruction_is_read_and_the_others_told(tmp_path: Path) -> None:
    small = opensfm_reconstruction(TRUTH)
    small["shots"] = dict(list(small["shots"].items())[:2])
    summary, ctx = ingest(tmp_path, files_of(small, opensfm_reconstruction(TRUTH)))
    assert_poses(ctx, TRUTH)
    assert "those with 2 lie" in warning_with(summary, "has 2 reconstructions", "10 shots")


def test_shots_without_a_picture_and_pictures_without_a_shot_are_told(tmp_path: Path) -> None:
    made = opensfm_reconstruction(TRUTH)
    del made["shots"]["left/IMG_10.jpg"]
    files = files_of(made)
    del files["images/left/IMG_11.jpg"]
    summary, ctx = ingest(tmp_path, files)
    assert len(cameras(ctx).images) == 8
    assert "left/IMG_11.jpg" in warning_with(summary, "1 of them are not in the archive")
    assert "images/left/IMG_10.jpg" in warning_with(summary, "not listed in reconstruction.json")


def test_without_pictures_it_says_which_it_wants(tmp_path: Path) -> None:
    files = {"reconstruction.json": json.dumps([opensfm_reconstruction(TRUTH)])}
    error = failure(tmp_path, files)
    assert (error.code, "left/IMG_10.jpg" in error.message) == ("poses_missing", True)


def test_a_file_of_that_name_that_is_no_list_is_none(tmp_path: Path) -> None:
    files = PICTURES | {"reconstruction.json": b'{"vertices": []}'}
    assert sniff(write_zip(tmp_path / "c", files), "c").kind == "images"


def shot(made: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = made["shots"]["left/IMG_10.jpg"]
    return found


def every_camera(**values: Any) -> Change:
    def change(made: dict[str, Any]) -> None:
        for camera in made["cameras"].values():
            camera |= values

    return change


@pytest.mark.parametrize(
    ("change", "code", "words"),
    [
        (lambda made: made["shots"].clear(), "poses_missing", "has no shots"),
        (lambda made: made["cameras"].clear(), "poses_malformed", "v2 maker"),
        (lambda made: made.update(shots=[]), "poses_malformed", "Reconstruction 0"),
        (every_camera(projection_type="spherical"), "poses_malformed", '"spherical"'),
        (every_camera(projection_type="dual", transition=0.5), "poses_malformed", '"dual"'),
        (every_camera(s0=0.5), "poses_malformed", "s0"),
        (every_camera(focal_x=float("nan")), "poses_malformed", "focal_x"),
        (every_camera(focal_x=0.0), "poses_malformed", "focal length"),
        (every_camera(width="64"), "poses_malformed", "width"),
        (every_camera(width=48, height=48), "poses_malformed", "its intrinsics are for 48x48"),
    ],
)
def test_faults_are_refused_by_name(tmp_path: Path, change: Change, code: str, words: str) -> None:
    made = opensfm_reconstruction(TRUTH)
    change(made)
    error = failure(tmp_path, files_of(made))
    assert error.code == code
    assert words in error.message


@pytest.mark.parametrize(
    "change",
    [
        lambda made: shot(made).update(rotation=[1.0, float("nan"), 0.0]),
        lambda made: shot(made).update(rotation=[1e300, 0.0, 0.0]),
        lambda made: shot(made).update(translation=[1.0, 2.0]),
        lambda made: shot(made).update(camera="another"),
        lambda made: made["shots"].update({"left/IMG_10.jpg": 3}),
    ],
)
def test_one_bad_shot_in_ten_is_left_out_by_name(tmp_path: Path, change: Change) -> None:
    made = opensfm_reconstruction(TRUTH)
    change(made)
    summary, ctx = ingest(tmp_path, files_of(made))
    assert len(cameras(ctx).images) == 9
    assert warning_with(summary, "Left out")


def test_a_point_that_is_none_costs_the_points_alone(tmp_path: Path) -> None:
    made = opensfm_reconstruction(TRUTH)
    made["points"]["7"] = {"coordinates": [1.0, float("inf"), 2.0]}
    summary, ctx = ingest(tmp_path, files_of(made))
    assert_poses(ctx, TRUTH)
    assert not (ctx.out / "points.ply").exists()
    assert warning_with(summary, "The points are not used", "Point 7")


def test_the_writer_normalises_by_the_longer_side() -> None:
    """What these tests lean on: OpenSfM's rule, for a picture that stands."""
    camera = opensfm_camera(Intrinsics(48, 64, 32.0, 64.0, 24.0, 40.0))
    assert (camera["focal_x"], camera["focal_y"]) == (0.5, 1.0)
    assert (camera["c_x"], camera["c_y"]) == (0.0, 0.125)


@pytest.mark.parametrize(("most", "code"), [(20, "too_large"), (10_000_000, "poses_malformed")])
def test_very_many_reconstructions_are_refused_before_they_are_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, most: int, code: str
) -> None:
    monkeypatch.setattr(unpack, "MAX_JSON_PARTS", most)
    one = json.dumps(opensfm_reconstruction(TRUTH))
    files = PICTURES | {"reconstruction.json": f"[{one}{',{}' * 1000}]"}
    assert failure(tmp_path, files).code == code
