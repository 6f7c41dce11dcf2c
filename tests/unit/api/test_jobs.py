"""Jobs over HTTP: creation, choice of preset, refusals, lists, cancel, delete, logs."""

from __future__ import annotations

from typing import Any

import pytest

from pipelines.options import ON_REQUEST, resolve_options
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, STAGES
from storage.claims import Claim, claim_stage
from storage.jobs import stage_id
from storage.leases import fail_stage, heartbeat
from storage.records import append_logs, register_worker
from tests.unit.api.conftest import LEASE_S, NUM_ARTIFACTS, Service, finish_job, problem, run_stage


def claimed(service: Service, job_id: str, name: str) -> Claim:
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, name), "test", LEASE_S)
    assert claim is not None
    return claim


def states(job: dict[str, Any]) -> dict[str, str]:
    return {stage["name"]: stage["state"] for stage in job["stages"]}


def test_new_job_is_queued_with_all_its_stages(service: Service) -> None:
    capture = service.upload()
    body = {"capture_id": capture["id"], "preset": "preview", "labels": {"who": "me"}}
    answer = service.http.post("/v1/jobs", json=body)
    assert answer.status_code == 202
    job = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{job['id']}"
    assert float(answer.headers["retry-after"]) > 0
    assert set(job) == {
        *(
            "id",
            "state",
            "generation",
            "preset",
            "preset_reason",
            "options",
            "labels",
            "capture_id",
            "export",
            "check",
            "stages",
        ),
        *("queue_position", "metrics", "assets", "error", "artifacts"),
        *("created_at", "started_at", "finished_at", "cancel_requested_at"),
    }
    assert (job["state"], job["queue_position"], job["labels"]) == ("queued", 1, {"who": "me"})
    assert (job["metrics"], job["assets"], job["error"]) == (None, None, None)
    assert job["artifacts"] == []
    assert job["options"] == resolve_options("preview", {})
    assert [stage["name"] for stage in job["stages"]] == list(STAGE_NAMES)
    assert set(job["stages"][0]) == {
        *("name", "state", "progress", "eta_s", "attempt", "message", "progress_at"),
        *("started_at", "finished_at"),
    }
    found = states(job)
    assert found["ingest"] == "ready"
    assert found["frames"] == "skipped"  # the capture is photos
    assert found["poses"] == found["train"] == "blocked"
    assert service.http.get(f"/v1/jobs/{job['id']}").json() == job


def test_second_job_stands_behind_the_first(service: Service) -> None:
    capture = service.upload()
    service.job(capture["id"])
    assert service.job(capture["id"])["queue_position"] == 2


def test_preset_is_preview_without_a_gpu_worker_and_standard_with_one(service: Service) -> None:
    capture = service.upload()
    job = service.job(capture["id"])
    assert job["preset"] == "preview"
    assert "no GPU worker" in job["preset_reason"]
    with service.services.database.session_scope() as session:
        register_worker(
            session, "w", hostname="h", pid=1, boot="b", queues=["gpu"], slots=1, has_gpu=True
        )
    job = service.job(capture["id"])
    assert job["preset"] == "standard"
    assert "GPU worker" in job["preset_reason"]
    assert service.http.get("/v1/presets").json()["default"] == "standard"
    assert service.job(capture["id"], preset="preview")["preset_reason"] == "asked for"


@pytest.mark.parametrize("preset", PRESETS)
def test_a_job_skips_what_its_preset_leaves_out_and_comes_to_its_end(
    service: Service, preset: str
) -> None:
    job = service.job(preset=preset)
    skipped = PRESETS[preset].without | ON_REQUEST | {"frames"}  # the capture is photos
    assert {name for name, state in states(job).items() if state == "skipped"} == skipped
    finish_job(service.services, job["id"], lambda name: b"x")
    job = service.http.get(f"/v1/jobs/{job['id']}").json()
    assert job["state"] == "succeeded"
    assert (job["metrics"] is None) == ("evaluate" in skipped)
    made = [art.name for one in STAGES if one.name not in skipped for art in one.artifacts]
    assert [item["name"] for item in job["artifacts"]] == made


