"""`python -m pipelines` runs stages on a folder and says what is wrong."""

from __future__ import annotations

import io
import json
import subprocess
import sys
from pathlib import Path

import pytest

from pipelines.cli import ProgressLine, main
from pipelines.registry import get_stage
from pipelines.workspace import Workspace
from tests.unit.pipelines.captures.archives import nerfstudio_files, picture, write_zip
from tests.unit.pipelines.tools.clips import make_clip


def test_stage_by_stage_on_a_video(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    clip = make_clip(tmp_path / "walk.mp4")
    folder = str(tmp_path / "job")
    assert main(["run", "ingest", folder, "--input", str(clip), "--seed", "7"]) == 0
    assert main(["run", "frames", folder, "--set", "frames.num_frames=8"]) == 0
    out = capsys.readouterr().out
    assert '"num_frames": 8' in out
    workspace = Workspace(tmp_path / "job")
    assert json.loads(workspace.job_file.read_text()) == {
        "filename": "walk.mp4",
        "kind": "video",
        "seed": 7,
    }
    assert workspace.manifest("frames")["seed"] == 7
    assert len(list((workspace.images_root / "images").iterdir())) == 8


def test_run_all_reuses_what_is_current(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    source = write_zip(tmp_path / "c.zip", nerfstudio_files())
    command = ["run", "all", str(tmp_path / "job"), "--input", str(source), "--until", "poses"]
    assert main(command) == 0
    assert "is current" not in capsys.readouterr().err
    assert main(command) == 0
    assert "ingest     is current" in capsys.readouterr().err


def test_a_job_that_fails_leaves_its_report(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    pictures = {f"{i}.jpg": picture(seed=i) for i in range(8)}
    source = write_zip(tmp_path / "c.zip", pictures)
    assert main(["run", "all", str(tmp_path / "job"), "--input", str(source)]) == 1
    path = tmp_path / "job" / "report" / "report.json"
    assert str(path) in capsys.readouterr().err
    report = json.loads(path.read_text())
    assert (report["state"], report["error"]["stage"]) == ("failed", "poses")
    assert report["error"]["code"] == "no_features"
    assert len(report["failed_report"]["unregistered"]) == 8
    assert set(report["timings"]) == {"ingest_s"}


@pytest.mark.parametrize(
    ("assignment", "says"),
    [
        ("frames.nope=1", "frames.nope"),
        ("frames.num_frames=2", "greater than or equal to 8"),
        ("nope.x=1", "no such stage"),
        ("frames", "stage.option=value"),
    ],
)
def test_wrong_options_are_refused_before_anything_is_written(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], assignment: str, says: str
) -> None:
    source = write_zip(tmp_path / "c.zip", {"a.jpg": picture()})
    arguments = ["run", "all", str(tmp_path / "job"), "--input", str(source)]
    assert main([*arguments, "--set", assignment]) == 2
    assert says in capsys.readouterr().err
    assert not (tmp_path / "job").exists()


def test_errors_are_told_with_code_and_hint(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["run", "all", str(tmp_path / "job")]) == 1
    assert "capture_missing" in capsys.readouterr().err
    assert main(["run", "all", str(tmp_path / "job"), "--input", str(tmp_path / "none")]) == 1
    bad = write_zip(tmp_path / "c.zip", {"a.jpg": picture(), "b.jpg": picture()})
    assert main(["run", "ingest", str(tmp_path / "job"), "--input", str(bad)]) == 1
    assert "too_few_images" in capsys.readouterr().err
    assert main(["run", "train", str(tmp_path / "job")]) == 1
    assert "run ingest" in capsys.readouterr().err


def test_an_end_is_written_once_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    told = ProgressLine(get_stage("evaluate"), stream)
    told(0.5, "test photos", 9.0)
    for left in (0.4, 0.3, 0.0, None):
        told(1.0, "measuring floaters", left)
    told(1.0, "test photos", None)
    assert stream.getvalue().splitlines() == [
        "evaluate    100% measuring floaters, 0 s left",
        "evaluate    100% test photos",
    ]


def test_module_can_be_run() -> None:
    done = subprocess.run(
        [sys.executable, "-m", "pipelines", "run", "nothing", "x"], capture_output=True, text=True
    )
    assert done.returncode == 2
    assert "invalid choice" in done.stderr
