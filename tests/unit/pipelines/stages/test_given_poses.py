"""Given poses beside pictures of a room whose true poses are known: real features, real COLMAP."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.errors import Cancelled, ToolError
from pipelines.exports.formats.ply import read_ply, write_points
from pipelines.sample.align import similarity
from pipelines.scene.cameras_file import CamerasFile
from pipelines.sfm import given
from pipelines.sfm.given_depth import Beside
from pipelines.stage import StageContext
from pipelines.stages import given_poses
from pipelines.stages.poses import run
from pipelines.tools.colmap import Reconstructor
from tests.unit.pipelines.sfm.synthetic_room import FOCAL, HEIGHT, WIDTH, render
from tests.unit.pipelines.stages.posed_room import (
    EXTENT,
    FEW,
    NUM,
    OPTIONS,
    TRUTH,
    assert_as_given,
    codes,
    context,
    drifted,
    errors,
    found,
)


@pytest.fixture(scope="module")
def pictures() -> list[Image.Image]:
    return [render(pose) for pose in TRUTH]


@pytest.fixture(scope="module")
def exact(
    tmp_path_factory: pytest.TempPathFactory, pictures: list[Image.Image]
) -> tuple[StageContext, dict[str, Any]]:
    """What the stage makes of exact poses without points or depth, and its summary."""
    ctx = context(tmp_path_factory.mktemp("exact") / "job", TRUTH, pictures)
    return ctx, run(OPTIONS, ctx)


def test_exact_poses_are_trusted_and_stay_as_they_are(
    exact: tuple[StageContext, dict[str, Any]],
) -> None:
    ctx, summary = exact
    assert summary["given"]["verdict"] == "trusted"
    assert not codes(summary)
    assert summary["given"]["sampled"]["error_px"] < 0.4
    assert summary["given"]["refinement"] is None
    assert_as_given(ctx)
    assert json.loads((ctx.out / "report.json").read_text()) == summary


def test_trusted_poses_that_came_without_points_get_those_that_pictures_show(
    exact: tuple[StageContext, dict[str, Any]],
) -> None:
    """Depth is sought where they are: of a long walk few probes would find little."""
    ctx, _ = exact
    points = read_ply(ctx.out / "points.ply")
    assert len(points.points) > 300
    assert points.colors is not None
    assert points.colors.std() > 5.0
    # The room is three planes through the origin.
    off = np.abs(points.points).min(axis=1)
    assert np.median(off) < 0.002 * EXTENT
    assert np.percentile(off, 95) < 0.02 * EXTENT
    for pose in TRUTH:
        local = (points.points - pose[:, 3]) @ pose[:, :3]
        at = FOCAL * local[:, :2] / -local[:, 2:]
        inside = (local[:, 2] < 0) & (np.abs(at) < (WIDTH / 2, HEIGHT / 2)).all(axis=1)
        assert inside.sum() > 50, "each picture shows some"


def test_what_brings_points_or_depth_is_not_searched_for_more(
    tmp_path: Path, pictures: list[Image.Image]
) -> None:
    ctx = context(tmp_path / "sensor", TRUTH[:FEW], pictures[:FEW], depth=1.0)
    assert run(OPTIONS, ctx)["given"]["verdict"] == "trusted"
    assert not (ctx.out / "points.ply").exists()
    ctx = context(tmp_path / "most", TRUTH[:FEW], pictures[:FEW], depth=1.0)
    cameras = CamerasFile.load(ctx.workspace.stage("ingest") / "cameras.json")
    lost = replace(cameras.images[3], depth=None)
    images = (*cameras.images[:3], lost, *cameras.images[4:])
    replace(cameras, images=images).save(ctx.workspace.stage("ingest") / "cameras.json")
    run(OPTIONS, ctx)
    assert not (ctx.out / "points.ply").exists(), "one map that is missing changes nothing"
    ctx = context(tmp_path / "points", TRUTH[:FEW], pictures[:FEW])
    brought = np.random.default_rng(1).uniform(0, 1, (50, 3)).astype(np.float32)
    path = ctx.workspace.stage("ingest") / "points.ply"
    write_points(path, brought, np.zeros((50, 3), np.uint8))
    run(OPTIONS, ctx)
    assert (ctx.out / "points.ply").read_bytes() == path.read_bytes()


def test_few_points_are_worse_than_none(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    """A plain thing with a label: depth would be sought where the label is."""
    monkeypatch.setattr(given_poses, "LEAST_SHOWN", 100_000)
    ctx = context(tmp_path, TRUTH[:FEW], pictures[:FEW])
    assert run(OPTIONS, ctx)["given"]["verdict"] == "trusted"
    assert not (ctx.out / "points.ply").exists()


def test_poses_are_trusted_all_the_same_where_looking_for_points_breaks_off(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    asked: list[Any] = []

    def broken(*args: Any) -> None:
        asked.append(args)
        raise ToolError("no", code="no", hint="")

    monkeypatch.setattr(given, "located", broken)
    ctx = context(tmp_path, TRUTH[:FEW], pictures[:FEW])
    summary = run(OPTIONS, ctx)
    assert summary["given"]["verdict"] == "trusted"
    assert "exact poses" in summary["given"]["why"]
    assert len(asked) == 1
    assert not (ctx.out / "points.ply").exists()


def test_points_that_cannot_be_written_cost_no_job(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    written: list[Any] = []

    def full(*args: Any) -> None:
        written.append(args)
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(given_poses, "write_points", full)
    ctx = context(tmp_path, TRUTH[:FEW], pictures[:FEW])
    assert run(OPTIONS, ctx)["given"]["verdict"] == "trusted"
    assert not (ctx.out / "points.ply").exists()
    assert len(written) == 1, "so few pictures show enough points to be written"


def test_drifted_poses_are_refined_towards_the_truth_at_their_own_place_and_scale(
    tmp_path: Path, pictures: list[Image.Image]
) -> None:
    poses = drifted()
    steps: list[float] = []
    ctx = context(
        tmp_path, poses, pictures, depth=1.0, on_progress=lambda share, *_: steps.append(share)
    )
    summary = run(OPTIONS, ctx)
    told = summary["given"]
    assert told["verdict"] == "refined"
    assert not codes(summary)
    (centers, turns), (given_centers, given_turns) = errors(found(ctx)), errors(poses)
    assert centers < 0.001
    assert turns < 0.25
    assert centers < 0.1 * given_centers
    assert turns < 0.5 * given_turns
    # In the frame that they came in: no more off than drift moves the whole.
    apart = np.linalg.norm(found(ctx)[:, :, 3] - TRUTH[:, :, 3], axis=1)
    assert apart.mean() < np.linalg.norm(poses[:, :, 3] - TRUTH[:, :, 3], axis=1).mean()
    assert abs(similarity(found(ctx)[:, :, 3], poses[:, :, 3]).scale - 1) < 0.03
    depth = told["refinement"]["sensor_depth"]
    assert abs(depth["after"]["ratio"] - 1.0) < 0.005
    assert depth["after"]["spread"] < 0.3 * depth["before"]["spread"]
    # Drift made the path 2.4 % longer; the sensor knows better, and is heard.
    assert abs(similarity(TRUTH[:, :, 3], found(ctx)[:, :, 3]).scale - 1) < 0.005
    assert told["refinement"]["scale"]["believed"] == "path and sensor"
    # The lens was right, and stays.
    assert CamerasFile.load(ctx.out / "cameras.json").cameras[0].fl_x == FOCAL
    assert told["refinement"]["lens"]["taken"] is False
    assert told["refinement"]["num_carried"] == 0
    assert told["refinement"]["replaced"] == []
    assert steps == sorted(steps)
    # Those of the adjustment; how many there are before depends on how fast the machine matches.
    assert len({step for step in steps if step > 0.8}) > 5
    assert {0.18, 0.3, 0.8} <= {round(step, 3) for step in steps}
    assert (ctx.out / "points.ply").is_file()


@pytest.mark.parametrize("by_sensor", [True, False], ids=["sensor's lens", "picture's lens"])
def test_a_lens_of_another_camera_is_corrected_and_depth_stays_where_it_was_measured(
    tmp_path: Path, pictures: list[Image.Image], by_sensor: bool
) -> None:
    """The lens that came along is 11 % too long: the depth sensor's, by which depth was written, or
    just wrong, with depth that is registered to the pictures."""
    wrong = 1.11 * FOCAL
    more: dict[str, Any] = {"focal": wrong, "depth_focal": wrong if by_sensor else FOCAL}
    ctx = context(tmp_path, drifted(), pictures, depth=1.0, **more)
    summary = run(OPTIONS, ctx)
    told = summary["given"]
    assert told["verdict"] == "refined"
    assert codes(summary) == ["given_lens_corrected"]
    cameras = CamerasFile.load(ctx.out / "cameras.json")
    (lens,) = cameras.cameras
    assert lens.fl_x == pytest.approx(FOCAL, rel=0.015)
    assert lens.fl_y == pytest.approx(FOCAL, rel=0.015)
    for image in cameras.images:
        assert (image.depth_lens is None) != by_sensor
        assert image.depth_lens is None or image.depth_lens.fl_x == wrong
    centers, turns = errors(found(ctx))
    assert centers < 0.003
    assert turns < 0.3
    depth = told["refinement"]["sensor_depth"]
    assert depth["after"]["spread"] < 0.006
    assert depth["after"]["ratio"] == pytest.approx(1.0, abs=0.01)
    assert told["refinement"]["lens"]["taken"]
    assert told["refinement"]["lens"]["focal"] == pytest.approx(1 / 1.11, rel=0.015)


@pytest.mark.parametrize("says", [FOCAL, 1.03 * FOCAL], ids=["right", "wrong"])
def test_a_lens_that_is_stated_of_depth_stays_its_own(
    tmp_path: Path, pictures: list[Image.Image], says: float
) -> None:
    """As in 7-Scenes: depth by a longer lens than the pictures'."""
    sensor = 1.11 * FOCAL
    more: dict[str, Any] = {"focal": says, "depth_focal": sensor, "is_stated": True}
    ctx = context(tmp_path, drifted(), pictures, depth=1.0, **more)
    told = run(OPTIONS, ctx)["given"]
    assert told["verdict"] == "refined"
    cameras = CamerasFile.load(ctx.out / "cameras.json")
    assert cameras.cameras[0].fl_x == pytest.approx(FOCAL, rel=0.015)
    assert {image.depth_lens.fl_x for image in cameras.images if image.depth_lens} == {sensor}
    assert all(image.depth_lens for image in cameras.images)
    after = told["refinement"]["sensor_depth"]["after"]
    assert after["spread"] < 0.006
    assert after["ratio"] == pytest.approx(1.0, abs=0.01)


