"""The capture report of a job: from what its stages left, also where one of them failed."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from pipelines.captures.record import CaptureRecord
from pipelines.errors import PosesError, ResourceError
from pipelines.manifest import run_stage
from pipelines.registry import get_stage
from pipelines.scene.cameras_file import CamerasFile, Intrinsics, PosedImage
from pipelines.stage import StageContext
from pipelines.stages.report import write_failed_report_locally
from pipelines.workspace import MANIFEST, Workspace
from tests.unit.pipelines.filming.takes import ring

NUM = 12
REPORTS = {"capture-report.json", "capture-report.html"}


def complete(workspace: Workspace, name: str) -> Path:
    folder = workspace.stage(name)
    folder.mkdir(parents=True, exist_ok=True)
    manifest = {"content": name, "summary": {}, "timings": {"wall_s": 1.0}, "options": {}}
    (folder / MANIFEST).write_text(json.dumps({**manifest, "files": []}))
    return folder


@pytest.fixture
def film(tmp_path: Path) -> Workspace:
    """A job of 12 frames, 8 of which have a pose; two were filmed from a spinning camera."""
    workspace = Workspace(tmp_path)
    video = {"duration_s": 6.0}
    CaptureRecord("video", "walk.mp4", "00", video=video).save(complete(workspace, "ingest"))
    frames = complete(workspace, "frames")
    (frames / "images").mkdir()
    rng = np.random.default_rng(0)
    rows = []
    for index in range(NUM):
        noise = Image.fromarray(rng.integers(0, 256, (60, 80), np.uint8)).resize((160, 120))
        noise.save(frames / f"images/{index}.jpg")
        rows.append(
            {
                "file": f"images/{index}.jpg",
                "timestamp_s": 0.5 * index,
                "speed": 2.0 if index in (4, 5) else 0.1,
                "gain_ev": 0.0,
            }
        )
    (frames / "frames.json").write_text(json.dumps({"frames": rows}))
    return workspace


def poses_report(placed: range) -> dict[str, Any]:
    return {
        "num_images": NUM,
        "num_registered": len(placed),
        "registered_ratio": len(placed) / NUM,
        "metric": False,
        "median_triangulation_angle_deg": 12.0,
        "advice": ["Move."],
        "images": [
            {
                "file": f"images/{index}.jpg",
                "num_features": 900,
                "best_inliers": 200 if index in placed else 5,
                "group": 0 if index in placed else None,
            }
            for index in range(NUM)
        ],
        "placed": {
            "files": [f"images/{index}.jpg" for index in placed],
            "poses": ring(NUM)[list(placed)].tolist(),
            "points": [[0.0, 0.0, 0.1]],
            "colors": [[1, 2, 3]],
        },
    }


def test_what_was_lost_is_told_with_its_time_and_its_cause(film: Workspace) -> None:
    folder = complete(film, "poses")
    kept = [index for index in range(NUM) if index not in (4, 5)]
    report = poses_report(range(NUM))
    for index in (4, 5):
        report["images"][index] |= {"group": None, "best_inliers": 5}
    (folder / "report.json").write_text(json.dumps(report))
    images = tuple(
        PosedImage(f"images/{index}.jpg", 0, tuple(map(tuple, ring(NUM)[index].tolist())))
        for index in kept
    )
    lens = Intrinsics(160, 120, 100.0, 100.0, 80.0, 60.0)
    CamerasFile((lens,), images).save(folder / "cameras.json")
    summary = run_stage(get_stage("check"), {}, film)["summary"]
    assert {path.name for path in film.stage("check").iterdir()} == {*REPORTS, MANIFEST}
    assert summary["verdict"] == "usable"
    assert "moved_too_fast" in summary["findings"]
    assert any(line.startswith("From 0:02 to 0:02 you") for line in summary["reasons"]) or any(
        line.startswith("At 0:02 you") for line in summary["reasons"]
    )
    assert summary["lost_s"] == pytest.approx(1.0)
    report = json.loads((film.stage("check") / "capture-report.json").read_text())
    assert [row["cause"] for row in report["timeline"]].count("moved_too_fast") == 2
    assert len(report["path"]) == 10


def too_few(options: Any, ctx: StageContext) -> dict[str, Any]:
    """A stage `poses` that places 4 pictures and gives up."""
    del options
    (ctx.out / "report.json").write_text(json.dumps(poses_report(range(4))))
    raise PosesError("4 of 12 frames registered.", code="too_few_registered", hint="Move slowly.")


def out_of_memory(options: Any, ctx: StageContext) -> dict[str, Any]:
    """A stage `poses` that the machine ends."""
    del options, ctx
    raise ResourceError("No memory.", code="out_of_memory")


def breaks_down(options: Any, ctx: StageContext) -> dict[str, Any]:
    """A stage `poses` with a fault in it."""
    del options, ctx
    raise ZeroDivisionError("/secret/path")


def failing(how: str) -> Any:
    return dataclasses.replace(get_stage("poses"), run=f"{__name__}:{how}")


def test_a_stage_that_fails_for_the_capture_leaves_the_report(film: Workspace) -> None:
    with pytest.raises(PosesError) as caught:
        run_stage(failing("too_few"), {}, film)
    check = caught.value.details["check"]
    assert check["verdict"] == "unusable"
    assert check["reasons"] == ["4 of 12 frames registered."]
    assert check["advice"][0] == "Move slowly."
    left = {path.name for path in film.failed("poses").iterdir()}
    assert left == {"report.json", *REPORTS}
    report = json.loads((film.failed("poses") / "capture-report.json").read_text())
    assert len(report["path"]) == 4, "the poses that there were are drawn"
    assert report["pictures"] == {"num": NUM, "num_placed": 4, "ratio": 0.3333}
    path = write_failed_report_locally(film, "poses", caught.value.as_dict())
    assert {file.name for file in path.parent.iterdir()} > REPORTS
    job = json.loads(path.read_text())
    assert job["check"] == check
    assert "images" not in job["failed_report"], "each picture is in the capture report"


def test_a_machine_that_fails_is_no_verdict(film: Workspace) -> None:
    with pytest.raises(ResourceError) as caught:
        run_stage(failing("out_of_memory"), {}, film)
    assert caught.value.details["check"]["verdict"] is None
    assert {path.name for path in film.failed("poses").iterdir()} == REPORTS


def test_a_stage_that_breaks_down_leaves_the_report_of_the_capture_too(film: Workspace) -> None:
    with pytest.raises(ZeroDivisionError):
        run_stage(failing("breaks_down"), {}, film)
    assert {path.name for path in film.failed("poses").iterdir()} == REPORTS
    page = (film.failed("poses") / "capture-report.html").read_text()
    assert "/secret/path" not in page
    error = {"code": "internal_error", "message": "The stage poses failed.", "hint": ""}
    path = write_failed_report_locally(film, "poses", error)
    job = json.loads(path.read_text())
    assert (job["check"]["verdict"], len(job["check"]["reasons"])) == (None, 1)
    assert {file.name for file in path.parent.iterdir()} > REPORTS


def test_what_goes_wrong_while_explaining_does_not_hide_the_failure(
    film: Workspace, caplog: pytest.LogCaptureFixture
) -> None:
    (film.stage("frames") / "frames.json").write_text("{")
    with pytest.raises(PosesError, match="4 of 12"):
        run_stage(failing("too_few"), {}, film)
    assert "no more could be said" in caplog.text
