"""Jobs run again, and the history of what happened to them."""

from __future__ import annotations

import dataclasses
from typing import Any

import pytest

from pipelines.options import OptionsError, resolve_options, revise_options
from pipelines.presets import PRESETS
from pipelines.registry import STAGES
from storage.claims import claim_stage
from storage.damage import CAPTURE
from storage.jobs import stage_id
from storage.keys import stage_prefix
from storage.leases import fail_stage
from tests.factories import root_of
from tests.unit.api.conftest import LEASE_S, Service, finish_job, run_stage
from worker.outcomes import InputDamagedError, failure_of

ERROR = {"code": "tool_failed", "message": "It broke.", "hint": "Mend it."}
RETRIED = ("job.queued", "retry")
BEHIND_MESH = {"mesh", "pointcloud", "video", "assess", "report"}


def states(job: dict[str, Any]) -> dict[str, str]:
    return {stage["name"]: stage["state"] for stage in job["stages"]}


def again(job: dict[str, Any]) -> set[str]:
    """The stages that are to be run once more."""
    return {name for name, state in states(job).items() if state in ("ready", "blocked")}


@pytest.fixture
def job(service: Service) -> str:
    """A job that succeeded."""
    made: str = service.job(preset="preview")["id"]
    finish_job(service.services, made, lambda name: name.encode())
    return made


def retry(service: Service, job_id: str, status: int = 202, **wanted: Any) -> dict[str, Any]:
    answer = service.http.post(f"/v1/jobs/{job_id}/retry", json=wanted)
    assert answer.status_code == status, answer.text
    found: dict[str, Any] = answer.json()
    return found


def test_a_failed_job_goes_on_from_what_failed(service: Service) -> None:
    job = service.job(preset="preview")["id"]
    run_stage(service.services, job, "ingest", {"a": b"a"})
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job, "poses"), "test", LEASE_S)
        assert claim is not None
        assert fail_stage(session, claim, ERROR, retryable=False) == "failed"
    found = service.http.post(f"/v1/jobs/{job}/retry").json()
    assert (found["state"], found["generation"], found["error"]) == ("queued", 2, None)
    assert (found["started_at"], found["finished_at"]) == (None, None)
    assert states(found)["ingest"] == "succeeded"
    assert states(found)["poses"] == "ready"
    assert states(found)["frames"] == "skipped"
    assert [stage["attempt"] for stage in found["stages"] if stage["name"] == "poses"] == [0]
    run_stage(service.services, job, "poses", {"b": b"b"})
    assert states(service.http.get(f"/v1/jobs/{job}").json())["depth"] == "ready"


@pytest.mark.parametrize(
    ("name", "redone"), [("ingest", {"ingest", "poses"}), (CAPTURE, {"poses"})]
)
def test_what_a_stage_found_damaged_is_made_again(
    service: Service, name: str, redone: set[str]
) -> None:
    job = service.job(preset="preview")["id"]
    run_stage(service.services, job, "ingest", {"a": b"a"})
    error = failure_of("poses", InputDamagedError(name, "a is missing"))
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job, "poses"), "test", LEASE_S)
        assert claim is not None
        fail_stage(session, claim, error, retryable=False)
    told = service.http.get(f"/v1/jobs/{job}").json()["error"]
    assert (told["code"], told["details"]) == ("input_damaged", {"input": name})
    found = retry(service, job)
    assert again(found) >= redone
    assert ("ingest" in again(found)) == ("ingest" in redone)
    service.http.post(f"/v1/jobs/{job}/cancel")
    assert again(retry(service, job)) >= redone, "it was not made yet"
    if name == "ingest":
        run_stage(service.services, job, "ingest", {"a": b"a"})
        service.http.post(f"/v1/jobs/{job}/cancel")
        assert "ingest" not in again(retry(service, job)), "it was made anew"


def test_a_cancelled_job_can_be_taken_up_again(service: Service) -> None:
    job = service.job(preset="preview")["id"]
    service.http.post(f"/v1/jobs/{job}/cancel")
    found = retry(service, job)
    assert (found["state"], found["cancel_requested_at"]) == ("queued", None)
    assert states(found)["ingest"] == "ready"


def test_other_options_run_what_they_change_and_all_behind_it(service: Service, job: str) -> None:
    found = retry(service, job, options={"mesh": {"crop": {"min": [-1, -1, -1]}}}, status=422)
    assert found["code"] == "options_invalid"  # and nothing was lost by asking
    found = retry(service, job, options={"mesh": {"max_faces": 4321}})
    assert again(found) == BEHIND_MESH
    assert found["options"]["mesh"]["max_faces"] == 4321
    assert states(found)["mesh"] == "ready"
    assert found["options"]["train"] == resolve_options("preview", {})["train"]
    names = {artifact["name"] for artifact in found["artifacts"]}
    assert "model.zip" in names
    assert "mesh.glb" not in names
    kept = list(service.services.store.list(stage_prefix(root_of(job), "mesh")))
    assert kept, "what it had made stays in the store until it has made it anew"