@pytest.mark.parametrize(
    ("depth", "metric", "codes_told"),
    [(1000.0, True, ["given_scale_contradicted"]), (0.0, True, []), (1.0, False, [])],
    ids=["millimetres", "no sensor", "no unit"],
)
def test_drifted_poses_keep_their_scale_where_no_sensor_tells_a_better_one(
    tmp_path: Path,
    pictures: list[Image.Image],
    depth: float,
    metric: bool,
    codes_told: list[str],
) -> None:
    poses = drifted()[:FEW]
    ctx = context(tmp_path, poses, pictures[:FEW], depth=depth, metric=metric)
    summary = run(OPTIONS, ctx)
    assert summary["given"]["verdict"] == "refined"
    assert codes(summary) == codes_told
    spread = [np.linalg.norm(all_[:, :, 3] - all_[:, :, 3].mean(0)) for all_ in (found(ctx), poses)]
    assert spread[0] / spread[1] == pytest.approx(1.0, abs=0.005)
    scale = summary["given"]["refinement"]["scale"]
    assert scale is None if not metric else scale["believed"] == "path"


def test_a_picture_that_shows_nothing_goes_with_its_neighbours(
    tmp_path: Path, pictures: list[Image.Image]
) -> None:
    blank = [*pictures[:6], Image.new("RGB", (WIDTH, HEIGHT), (90, 90, 90)), *pictures[7:]]
    poses = drifted()
    ctx = context(tmp_path, poses, blank)
    summary = run(OPTIONS, ctx)
    assert summary["given"]["verdict"] == "refined"
    assert summary["given"]["refinement"]["num_carried"] == 1
    move = similarity(found(ctx)[:, :, 3], TRUTH[:, :, 3])
    off = np.linalg.norm(move.apply_to_points(found(ctx)[:, :, 3]) - TRUTH[:, :, 3], axis=1)
    assert off[6] < 0.005 * EXTENT


