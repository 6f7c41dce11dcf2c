"""Given poses that are written by another convention, or that are of something else."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image
from scipy.spatial.transform import Rotation

from pipelines.captures.record import CaptureRecord
from pipelines.errors import PosesError
from pipelines.exports.formats.ply import read_ply
from pipelines.manifest import run_stage
from pipelines.options import PosesOptions
from pipelines.registry import get_stage
from pipelines.scene.cameras_file import CamerasFile
from pipelines.sfm.given_readings import other_readings
from pipelines.stage import StageContext
from pipelines.stages import poses as poses_stage
from pipelines.stages.poses import run
from pipelines.workspace import MANIFEST
from tests.unit.pipelines.sfm.synthetic_room import render
from tests.unit.pipelines.stages.posed_room import (
    EXTENT,
    FEW,
    NUM,
    OPTIONS,
    TRUTH,
    Poses,
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


OTHER_AXES = np.array([1.0, -1.0, -1.0, 1.0])


def test_poses_with_axes_of_another_program_are_told_and_stay_where_they_are_to_be_trusted(
    tmp_path: Path, pictures: list[Image.Image]
) -> None:
    ctx = context(tmp_path, TRUTH * OTHER_AXES, pictures)
    summary = run(OPTIONS.model_copy(update={"given": "trust"}), ctx)
    (warning,) = summary["warnings"]
    assert warning["code"] == "given_poses_contradicted"
    assert "axes" in warning["hint"]
    assert "would fit if" in warning["hint"]
    assert summary["given"]["verdict"] == "kept"
    assert_as_given(ctx)


@pytest.mark.parametrize("drift", [0.0, 0.015], ids=["exact", "drifted"])
def test_poses_with_axes_of_another_program_are_read_by_them(
    tmp_path: Path, pictures: list[Image.Image], drift: float
) -> None:
    num = NUM if drift else FEW
    poses = drifted(drift, 60.0 * drift)[:num]
    ctx = context(tmp_path, poses * OTHER_AXES, pictures[:num])
    summary = run(OPTIONS, ctx)
    (warning,) = summary["warnings"]
    assert warning["code"] == "given_poses_reread"
    assert "axes" in warning["message"]
    assert summary["given"]["verdict"] == ("refined" if drift else "trusted")
    assert summary["given"]["written"]["agreement"] < 0.5 < summary["given"]["sampled"]["agreement"]
    cameras = CamerasFile.load(ctx.out / "cameras.json")
    assert cameras.metric
    assert "axes" in cameras.notes["read"]
    # In the world and at the scale that they came in.
    assert np.abs(found(ctx) - TRUTH[:num]).max() < (0.02 * EXTENT if drift else 1e-6)
    off = np.abs(read_ply(ctx.out / "points.ply").points).min(axis=1)
    assert np.median(off) < (0.02 if drift else 0.002) * EXTENT


def inverted(poses: Poses) -> Poses:
    last = np.tile([[[0, 0, 0, 1.0]]], (len(poses), 1, 1))
    return np.linalg.inv(np.concatenate([poses, last], 1))[:, :3]


def test_inverted_poses_are_told_by_the_world_that_they_came_in() -> None:
    (reading,) = [
        reading
        for reading in other_readings(inverted(TRUTH))
        if np.allclose(reading.poses * OTHER_AXES, TRUTH)
    ]
    assert "world to the camera" in reading.words


@pytest.mark.parametrize("is_turned", [False, True], ids=["as it came", "turned by its pictures"])
def test_a_world_that_was_turned_by_wrong_poses_is_turned_anew(
    tmp_path: Path, pictures: list[Image.Image], is_turned: bool
) -> None:
    """`ingest` turned it so that pictures are upright by poses that are the wrong way round."""
    lying = Rotation.from_euler("x", -90, degrees=True).as_matrix()
    applied = np.concatenate([lying, [[0.5], [0.25], [-1.0]]], axis=1)
    num = FEW if is_turned else NUM
    sent = inverted(TRUTH[:num])
    moved = applied[:, :3] @ sent
    moved[:, :, 3] += applied[:, 3]
    ctx = context(tmp_path, moved, pictures[:num])
    path = ctx.workspace.stage("ingest") / "cameras.json"
    notes = {"applied_transform": applied.tolist()} | ({"up": "+Y"} if is_turned else {})
    replace(CamerasFile.load(path), notes=notes).save(path)
    summary = run(OPTIONS, ctx)
    assert codes(summary) == ["given_poses_reread"]
    cameras = CamerasFile.load(ctx.out / "cameras.json")
    if is_turned:  # as sent, the room stands
        assert "applied_transform" not in cameras.notes
        assert np.abs(found(ctx) - TRUTH[:num]).max() < 1e-6
    else:  # it is known how it was moved, and seen that it lies
        whole = np.array(cameras.notes["applied_transform"])
        back = found(ctx)
        back[:, :, 3] -= whole[:, 3]
        assert np.abs(whole[:, :3].T @ back - TRUTH[:num]).max() < 1e-6
        assert np.allclose(whole[:, :3] @ [0.0, 0.0, 1.0], [0.0, 0.0, 1.0])
    points = read_ply(ctx.out / "points.ply").points - found(ctx)[:, :, 3].mean(0)
    assert np.linalg.norm(points, axis=1).max() < 10 * EXTENT


def scattered() -> Poses:
    """As many poses that have nothing to do with the pictures."""
    random, truth = np.random.default_rng(5), TRUTH
    turned = Rotation.from_rotvec(random.uniform(-1, 1, (NUM, 3))).as_matrix()
    return np.concatenate(
        [turned @ truth[::-1, :, :3], truth[:, :, 3:] + random.uniform(-1, 1, (NUM, 3, 1))], 2
    )


def test_poses_of_something_else_are_replaced_by_those_that_pictures_have(
    tmp_path: Path, pictures: list[Image.Image]
) -> None:
    shares: list[float] = []
    ctx = context(
        tmp_path, scattered(), pictures, on_progress=lambda share, *_: shares.append(share)
    )
    workspace = ctx.workspace
    images = [{"file": f"images/{index:05d}.jpg", "name": f"{index}.jpg"} for index in range(NUM)]
    CaptureRecord("nerfstudio", "a.zip", "00", images=images).save(workspace.stage("ingest"))
    summary = run(OPTIONS, ctx)
    assert summary["num_registered"] == NUM
    assert not summary["metric"]
    centers, turns = errors(found(ctx))
    assert centers < 0.01
    assert turns < 0.5
    report = json.loads((ctx.out / "report.json").read_text())
    assert len(report["images"]) == NUM
    assert shares == sorted(shares)
    assert summary["given"]["verdict"] == report["given"]["verdict"] == "replaced"
    assert codes(summary) == codes(report) == ["given_poses_replaced"]
    assert summary["given"]["sampled"]["agreement"] < 0.5
    ctx.out.rename(workspace.stage("poses"))
    for stage in ("ingest", "poses"):
        manifest: dict[str, Any] = {
            "content": stage,
            "summary": {},
            "timings": {},
            "options": {},
            "files": [],
        }
        (workspace.stage(stage) / MANIFEST).write_text(json.dumps(manifest))
    told = run_stage(get_stage("check"), {}, workspace)["summary"]
    assert "given_poses_replaced" in told["findings"]
    assert told["verdict"] == "usable"


def test_poses_that_are_to_be_ignored_are_not_looked_at(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(poses_stage, "_found", lambda options, ctx: {"num_registered": FEW})
    monkeypatch.setattr(poses_stage, "judge_given", None)
    ctx = context(tmp_path, TRUTH[:FEW], pictures[:FEW])
    assert run(OPTIONS.model_copy(update={"given": "ignore"}), ctx) == {"num_registered": FEW}


def test_poses_that_none_are_better_than_stay(
    tmp_path: Path, pictures: list[Image.Image], monkeypatch: pytest.MonkeyPatch
) -> None:
    def none(options: PosesOptions, ctx: StageContext) -> dict[str, Any]:
        for name in ("cameras.json", "points.ply"):
            (ctx.out / name).write_text("of another attempt")
        return {"agreement": 0.4, "registered_ratio": 1.0}

    ctx = context(tmp_path / "doubtful", scattered()[:FEW], pictures[:FEW])
    monkeypatch.setattr(poses_stage, "_found", none)
    assert codes(run(OPTIONS, ctx)) == ["given_poses_contradicted"]
    assert_as_given(ctx)
    assert not (ctx.out / "points.ply").exists()

    def fails(options: PosesOptions, ctx: StageContext) -> dict[str, Any]:
        raise PosesError("no", code="no_parallax", hint="")

    ctx = context(tmp_path / "failed", scattered()[:FEW], pictures[:FEW])
    monkeypatch.setattr(poses_stage, "_found", fails)
    assert codes(run(OPTIONS, ctx)) == ["given_poses_contradicted"]
    assert_as_given(ctx)
