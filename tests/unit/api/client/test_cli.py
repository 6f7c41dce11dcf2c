"""The command: its exit statuses, what it prints, and that it never shows a traceback."""

from __future__ import annotations

import io
import json
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console

from api.client import cli
from api.client.client import Client
from api.client.display import (
    clean,
    print_job,
    print_warnings,
    quality_rows,
    watch_job,
)
from pipelines.presets import PRESETS
from storage.claims import claim_stage
from storage.jobs import stage_id
from storage.leases import fail_stage, heartbeat
from storage.records import append_logs
from tests.services import free_port
from tests.unit.api.conftest import (
    KEY,
    LEASE_S,
    LiveServer,
    finish_job,
    run_stage,
    zip_of_pictures,
)

ROOT = Path(__file__).resolve().parents[4]
REPORT: dict[str, Any] = {
    "capture": {"kind": "images"},
    "poses": {"num_images": 50, "num_registered": 46, "registered_ratio": 0.92},
    "metrics": {"psnr": 21.345, "ssim": 0.8123, "num_images": 5, "width": 480, "height": 270},
    "timings": {"ingest_s": 1.2, "train_s": 605.0},
}

DRAFT_REPORT: dict[str, Any] = {
    "capture": {"kind": "images"},
    "poses": {"num_images": 50, "num_registered": 46, "registered_ratio": 0.92},
    "metrics": None,
    "metrics_reason": "Nothing was trained.",
    "assets": None,
    "stages": {"draft": {"num_faces": 12345}},
    "timings": {"ingest_s": 1.2, "draft_s": 5.0},
}


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / "garden.zip"
    path.write_bytes(zip_of_pictures())
    return path


def newest(live: LiveServer) -> str:
    with Client(live.url, KEY) as client:
        return next(client.jobs()).id