def test_a_job_makes_what_is_on_request_where_it_has_options_for_it(service: Service) -> None:
    assert states(service.job())["views"] == "skipped"
    assert states(service.job(options={"views": {}}))["views"] != "skipped"
    answer = service.http.post(
        "/v1/jobs",
        json={
            "capture_id": service.upload()["id"],
            "preset": "draft",
            "options": {"views": {"num_views": 3}},
        },
    )
    assert "has no such stage" in answer.text, "a draft has nothing to render"


def test_a_draft_has_its_mesh_and_says_why_there_is_no_other(service: Service) -> None:
    job = service.job(preset="draft")
    finish_job(service.services, job["id"], lambda name: b"x")
    names = [
        artifact["name"]
        for artifact in service.http.get(f"/v1/jobs/{job['id']}").json()["artifacts"]
    ]
    assert names[:2] == ["capture-report.json", "capture-report.html"]
    assert names[2:] == ["depth.jpg", "draft.glb", "draft.jpg", "report.json"]
    answer = service.http.get(f"/v1/jobs/{job['id']}/artifacts/mesh.glb")
    assert "skips mesh" in problem(answer, 404, "artifact_not_found")["hint"]


def test_options_are_laid_over_the_preset(service: Service) -> None:
    job = service.job(preset="preview", options={"train": {"max_steps": 77}})
    assert job["options"] == resolve_options("preview", {"train": {"max_steps": 77}})


@pytest.mark.parametrize(
    ("wanted", "status", "code", "paths"),
    [
        ({"capture_id": "nope"}, 404, "capture_not_found", []),
        ({"preset": "ultra"}, 422, "preset_unknown", ["preset"]),
        ({"options": {"train": {"max_stepz": 1}}}, 422, "options_invalid", ["train.max_stepz"]),
        (
            {"options": {"train": {"max_steps": -1}, "mesh": {"resolution": 1}}},
            422,
            "options_invalid",
            ["train.max_steps", "mesh.resolution"],
        ),
        ({"options": {"paint": {}}}, 422, "options_invalid", ["paint"]),
        (
            {"preset": "draft", "options": {"train": {"max_steps": 9}}},
            422,
            "options_invalid",
            ["train"],
        ),
        ({"options": {"train": 3}}, 422, "options_invalid", ["train"]),
        ({"options": []}, 422, "request_invalid", ["body.options"]),
        ({"colour": "red"}, 422, "request_invalid", ["body.colour"]),
        ({"labels": {"bad key!": "x"}}, 422, "request_invalid", ["body.labels.bad key!.[key]"]),
        ({"labels": {"key": "x" * 300}}, 422, "request_invalid", ["body.labels.key"]),
        ({"capture_id": None}, 422, "request_invalid", ["body.capture_id"]),
    ],
)
def test_wrong_job_is_refused_before_anything_is_stored(
    service: Service, wanted: dict[str, Any], status: int, code: str, paths: list[str]
) -> None:
    body = {"capture_id": service.upload()["id"], **wanted}
    found = problem(service.http.post("/v1/jobs", json=body), status, code)
    assert [error["path"] for error in found["errors"]] == paths
    assert service.http.get("/v1/jobs").json()["items"] == []


def test_job_on_a_deleted_capture_is_refused(service: Service) -> None:
    capture = service.upload()
    service.http.delete(f"/v1/captures/{capture['id']}")
    answer = service.http.post("/v1/jobs", json={"capture_id": capture["id"]})
    problem(answer, 404, "capture_not_found")