def test_two_mixed_up_rows_are_placed_anew(tmp_path: Path, pictures: list[Image.Image]) -> None:
    poses = drifted()
    poses[[4, 11]] = poses[[11, 4]]
    ctx = context(tmp_path, poses, pictures)
    told = run(OPTIONS, ctx)["given"]
    assert told["verdict"] == "refined"
    assert told["refinement"]["replaced"] == ["images/00004.jpg", "images/00011.jpg"]
    centers, turns = errors(found(ctx))
    assert centers < 0.002
    assert turns < 0.3


def test_two_mixed_up_rows_are_named_where_poses_are_to_be_trusted(
    tmp_path: Path, pictures: list[Image.Image]
) -> None:
    poses = TRUTH.copy()
    poses[[4, 11]] = poses[[11, 4]]
    ctx = context(tmp_path, poses, pictures)
    summary = run(OPTIONS.model_copy(update={"given": "trust"}), ctx)
    (warning,) = summary["warnings"]
    assert warning["code"] == "given_poses_contradicted"
    assert "00011" in warning["message"]
    assert warning["details"]["files"] == ["images/00004.jpg", "images/00011.jpg"]
    assert_as_given(ctx)


def test_pictures_without_matches_leave_the_poses_and_say_so(tmp_path: Path) -> None:
    plain = [Image.new("RGB", (WIDTH, HEIGHT), (90, 90, index)) for index in range(NUM)]
    ctx = context(tmp_path, drifted(), plain)
    summary = run(OPTIONS, ctx)
    assert summary["given"]["verdict"] == "unverified"
    assert codes(summary) == ["given_poses_unverified"]
    assert_as_given(ctx)