def when_submitted(live: LiveServer, do: Any) -> threading.Thread:
    """Call `do(job id)` in a thread once there is a job."""

    def run() -> None:
        with Client(live.url, KEY) as client:
            deadline = time.monotonic() + 20
            while not (jobs := list(client.jobs())):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        do(jobs[0].id)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def test_submit_and_download_ends_with_files_and_tables(
    command: LiveServer, archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def content(name: str) -> bytes:
        return json.dumps(REPORT).encode() if name == "report.json" else f"this is {name}".encode()

    thread = when_submitted(command, lambda job: finish_job(command.services, job, content))
    out = tmp_path / "out"
    arguments = ["submit", str(archive), "--preset", "preview", "--download", str(out)]
    assert cli.main([*arguments, "--set", "train.max_steps=500", "--label", "a=b"]) == 0
    thread.join()
    printed = capsys.readouterr().out
    assert (out / "mesh.glb").read_bytes() == b"this is mesh.glb"
    for text in ("train", "succeeded", "any glTF viewer", "21.3", "46 of 50", "10 m 05"):
        assert text in printed, printed
    with Client() as client:
        job = client.get_job(newest(command))
    assert job.options["train"]["max_steps"] == 500
    assert job.labels == {"a": "b"}


def test_an_export_is_asked_for_waited_for_and_downloaded(
    command: LiveServer, archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["submit", str(archive), "--preset", "preview"]) == 0
    job = newest(command)
    assert cli.main(["export", job, "mesh"]) == 1
    assert "not ended yet" in capsys.readouterr().err
    finish_job(command.services, job, lambda name: b"x")

    def work() -> None:
        with Client(command.url, KEY) as client:
            deadline = time.monotonic() + 20
            while not (found := list(client.exports(job))):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        run_stage(command.services, found[0].id, "mesh", {"mesh.usdz": b"for a phone"})

    thread = threading.Thread(target=work, daemon=True)
    thread.start()
    out = tmp_path / "out"
    wanted = ["--set", "mesh.triangles=500", "--set", 'formats=["glb","usdz"]', "--label", "a=b"]
    assert cli.main(["export", job, "mesh", *wanted, "--download", str(out)]) == 0
    thread.join()
    assert [path.name for path in out.iterdir()] == ["mesh.usdz"]
    shown = capsys.readouterr().out
    assert "iPhone" in shown
    assert "PSNR" not in shown, "an export measures nothing"
    with Client() as client:
        (made,) = client.exports(job)
        assert made.export is not None
        assert (made.export.kind, made.export.job_id) == ("mesh", job)
        assert made.options["mesh"]["triangles"] == 500
        assert made.options["mesh"]["formats"] == ["glb", "usdz"]
        assert made.labels == {"a": "b"}
    assert cli.main(["exports", job]) == 0
    assert made.id in capsys.readouterr().out
    assert cli.main(["status", made.id]) == 0
    assert f"mesh of job {job}" in capsys.readouterr().out
    assert cli.main(["exports", "--kinds"]) == 0
    assert "pointcloud" in capsys.readouterr().out
    assert cli.main(["exports", "--kinds", "--json"]) == 0
    kinds = json.loads(capsys.readouterr().out)
    assert kinds[0]["options"]["properties"]
    assert cli.main(["export", job, "mesh", "--set", "triangles=-1"]) == 1
    assert "mesh.triangles" in capsys.readouterr().err


def test_retry_says_what_runs_again_and_events_say_who_did_what(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["submit", str(archive), "--preset", "preview"]) == 0
    job = newest(command)
    finish_job(command.services, job, lambda name: b"x")
    capsys.readouterr()
    assert cli.main(["retry", job]) == 1
    assert "nothing to do again" in capsys.readouterr().err
    assert cli.main(["retry", job, "--from", "assess", "--set", "mesh.max_faces=4000"]) == 0
    assert "runs again: mesh, pointcloud, video, assess, report" in capsys.readouterr().out
    assert cli.main(["events"]) == 0
    lines = capsys.readouterr().out.splitlines()
    assert "job.queued  api-key:" in lines[0]
    assert any("mesh: stage.blocked  api-key:" in line and "retry" in line for line in lines)
    with Client() as client:
        seen = list(client.events(job))
        assert len(seen) == len(lines)
        assert [event.seq for event in client.events(job, seen[3].seq)] == [
            event.seq for event in seen[4:]
        ]


def test_a_draft_is_shown_without_numbers_that_nobody_measured(
    command: LiveServer, archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def content(name: str) -> bytes:
        return json.dumps(DRAFT_REPORT).encode() if name == "report.json" else b"x"

    thread = when_submitted(command, lambda job: finish_job(command.services, job, content))
    out = tmp_path / "out"
    assert cli.main(["submit", str(archive), "--preset", "draft", "--download", str(out)]) == 0
    thread.join()
    assert (out / "draft.glb").is_file()
    assert not (out / "mesh.glb").exists()
    assert cli.main(["status"]) == 0
    printed = capsys.readouterr().out
    for text in ("skipped", "draft.glb", "12,345 triangles", "Nothing was trained", "46 of 50"):
        assert text in printed, printed
    for text in ("PSNR", "SSIM", "held-out images", "None"):
        assert text not in printed, printed


def test_failed_job_is_exit_status_1_with_its_advice(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(job: str) -> None:
        with command.services.database.session_scope() as session:
            claim = claim_stage(session, stage_id(job, "ingest"), "test", LEASE_S)
            assert claim is not None
            error = {"code": "no_parallax", "message": "Nothing moved.", "hint": "Walk around."}
            fail_stage(session, claim, error, retryable=False)

    when_submitted(command, fail)
    assert cli.main(["submit", str(archive), "--wait"]) == 1
    printed = capsys.readouterr().out
    assert "Nothing moved." in printed
    assert "Walk around." in printed
    assert cli.main(["status"]) == 1
    assert "no_parallax" in capsys.readouterr().out


def test_status_list_logs_cancel_delete_and_presets(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["submit", str(archive)]) == 0
    job = newest(command)
    assert job in capsys.readouterr().out
    services = command.services
    with services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job, "ingest"), "test", LEASE_S)
        assert claim is not None
        heartbeat(session, claim, LEASE_S, progress=0.5, message="photo 2/4", eta_s=70)
        append_logs(session, claim, ["first", "second [red]\x1b[31m line"])
    assert cli.main(["status", job]) == 0
    shown = capsys.readouterr().out
    assert "50%" in shown
    assert "1 m 10 s left" in shown
    assert cli.main(["logs", job, "--line", "-1", "--stage", "ingest"]) == 0
    assert capsys.readouterr().out == "second [red] [31m line\n"
    assert cli.main(["list", "--state", "running"]) == 0
    assert "ingest 50%" in capsys.readouterr().out
    assert cli.main(["delete", job]) == 1
    assert "cancel it first" in capsys.readouterr().err
    assert cli.main(["cancel", job]) == 0
    assert "cancelling" in capsys.readouterr().out
    assert cli.main(["delete", job]) == 1
    assert "is cancelling; wait until it has stopped" in capsys.readouterr().err
    assert cli.main(["presets"]) == 0
    shown = capsys.readouterr().out
    assert all(preset in shown for preset in PRESETS), shown
    with Client(command.url, KEY) as client:
        assert "train" in {one.name: one.without for one in client.presets().items}["draft"]


def test_logs_follow_until_the_job_is_over(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cli.main(["submit", str(archive)])
    job = newest(command)
    services = command.services

    def write() -> None:
        time.sleep(0.5)
        with services.database.session_scope() as session:
            claim = claim_stage(session, stage_id(job, "ingest"), "test", LEASE_S)
            assert claim is not None
            append_logs(session, claim, ["late line"])
            fail_stage(session, claim, {"code": "x", "message": "m", "hint": "h"}, retryable=False)

    thread = threading.Thread(target=write)
    thread.start()
    assert cli.main(["logs", job, "--follow"]) == 0
    thread.join()
    assert capsys.readouterr().out.count("late line") == 1


def test_download_goes_to_a_folder_of_the_job(
    command: LiveServer, archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    cli.main(["submit", str(archive)])
    job = newest(command)
    finish_job(command.services, job, lambda name: b"x")
    assert cli.main(["download"]) == 0
    assert (tmp_path / "out" / job / "video.mp4").read_bytes() == b"x"


def test_download_over_other_files_is_refused_unless_it_is_said(
    command: LiveServer, archive: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["submit", str(archive), "--preset", "preview"]) == 0
    job = newest(command)
    finish_job(command.services, job, lambda name: b"new")
    out = tmp_path / "out"
    out.mkdir()
    (out / "mesh.glb").write_bytes(b"of another job")
    assert cli.main(["download", job, str(out)]) == 1
    said = capsys.readouterr().err
    assert "mesh.glb" in said
    assert f"nerfworks download {job} OTHER_FOLDER" in said
    assert (out / "mesh.glb").read_bytes() == b"of another job"
    assert cli.main(["download", job, str(out), "--overwrite"]) == 0
    assert (out / "mesh.glb").read_bytes() == b"new"


def test_download_of_a_job_that_offers_nothing_says_how_it_stands(
    command: LiveServer,
    archive: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.chdir(tmp_path)
    cli.main(["submit", str(archive)])
    job = newest(command)
    for state, hint in (("queued", f"nerfworks watch {job}"), ("cancelled", f"retry {job}")):
        capsys.readouterr()
        assert cli.main(["download"]) == 1
        said = capsys.readouterr()
        assert f"Job {job} is {state}: there is nothing to download." in said.err
        assert hint in said.err
        assert not said.out
        assert not (tmp_path / "out").exists()
        cli.main(["cancel", job])


@pytest.mark.parametrize(
    "arguments",
    [
        ["submit", "no-such-file.mp4"],
        ["submit", "{archive}", "--set", "train.max_steps"],
        ["submit", "{archive}", "--label", "novalue"],
    ],
)
def test_wrong_usage_is_exit_status_2(
    command: LiveServer, archive: Path, arguments: list[str], capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main([text.format(archive=archive) for text in arguments]) == 2
    assert capsys.readouterr().err
    with Client() as client:
        assert list(client.captures()) == []


def test_unknown_command_is_exit_status_2() -> None:
    with pytest.raises(SystemExit) as caught:
        cli.main(["paint"])
    assert caught.value.code == 2


def test_refusals_name_each_wrong_option(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert cli.main(["submit", str(archive), "--set", "train.max_stepz=1"]) == 1
    shown = capsys.readouterr().err
    assert "train.max_stepz" in shown
    assert "Traceback" not in shown


def test_service_that_is_away_is_exit_status_3(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for name in ("NERFWORKS_URL", "NERFWORKS_API_KEY", "NERFWORKS_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    assert cli.main(["list"]) == 3
    assert "make up" in capsys.readouterr().err
    monkeypatch.setattr(cli, "RETRY_S", 0.2)
    assert cli.main(["--url", f"http://127.0.0.1:{free_port()}", "list"]) == 3
    assert "cannot be reached" in capsys.readouterr().err


def test_ctrl_c_while_watching_leaves_the_job_running(command: LiveServer, archive: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-m", "nerfworks", "submit", str(archive), "--wait"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        cwd=ROOT,
        env={**os.environ, "PYTHONUNBUFFERED": "1"},
    )

    def begin(job: str) -> None:
        run_stage(command.services, job, "ingest", {})
        time.sleep(1.5)
        process.send_signal(signal.SIGINT)

    when_submitted(command, begin)
    out, errors = process.communicate(timeout=30)
    assert process.returncode == 130
    assert "The job goes on" in out
    assert "Traceback" not in out + errors
    with Client() as client:
        assert client.get_job(newest(command)).state == "running"


def test_bars_are_drawn_for_each_stage_on_a_terminal(command: LiveServer, archive: Path) -> None:
    with Client() as client:
        job = client.create_job(client.upload(archive).id)
        when_submitted(command, lambda job: finish_job(command.services, job, lambda _: b"x"))
        screen = io.StringIO()
        console = Console(file=screen, force_terminal=True, width=120)
        assert watch_job(client, job.id, console).state == "succeeded"
    for stage in job.stages:
        assert stage.name in screen.getvalue()


def test_coverage_and_mesh_psnr_stand_beside_psnr_and_warnings_below(
    command: LiveServer, archive: Path
) -> None:
    with Client() as client:
        job = client.create_job(client.upload(archive).id)
        finish_job(command.services, job.id, lambda _: b"x")
        screen = io.StringIO()
        print_job(client.get_job(job.id), Console(file=screen, width=120))
    shown = screen.getvalue()
    assert "25.50 dB" in shown
    assert "72% of held-out views" in shown
    assert "21.50 dB where it covers" in shown
    assert "geometry_poor" in shown
    assert "Film with more overlap." in shown

    assets = {"mesh": {"coverage": 0.2, "psnr": None}}
    rows = dict(quality_rows({**REPORT, "assets": assets}))
    assert rows["mesh covers"] == "20% of held-out views"
    assert rows["mesh PSNR"] == "not measured"
    names = list(rows)
    assert names.index("mesh covers") == names.index("held-out SSIM") + 1
    assert "mesh covers" not in dict(quality_rows(REPORT))


def test_a_warning_is_shown_with_its_advice_and_cannot_steer_the_terminal() -> None:
    screen = io.StringIO()
    warning = {"code": "geometry_poor", "message": "Bad [red]news\x1b[31m", "hint": "Do this."}
    print_warnings([warning], Console(file=screen, width=120))
    assert "geometry_poor" in screen.getvalue()
    assert "Bad [red]news [31m" in screen.getvalue()
    assert "Do this." in screen.getvalue()


def test_results_show_what_was_not_measured(tmp_path: Path) -> None:
    rows = dict(quality_rows({"metrics": {"psnr": None, "ssim": None, "num_images": 0}}))
    assert rows["held-out PSNR"] == rows["held-out SSIM"] == "not measured"
    assert dict(quality_rows(REPORT))["images registered"] == "46 of 50 (92%)"
    assert dict(quality_rows(REPORT))["held-out images"] == "5, 480 x 270 px"


def test_text_of_a_service_cannot_steer_the_terminal() -> None:
    screen = io.StringIO()
    Console(file=screen, width=80).print(clean("a\x1b[31mb [bold]c\r\nd"), highlight=False)
    assert screen.getvalue() == "a [31mb [bold]c  d\n"


def test_options_are_refused_before_anything_is_uploaded(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for wrong in (["--set", "train.max_stepz=5"], ["--preset", "nope"], ["--label", "b d=1"]):
        assert cli.main(["submit", str(archive), *wrong]) == 1
        printed = capsys.readouterr()
        assert "Capture" not in printed.out, "the file was sent first"
        assert printed.err
    with Client() as client:
        assert list(client.captures()) == []


def test_a_capture_that_is_there_is_used_again_and_can_be_deleted(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with Client() as client:
        capture = client.upload(archive)
        assert cli.main(["submit", "--capture", capture.id, "--preset", "draft"]) == 0
        (job,) = client.jobs()
        assert (job.capture_id, job.preset) == (capture.id, "draft")
        assert cli.main(["captures"]) == 0
        assert capture.id in capsys.readouterr().out
        assert cli.main(["submit"]) == cli.main(["submit", str(archive), "--capture", "x"]) == 2
        assert cli.main(["submit", "--capture", "nope"]) == 1
        assert cli.main(["captures", "--delete", capture.id]) == 1  # a job is on it
        client.cancel(job.id)
        assert cli.main(["captures", "--delete", capture.id]) == 0
        assert list(client.captures()) == []


def test_json_is_all_there_is_on_the_standard_output(
    command: LiveServer, archive: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def said(*arguments: str) -> Any:
        assert cli.main([*arguments, "--json"]) == 0
        return json.loads(capsys.readouterr().out)

    job = said("submit", str(archive), "--label", "a=b")
    assert (job["state"], job["labels"]) == ("queued", {"a": "b"})
    assert said("status", job["id"]) == job
    assert [one["id"] for one in said("list", "--label", "a=b")] == [job["id"]]
    assert said("list", "--state", "failed") == []
    assert [one["id"] for one in said("captures")] == [job["capture_id"]]
    assert {one["name"] for one in said("presets")["items"]} == set(PRESETS)