def test_progress_of_a_running_stage_is_shown(service: Service) -> None:
    job = service.job()
    claim = claimed(service, job["id"], "ingest")
    with service.services.database.session_scope() as session:
        heartbeat(session, claim, LEASE_S, progress=0.25, message="photo 1/4", eta_s=9.0)
    found = service.http.get(f"/v1/jobs/{job['id']}").json()
    assert (found["state"], found["queue_position"]) == ("running", None)
    stage = found["stages"][0]
    assert (stage["state"], stage["progress"], stage["eta_s"]) == ("running", 0.25, 9.0)
    assert (stage["attempt"], stage["message"]) == (1, "photo 1/4")


def test_finished_job_has_metrics_and_no_retry_hint(service: Service) -> None:
    job = service.job()
    finish_job(service.services, job["id"], lambda name: name.encode())
    answer = service.http.get(f"/v1/jobs/{job['id']}")
    assert "retry-after" not in answer.headers
    found = answer.json()
    assert found["state"] == "succeeded"
    assert found["metrics"] == {
        "psnr": 25.5,
        "ssim": 0.9,
        "num_images": 7,
        "width": 480,
        "height": 270,
    }
    assert found["assets"]["mesh"]["coverage"] == 0.72
    assert found["assets"]["warnings"][0]["code"] == "geometry_poor"
    assert "per_view" not in found["assets"]
    assert len(found["artifacts"]) == NUM_ARTIFACTS


def test_failed_job_says_what_to_do(service: Service) -> None:
    job = service.job()
    error = {"code": "no_parallax", "message": "14 of 210 registered.", "hint": "Film slower."}
    claim = claimed(service, job["id"], "ingest")
    with service.services.database.session_scope() as session:
        fail_stage(session, claim, {**error, "details": {}}, retryable=False)
    found = service.http.get(f"/v1/jobs/{job['id']}").json()
    assert found["state"] == "failed"
    assert found["error"] == {**error, "stage": "ingest", "details": {}}


def test_jobs_are_listed_newest_first_and_stable_under_inserts(service: Service) -> None:
    capture = service.upload()["id"]
    ids = [service.job(capture)["id"] for _ in range(4)]
    first = service.http.get("/v1/jobs", params={"limit": 2}).json()
    service.job(capture)
    second = service.http.get(
        "/v1/jobs", params={"limit": 2, "cursor": first["next_cursor"]}
    ).json()
    assert [job["id"] for job in first["items"] + second["items"]] == ids[::-1]
    assert second["next_cursor"] is None


def test_jobs_are_filtered_by_state_and_label(service: Service) -> None:
    capture = service.upload()["id"]
    one = service.job(capture, labels={"place": "garden"})["id"]
    two = service.job(capture, labels={"place": "attic"})["id"]
    three = service.job(capture)["id"]
    service.http.post(f"/v1/jobs/{three}/cancel")

    def ids(**params: str) -> list[str]:
        found = service.http.get("/v1/jobs", params=params).json()["items"]
        return [job["id"] for job in found]

    assert ids(state="cancelled") == [three]
    assert ids(state="queued") == [two, one]
    assert ids(label="place") == [two, one]
    assert ids(label="place=garden") == [one]
    assert ids(label="place=cellar") == []


@pytest.mark.parametrize(
    ("params", "code"),
    [
        ({"limit": 0}, "request_invalid"),
        ({"limit": 101}, "request_invalid"),
        ({"state": "sleeping"}, "request_invalid"),
        ({"cursor": "garbage"}, "cursor_invalid"),
        ({"cursor": "W10"}, "cursor_invalid"),
    ],
)
def test_wrong_list_parameters_are_refused(
    service: Service, params: dict[str, Any], code: str
) -> None:
    problem(service.http.get("/v1/jobs", params=params), 422, code)


def test_cancel_is_idempotent(service: Service) -> None:
    job = service.job()
    for _ in range(2):
        answer = service.http.post(f"/v1/jobs/{job['id']}/cancel")
        assert answer.status_code == 202
        assert answer.json()["state"] == "cancelled"