def test_depth_that_the_refined_poses_contradict_keeps_the_given_ones(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("pipelines.stages.given_poses.points_beside", _worse_when_refined())
    ctx = context(tmp_path, drifted()[:FEW], pictures[:FEW])
    told = run(OPTIONS, ctx)["given"]
    assert told["verdict"] == "kept"
    assert "measured depth" in told["why"]
    assert_as_given(ctx)


def _worse_when_refined() -> Any:
    return lambda found, *_: Beside(1.0 if found.before is None else 1.2, 0.01, 2.0, 500, NUM)


@pytest.mark.parametrize(
    ("broken", "is_logged"),
    [(ToolError("no"), True), (ValueError("no"), True), (given.OutOfTime(), False)],
)
def test_a_refinement_that_breaks_off_leaves_the_given_poses_and_its_error_in_the_log(
    tmp_path: Path,
    pictures: list[Image.Image],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    broken: Exception,
    is_logged: bool,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise broken

    monkeypatch.setattr(given, "refine", fail)
    ctx = context(tmp_path, drifted()[:FEW], pictures[:FEW])
    summary = run(OPTIONS, ctx)
    assert summary["given"]["verdict"] == "kept"
    assert_as_given(ctx)
    told = [record.exc_info[1] for record in caplog.records if record.exc_info]
    assert told == ([broken] if is_logged else [])


@pytest.mark.parametrize("broken", [ToolError("no"), ValueError("no"), given.OutOfTime()])
def test_a_lens_that_cannot_be_adjusted_stays_and_poses_are_refined_all_the_same(
    tmp_path: Path,
    pictures: list[Image.Image],
    monkeypatch: pytest.MonkeyPatch,
    caplog: pytest.LogCaptureFixture,
    broken: Exception,
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise broken

    monkeypatch.setattr(given, "with_lenses", fail)
    ctx = context(tmp_path, drifted()[:FEW], pictures[:FEW])
    told = run(OPTIONS, ctx)["given"]
    assert told["verdict"] == "refined"
    assert told["refinement"]["lens"] is None
    assert [record.exc_info[1] for record in caplog.records if record.exc_info] == [broken]


def test_a_capture_whose_features_cannot_be_found_goes_on(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: Any, **__: Any) -> None:
        raise ToolError("COLMAP failed.")

    monkeypatch.setattr(Reconstructor, "extract", fail)
    ctx = context(tmp_path, drifted()[:FEW], pictures[:FEW])
    assert codes(run(OPTIONS, ctx)) == ["given_poses_unverified"]
    assert_as_given(ctx)


def test_a_cancel_ends_it(tmp_path: Path, pictures: list[Image.Image]) -> None:
    ctx = context(tmp_path, drifted(), pictures, is_cancelled=lambda: True)
    with pytest.raises(Cancelled):
        run(OPTIONS, ctx)
