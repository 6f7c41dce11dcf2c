"""A finished job whose retry is cancelled, or fails: it offers what it had."""

from __future__ import annotations

from datetime import timedelta
from typing import Any

import pytest

from storage.claims import claim_stage
from storage.deletions import drain_deletions
from storage.jobs import stage_id
from storage.keys import attempt_prefix
from storage.leases import FailureReport, fail_stage
from storage.queries import get_job, stage_work
from storage.reconciling import sweep_orphans
from tests.unit.api.conftest import LEASE_S, Service, finish_job, problem, run_stage
from tests.unit.api.test_retry import BEHIND_MESH, again, retry, states

ERROR = {"code": "tool_failed", "message": "It broke.", "hint": "Mend it."}
FEWER = {"train": {"max_steps": 77}}


@pytest.fixture
def job(service: Service) -> str:
    """A job that succeeded; each artifact holds its name."""
    made: str = service.job(preset="preview")["id"]
    finish_job(service.services, made, lambda name: name.encode())
    return made


def look(service: Service, job_id: str) -> dict[str, Any]:
    found: dict[str, Any] = service.http.get(f"/v1/jobs/{job_id}").json()
    return found


def cancel(service: Service, job_id: str) -> dict[str, Any]:
    answer = service.http.post(f"/v1/jobs/{job_id}/cancel")
    assert answer.status_code == 202, answer.text
    return look(service, job_id)


def artifacts(service: Service, job_id: str) -> dict[str, bytes]:
    """What can be downloaded, and its bytes."""
    path = f"/v1/jobs/{job_id}/artifacts"
    names = [item["name"] for item in service.http.get(path).json()["items"]]
    return {
        name: service.http.get(f"{path}/{name}", follow_redirects=True).raise_for_status().content
        for name in names
    }


def sweep(service: Service) -> None:
    """As a day later."""
    database, store = service.services.database, service.services.store
    sweep_orphans(database, store, older_than=timedelta(seconds=-1))
    drain_deletions(database, store)


def fail(service: Service, job_id: str, name: str) -> None:
    """The stage that is ready fails, and its worker publishes a report of that."""
    services = service.services
    with services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, name), "test", LEASE_S)
    assert claim is not None
    prefix = attempt_prefix(claim.root, name, claim.attempt, claim.token)
    source = services.settings.home / "failed"
    source.write_bytes(b"it failed")
    services.store.put_file(f"{prefix}report.json", source)
    report = FailureReport(prefix, [{"path": "report.json", "bytes": 9, "sha256": "0" * 64}])
    with services.database.session_scope() as session:
        assert fail_stage(session, claim, ERROR, retryable=False, report=report) == "failed"


def export(service: Service, job_id: str, status: int) -> dict[str, Any]:
    answer = service.http.post(f"/v1/jobs/{job_id}/exports", json={"kind": "mesh"})
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


@pytest.mark.parametrize("wanted", [{"from_stage": "train"}, {"options": FEWER}])
def test_a_cancelled_retry_costs_nothing(
    service: Service, job: str, wanted: dict[str, Any]
) -> None:
    before, had = look(service, job), artifacts(service, job)
    assert "train" in again(retry(service, job, **wanted))
    for _ in range(2):
        over = cancel(service, job)
        assert over["state"] == "cancelled"
        for same in ("options", "stages", "metrics", "assets", "check"):
            assert over[same] == before[same], same
        sweep(service)
        assert artifacts(service, job) == had
        retry(service, job, **wanted)
    cancel(service, job)
    made = export(service, job, 202)
    run_stage(service.services, made["id"], "mesh", {"mesh.glb": b"another"})
    found = retry(service, job)
    assert (found["state"], again(found)) == ("succeeded", set()), "every result holds"
    assert retry(service, job, 409)["code"] == "nothing_to_retry"
    assert artifacts(service, job) == had