def test_cancel_of_a_running_job_waits_for_its_stage(service: Service) -> None:
    job = service.job()
    claimed(service, job["id"], "ingest")
    answer = service.http.post(f"/v1/jobs/{job['id']}/cancel")
    assert (answer.status_code, answer.json()["state"]) == (202, "cancelling")
    problem(service.http.delete(f"/v1/jobs/{job['id']}"), 409, "conflict")


def test_cancel_of_a_finished_job_is_a_conflict(service: Service) -> None:
    job = service.job()
    finish_job(service.services, job["id"], lambda name: b"x")
    problem(service.http.post(f"/v1/jobs/{job['id']}/cancel"), 409, "job_finished")


def test_deleted_job_is_gone_with_its_bytes_but_not_its_capture(service: Service) -> None:
    job = service.job()
    finish_job(service.services, job["id"], lambda name: b"x")
    assert len(service.objects()) == 1 + NUM_ARTIFACTS
    path = f"/v1/jobs/{job['id']}"
    assert service.http.delete(path).status_code == 204
    assert len(service.objects()) == 1
    for call in (service.http.get, service.http.delete):
        problem(call(path), 404, "job_not_found")
    problem(service.http.get(f"{path}/artifacts"), 404, "job_not_found")
    problem(service.http.get(f"{path}/logs"), 404, "job_not_found")
    problem(service.http.post(f"{path}/cancel"), 404, "job_not_found")


def test_running_job_is_not_deleted(service: Service) -> None:
    job = service.job()
    run_stage(service.services, job["id"], "ingest", {})
    problem(service.http.delete(f"/v1/jobs/{job['id']}"), 409, "conflict")


def test_logs_are_read_from_a_line_on_or_from_the_tail(service: Service) -> None:
    job = service.job()
    claim = claimed(service, job["id"], "ingest")
    with service.services.database.session_scope() as session:
        append_logs(session, claim, [f"line {number}" for number in range(10)])
    path = f"/v1/jobs/{job['id']}/logs"

    def read(**params: Any) -> dict[str, Any]:
        found: dict[str, Any] = service.http.get(path, params=params).json()
        return found

    assert read(line=8) == {"lines": ["line 8", "line 9"], "first": 8, "next": 10, "total": 10}
    assert read(line=-1)["lines"] == ["line 9"]
    assert read(line=-99)["first"] == 0
    assert read(line=10)["lines"] == []
    assert read(limit=3) == {
        "lines": ["line 0", "line 1", "line 2"],
        "first": 0,
        "next": 3,
        "total": 10,
    }
    assert read(stage="ingest", line=9)["lines"] == ["line 9"]
    assert read(stage="train")["total"] == 0
    problem(service.http.get(path, params={"stage": "paint"}), 422, "request_invalid")


def test_a_wish_is_checked_without_a_capture_and_creates_nothing(service: Service) -> None:
    wish: dict[str, Any] = {
        "preset": "preview",
        "options": {"train": {"max_steps": 7}},
        "labels": {"a": "b"},
    }
    answer = service.http.post("/v1/jobs:validate", json=wish)
    assert answer.status_code == 200
    plan = answer.json()
    made = service.job(**wish)
    assert {name: made[name] for name in ("preset", "preset_reason", "options", "labels")} == {
        name: plan[name] for name in ("preset", "preset_reason", "options", "labels")
    }
    for wrong, code in (
        ({"preset": "nope"}, "preset_unknown"),
        ({"options": {"train": {"max_steps": -1}}}, "options_invalid"),
        ({"labels": {"": "x"}}, "request_invalid"),
        ({"capture_id": made["capture_id"]}, "request_invalid"),
    ):
        problem(service.http.post("/v1/jobs:validate", json=wrong), 422, code)
    assert len(service.http.get("/v1/jobs").json()["items"]) == 1
