"""`client.check` and `nerfworks check`: a verdict and advice, also of what cannot be used."""

from __future__ import annotations

import json
import threading
import time
from pathlib import Path
from typing import Any

import pytest

from api.client import cli
from api.client.client import Client, JobFailed
from storage.claims import claim_stage
from storage.jobs import stage_id
from storage.leases import fail_stage
from tests.unit.api.conftest import KEY, LEASE_S, LiveServer, finish_job, zip_of_pictures

UNUSABLE = {"verdict": "unusable", "reasons": ["Nothing moved."], "advice": ["Walk around."]}


@pytest.fixture
def archive(tmp_path: Path, live: LiveServer, monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("NERFWORKS_URL", live.url)
    monkeypatch.setenv("NERFWORKS_API_KEY", KEY)
    monkeypatch.setenv("COLUMNS", "200")
    (tmp_path / "garden.zip").write_bytes(zip_of_pictures())
    return str(tmp_path / "garden.zip")


def once_started(live: LiveServer, do: Any) -> threading.Thread:
    """Call `do(job id)` in a thread once there is a job."""

    def run() -> None:
        with Client(live.url, KEY) as client:
            deadline = time.monotonic() + 60
            while not (jobs := list(client.jobs())):
                assert time.monotonic() < deadline
                time.sleep(0.05)
        do(jobs[0].id)

    thread = threading.Thread(target=run, daemon=True)
    thread.start()
    return thread


def failing(live: LiveServer, details: dict[str, Any]) -> Any:
    def fail(job: str) -> None:
        with live.services.database.session_scope() as session:
            claim = claim_stage(session, stage_id(job, "ingest"), "test", LEASE_S)
            assert claim is not None
            error = {"code": "no_images", "message": "No.", "hint": "Again.", "details": details}
            fail_stage(session, claim, error, retryable=False)

    return fail


def test_a_check_says_how_good_a_capture_is_and_what_to_do(
    live: LiveServer, archive: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    thread = once_started(live, lambda job: finish_job(live.services, job, lambda name: b"x"))
    assert cli.main(["check", archive, "--download", str(tmp_path / "out"), "--json"]) == 0
    thread.join()
    shown = capsys.readouterr()
    assert json.loads(shown.out)["check"]["verdict"] == "usable"
    for text in ("The capture is usable.", "Few.", "What to do next time:", "- More."):
        assert text in shown.err
    found = {path.name for path in (tmp_path / "out").iterdir()}
    assert {"capture-report.html", "capture-report.json"} <= found


def test_an_unusable_capture_is_exit_status_1_with_its_verdict(
    live: LiveServer, archive: str, capsys: pytest.CaptureFixture[str]
) -> None:
    thread = once_started(live, failing(live, {"check": UNUSABLE}))
    assert cli.main(["check", archive]) == 1
    thread.join()
    shown = capsys.readouterr().out
    assert "The capture is unusable." in shown
    assert "Walk around." in shown
    with Client(live.url, KEY) as client:
        capture = next(client.captures()).id
        job = client.start_check(capture, labels={"try": "2"})
        assert (job.preset, job.labels) == ("check", {"try": "2"})
        failing(live, {"check": UNUSABLE})(job.id)
        assert client.wait(job.id).check is not None


def test_a_job_that_says_nothing_of_the_capture_is_an_error(live: LiveServer, archive: str) -> None:
    with Client(live.url, KEY) as client:
        capture = client.upload(archive)
        thread = once_started(live, failing(live, {}))
        with pytest.raises(JobFailed, match="No"):
            client.check(capture.id, timeout=120)
        thread.join()


def test_a_check_wants_one_capture(archive: str) -> None:
    assert cli.main(["check"]) == 2
    assert cli.main(["check", archive, "--capture", "x"]) == 2