def test_a_retry_whose_training_fails_leaves_the_training_before(
    service: Service, job: str
) -> None:
    had = artifacts(service, job)
    retry(service, job, options=FEWER)
    fail(service, job, "train")
    sweep(service)
    over = look(service, job)
    assert (over["state"], over["error"]["stage"]) == ("failed", "train")
    assert {name for name, state in states(over).items() if state != "skipped"} - {"train"} == {
        name for name, state in states(over).items() if state == "succeeded"
    }
    assert states(over)["train"] == "failed"
    assert artifacts(service, job) == had | {"report.json": b"it failed"}
    made = export(service, job, 202)
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(made["id"], "mesh"), "test", LEASE_S)
        assert claim is not None
        assert stage_work(session, claim).inputs["train"].prefix.endswith("/1-1/")
    with service.services.database.session_scope() as session:
        assert fail_stage(session, claim, ERROR, retryable=False) == "failed"

    found = retry(service, job)
    assert found["options"]["train"]["max_steps"] == 77, "it goes on with what was asked for"
    assert states(found)["train"] == "ready"
    fail(service, job, "train")
    with service.services.database.read_scope() as session:
        row = next(row for row in get_job(session, job).stages if row.name == "train")
        assert row.manifest is not None
    steps = service.job(preset="preview")["options"]["train"]["max_steps"]
    found = retry(service, job, options={"train": {"max_steps": steps}})
    assert (found["state"], again(found)) == ("succeeded", set()), "what it had holds"
    sweep(service)
    assert artifacts(service, job) == had


def test_what_is_made_anew_takes_the_place_of_what_was(service: Service, job: str) -> None:
    """Cancelled between: what hangs on it can be had, is no success, and is made anew."""
    had = artifacts(service, job)
    retry(service, job, options=FEWER)
    anew = {"model.zip": b"anew", "cameras.json": b"anew"}
    run_stage(service.services, job, "train", anew)
    over = cancel(service, job)
    assert states(over)["train"] == "succeeded"
    assert states(over)["mesh"] == states(over)["report"] == "cancelled"
    assert over["metrics"] is None, "they are those of another training"
    assert artifacts(service, job) == had | anew
    export(service, job, 202)
    problem(
        service.http.post(f"/v1/jobs/{job}/retry", json={"from_stage": "train"}), 409, "conflict"
    )
    found = retry(service, job)
    assert again(found) == {name for name, state in states(over).items() if state == "cancelled"}
    assert again(found) >= BEHIND_MESH
    cancel(service, job)
    retry(service, job, from_stage="mesh")
    run_stage(service.services, job, "mesh", {"mesh.glb": b"anew, too"})
    cancel(service, job)
    sweep(service)
    assert artifacts(service, job)["mesh.glb"] == b"anew, too"


def test_a_training_on_poses_that_are_no_more_is_not_exported(service: Service, job: str) -> None:
    retry(service, job, from_stage="poses")
    run_stage(service.services, job, "poses", {"cameras.json": b"anew"})
    over = cancel(service, job)
    assert states(over)["train"] == "cancelled"
    assert artifacts(service, job)["model.zip"] == b"model.zip"
    assert export(service, job, 409)["code"] == "not_trained"
    assert "train" in again(retry(service, job))


def test_a_cancelled_retry_of_an_export_leaves_the_export(service: Service, job: str) -> None:
    made = export(service, job, 202)["id"]
    run_stage(service.services, made, "mesh", {"mesh.glb": b"mine"})
    retry(service, made, options={"mesh": {"max_faces": 4321}})
    over = cancel(service, made)
    assert (over["state"], over["export"]["result"]) == ("cancelled", {})
    assert over["options"]["mesh"]["max_faces"] != 4321
    sweep(service)
    assert artifacts(service, made) == {"mesh.glb": b"mine"}
    assert service.http.delete(f"/v1/jobs/{job}").status_code == 204
    sweep(service)
    left = [path for path in service.objects() if "/jobs/" in path.as_posix()]
    assert left == []