def test_more_steps_train_again_and_leave_the_poses(service: Service, job: str) -> None:
    found = retry(service, job, options={"train": {"max_steps": 77}})
    assert again(found) == {
        name
        for name, state in states(found).items()
        if state != "skipped" and name not in ("ingest", "poses", "check", "depth", "draft")
    }


def test_a_stage_that_is_named_is_run_again_though_it_holds(service: Service, job: str) -> None:
    assert again(retry(service, job, from_stage="mesh")) == BEHIND_MESH


def test_a_newer_version_of_a_stage_no_longer_holds(
    service: Service, job: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    newer = {
        stage.name: dataclasses.replace(stage, version=stage.version + (stage.name == "mesh"))
        for stage in STAGES
    }
    monkeypatch.setattr("api.jobs.retrying.get_stage", newer.__getitem__)
    assert again(retry(service, job)) == BEHIND_MESH


def test_what_cannot_be_retried_says_why(service: Service, job: str) -> None:
    assert retry(service, job, 409)["code"] == "nothing_to_retry"
    assert retry(service, job, 422, from_stage="frames")["code"] == "stage_skipped"
    assert retry(service, job, 422, from_stage="nonsense")["code"] == "request_invalid"
    assert retry(service, job, 422, options={"nonsense": {}})["code"] == "options_invalid"
    running = service.job(preset="preview")["id"]
    assert retry(service, running, 409)["code"] == "conflict"
    assert retry(service, "0" * 28, 404)["code"] == "job_not_found"
    assert service.http.get(f"/v1/jobs/{job}").json()["state"] == "succeeded"


def test_a_job_whose_capture_is_gone_runs_again_only_what_does_not_read_it(
    service: Service, job: str
) -> None:
    capture = service.http.get(f"/v1/jobs/{job}").json()["capture_id"]
    assert service.http.delete(f"/v1/captures/{capture}").status_code == 204
    assert retry(service, job, 404, from_stage="ingest")["code"] == "capture_deleted"
    assert again(retry(service, job, from_stage="mesh")) == BEHIND_MESH


@pytest.mark.parametrize("preset", PRESETS)
def test_options_that_are_revised_by_nothing_stay_as_they_are(preset: str) -> None:
    whole = resolve_options(preset, {})
    assert revise_options(preset, whole, {}) == whole


def test_revised_options_follow_what_they_depend_on() -> None:
    whole = resolve_options("preview", {"train": {"max_steps": 9}})
    other = revise_options("preview", whole, {"train": {"method": "instant-ngp"}})
    assert other["train"]["method"] == "instant-ngp"
    assert other["frames"] == whole["frames"]
    fewer = revise_options("preview", whole, {"train": {"data": {"eval_fraction": 0.2}}})
    assert fewer["depth"]["held_out"]["eval_fraction"] == 0.2
    assert fewer["train"]["max_steps"] == 9
    with pytest.raises(OptionsError):
        revise_options("preview", whole, {"train": "fast"})


def test_history_says_when_who_and_why(service: Service) -> None:
    job = service.job(preset="preview")["id"]
    run_stage(service.services, job, "ingest", {"a": b"a"})
    service.http.post(f"/v1/jobs/{job}/cancel")
    retry(service, job, options={"train": {"max_steps": 5}})
    page = service.http.get(f"/v1/jobs/{job}/events").json()
    assert page["next"] is None
    told = [(event["kind"], event["stage"], event["reason"]) for event in page["items"]]
    assert told[:4] == [
        ("job.queued", None, ""),
        ("stage.ready", "ingest", ""),
        ("stage.running", "ingest", ""),
        ("job.running", None, ""),
    ]
    assert ("stage.cancelled", "poses", "job_cancelled") in told
    assert ("stage.blocked", "poses", "retry") in told
    retried = next(
        item for item in page["items"] if item["reason"] == "retry" and not item["stage"]
    )
    assert retried["data"]["generation"] == 2
    assert retried["data"]["options"] == {"train": {"max_steps": 5}}
    assert "poses" in retried["data"]["stages"]
    assert "ingest" not in retried["data"]["stages"]
    actors = {item["kind"]: item["actor"].split(":")[0] for item in page["items"]}
    assert actors["job.queued"] == actors["job.cancelled"] == "api-key"
    assert actors["stage.running"] == "worker"

    seen: list[dict[str, Any]] = []
    after: int | None = 0
    while after is not None:
        part = service.http.get(f"/v1/jobs/{job}/events?limit=3&after={after}").json()
        assert 0 < len(part["items"]) <= 3
        seen += part["items"]
        after = part["next"]
    assert seen == page["items"]
    assert service.http.get(f"/v1/jobs/{'0' * 28}/events").status_code == 404


def test_a_retry_that_is_sent_twice_is_done_once(service: Service, job: str) -> None:
    path, once = f"/v1/jobs/{job}/retry", {"Idempotency-Key": "a-retry"}
    body = {"from_stage": "mesh"}
    answers = [service.http.post(path, json=body, headers=once) for _ in range(2)]
    assert [answer.status_code for answer in answers] == [202, 202]
    assert answers[0].json() == answers[1].json()
    assert answers[1].headers["idempotent-replayed"] == "true"
    assert service.http.get(f"/v1/jobs/{job}").json()["generation"] == 2
