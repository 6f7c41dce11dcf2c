"""Checking a capture: a job that ends after the poses, and what it says however it ends."""

from __future__ import annotations

from typing import Any

import pytest

from storage.claims import claim_stage
from storage.jobs import stage_id
from storage.leases import FailureReport, fail_stage
from tests.unit.api.conftest import LEASE_S, Service, finish_job, problem, run_stage

REPORTS = ["capture-report.json", "capture-report.html"]
UNUSABLE = {"verdict": "unusable", "reasons": ["Nothing moved."], "advice": ["Walk around."]}


def check(service: Service, body: Any = None, **headers: str) -> dict[str, Any]:
    path = f"/v1/captures/{service.upload()['id']}/check"
    answer = service.http.post(path, json=body, headers=headers)
    assert answer.status_code == 202, answer.text
    assert answer.headers["Location"] == f"/v1/jobs/{answer.json()['id']}"
    assert answer.headers["Retry-After"] == "1"
    found: dict[str, Any] = answer.json()
    return found


def job_of(service: Service, job_id: str) -> dict[str, Any]:
    found: dict[str, Any] = service.http.get(f"/v1/jobs/{job_id}").json()
    return found


def test_a_check_is_a_job_that_makes_nothing(service: Service) -> None:
    job = check(service)
    assert (job["preset"], job["check"]) == ("check", None)
    todo = [stage["name"] for stage in job["stages"] if stage["state"] != "skipped"]
    assert todo == ["ingest", "poses", "check", "report"]
    finish_job(service.services, job["id"], lambda name: b"x")
    done = job_of(service, job["id"])
    assert done["state"] == "succeeded"
    assert done["check"] == {"verdict": "usable", "reasons": ["Few."], "advice": ["More."]}
    assert [one["name"] for one in done["artifacts"]] == [*REPORTS, "report.json"]


def test_a_check_takes_options_and_labels(service: Service) -> None:
    wanted = {"options": {"poses": {"min_baseline_deg": 5.0}}, "labels": {"shop": "9"}}
    job = check(service, wanted)
    assert job["options"]["poses"]["min_baseline_deg"] == 5.0
    assert job["labels"] == {"shop": "9"}


@pytest.mark.parametrize(
    ("body", "code"),
    [
        ({"options": {"poses": {"min_baseline_deg": -5}}}, "options_invalid"),
        ({"options": {"train": {"max_steps": 5}}}, "options_invalid"),
        ({"preset": "high"}, "request_invalid"),
    ],
)
def test_what_a_check_does_not_take(service: Service, body: Any, code: str) -> None:
    answer = service.http.post(f"/v1/captures/{service.upload()['id']}/check", json=body)
    problem(answer, 422, code)


def test_a_capture_that_is_not_there_cannot_be_checked(service: Service) -> None:
    problem(service.http.post("/v1/captures/nope/check"), 404, "capture_not_found")


def test_a_check_is_made_once(service: Service) -> None:
    path = f"/v1/captures/{service.upload()['id']}/check"
    first, second = (
        service.http.post(path, headers={"Idempotency-Key": "mine"}).json()["id"] for _ in range(2)
    )
    assert first == second


def fail_in(service: Service, job_id: str, stage: str, files: list[str]) -> None:
    """The stage ends the job, and its worker publishes those files with the failure."""
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, stage), "test", LEASE_S)
        assert claim is not None
        entries = [{"path": path, "bytes": 1, "sha256": "00"} for path in files]
        error = {"code": "no_parallax", "message": "m", "hint": "h", "details": {}}
        error["details"] = {"check": UNUSABLE} if stage == "poses" else {}
        fail_stage(session, claim, error, retryable=False, report=FailureReport("failed/", entries))


def test_a_capture_that_cannot_be_used_has_its_verdict_and_its_report(service: Service) -> None:
    job = check(service)
    run_stage(service.services, job["id"], "ingest", {})
    fail_in(service, job["id"], "poses", ["report.json", *REPORTS, "secret.txt"])
    done = job_of(service, job["id"])
    assert (done["state"], done["check"]) == ("failed", UNUSABLE)
    assert [one["name"] for one in done["artifacts"]] == ["report.json", *REPORTS]


def test_a_job_that_fails_later_keeps_the_report_of_its_check(service: Service) -> None:
    job = service.job(preset="preview")
    for stage in ("ingest", "poses", "check"):
        run_stage(service.services, job["id"], stage, dict.fromkeys(REPORTS, b"first"))
    fail_in(service, job["id"], "depth", ["report.json", *REPORTS])
    done = job_of(service, job["id"])
    assert done["check"]["verdict"] == "usable"
    shown = {one["name"]: one["bytes"] for one in done["artifacts"]}
    assert shown == {**dict.fromkeys(REPORTS, 5), "report.json": 1}
