"""Exports as jobs of their own: on any trained job, whenever, without its capture."""

from __future__ import annotations

from typing import Any

import httpx
import pytest

from pipelines.exports.catalogue import KINDS, get_export
from storage.claims import Claim, claim_stage
from storage.jobs import stage_id
from storage.leases import cancel_stage, fail_stage
from storage.queries import stage_work
from storage.records import append_logs
from tests.factories import root_of
from tests.unit.api.conftest import (
    LEASE_S,
    Service,
    check_documented,
    finish_job,
    problem,
    run_stage,
)

ERROR = {"code": "tool_failed", "message": "It broke.", "hint": "Mend it."}
TRAINED = ("ingest", "poses", "depth", "train")


@pytest.fixture
def job(service: Service) -> str:
    """A job that succeeded."""
    made: str = service.job(preset="preview", options={"mesh": {"max_faces": 4321}})["id"]
    finish_job(service.services, made, lambda name: name.encode())
    return made


def ask(service: Service, job_id: str, kind: str, **wanted: Any) -> httpx.Response:
    return service.http.post(f"/v1/jobs/{job_id}/exports", json={"kind": kind, **wanted})


def export(service: Service, job_id: str, kind: str = "mesh", **wanted: Any) -> dict[str, Any]:
    answer = ask(service, job_id, kind, **wanted)
    assert answer.status_code == 202, answer.text
    made: dict[str, Any] = answer.json()
    assert answer.headers["location"] == f"/v1/jobs/{made['id']}"
    return made


def make(service: Service, made: dict[str, Any], content: bytes = b"new") -> dict[str, Any]:
    """Do what a worker does for an export, and look at it."""
    kind = made["export"]["kind"]
    files = {found.path: content for found in get_export(kind).artifacts}
    run_stage(service.services, made["id"], kind, files)
    found: dict[str, Any] = service.http.get(f"/v1/jobs/{made['id']}").json()
    return found


def test_an_export_is_a_job_of_its_own_with_its_own_files(service: Service, job: str) -> None:
    made = export(service, job, options={"formats": ["glb", "usdz"]}, labels={"for": "a phone"})
    assert made["state"] == "queued"
    assert made["queue_position"] == 1
    assert made["export"] == {"kind": "mesh", "job_id": job, "result": None}
    assert made["labels"] == {"for": "a phone"}
    assert [stage["name"] for stage in made["stages"]] == ["mesh"]
    assert [*made["options"]] == ["mesh"]
    assert made["options"]["mesh"]["formats"] == ["glb", "usdz"]
    assert made["options"]["mesh"]["max_faces"] == 4321, "laid over what the job has"
    before = service.http.get(f"/v1/jobs/{job}").json()

    over = make(service, made)
    assert over["state"] == "succeeded"
    assert over["export"]["result"] == {}
    names = {artifact["name"] for artifact in over["artifacts"]}
    assert names == {artifact.name for artifact in get_export("mesh").artifacts}
    path = f"/v1/jobs/{made['id']}/artifacts/mesh.glb"
    assert service.http.get(path).content == b"new"
    assert service.http.get(f"/v1/jobs/{job}/artifacts/mesh.glb").content == b"mesh.glb"
    after = service.http.get(f"/v1/jobs/{job}").json()
    assert {key: after[key] for key in ("state", "stages", "export")} == {
        key: before[key] for key in ("state", "stages", "export")
    }
    missing = problem(service.http.get(f"{path[:-8]}report.json"), 404, "artifact_not_found")
    assert "mesh.usdz" in missing["hint"]
    assert "report.json" not in missing["hint"]
    kinds = [event["kind"] for event in _events(service, made["id"])]
    assert kinds == [
        *("job.queued", "stage.ready", "stage.running", "job.running"),
        *("stage.succeeded", "job.succeeded"),
    ]


def _events(service: Service, job_id: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = service.http.get(f"/v1/jobs/{job_id}/events").json()["items"]
    return found


def test_the_capture_may_be_gone_and_the_inputs_are_what_the_job_made(
    service: Service, job: str
) -> None:
    capture = service.http.get(f"/v1/jobs/{job}").json()["capture_id"]
    assert service.http.delete(f"/v1/captures/{capture}").status_code == 204
    made = export(service, job, "mesh")
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(made["id"], "mesh"), "test", LEASE_S)
        assert claim is not None
        work = stage_work(session, claim)
    assert work.is_export
    for name in ("train", *get_export("mesh").reads):
        if name != "frames":
            assert work.inputs[name].prefix.startswith(f"{root_of(job)}{name}/")


def test_a_capture_goes_while_an_export_runs_that_needs_it_not(service: Service, job: str) -> None:
    made = export(service, job)
    capture = made["capture_id"]
    assert service.http.delete(f"/v1/captures/{capture}").status_code == 204
    assert make(service, made)["state"] == "succeeded"


def test_several_wait_at_once_and_are_listed_with_their_job_alone(
    service: Service, job: str
) -> None:
    made = [export(service, job, kind)["id"] for kind in ("mesh", "mesh", "cameras")]
    page = service.http.get(f"/v1/jobs/{job}/exports", params={"limit": 2}).json()
    assert [item["id"] for item in page["items"]] == [made[2], made[1]]
    rest = {"limit": 2, "cursor": page["next_cursor"]}
    page = service.http.get(f"/v1/jobs/{job}/exports", params=rest).json()
    assert [item["id"] for item in page["items"]] == [made[0]]
    assert page["next_cursor"] is None
    service.http.post(f"/v1/jobs/{made[1]}/cancel")
    queued = service.http.get(f"/v1/jobs/{job}/exports", params={"state": "queued"}).json()
    assert [item["id"] for item in queued["items"]] == [made[2], made[0]]
    path = f"/v1/jobs/{job}/exports"
    labelled = export(service, job, "cameras", labels={"for": "me"})["id"]
    found = service.http.get(path, params={"label": "for=me"}).json()["items"]
    assert [item["id"] for item in found] == [labelled]
    listed = service.http.get("/v1/jobs").json()["items"]
    assert [item["id"] for item in listed] == [job]
    problem(service.http.get(f"/v1/jobs/{'0' * 28}/exports"), 404, "job_not_found")


def test_it_is_made_once_however_often_it_is_asked_for(service: Service, job: str) -> None:
    once = {"Idempotency-Key": "an-export"}
    path, body = f"/v1/jobs/{job}/exports", {"kind": "cameras"}
    answers = [service.http.post(path, json=body, headers=once) for _ in range(2)]
    assert answers[0].content == answers[1].content
    assert answers[1].headers["idempotent-replayed"] == "true"
    assert len(service.http.get(path).json()["items"]) == 1
    problem(
        service.http.post(path, json={"kind": "mesh"}, headers=once), 422, "idempotency_key_reused"
    )


WRONG: tuple[tuple[str, dict[str, Any], str, str], ...] = (
    ("video", {"width_px": 0, "height_px": 64}, "video.width_px", "16"),
    ("video", {"width_px": 100_000, "height_px": 100_000}, "video.width_px", "8192"),
    ("video", {"long_side_px": 0}, "video.long_side_px", "64"),
    (
        "video",
        {
            "path": "keyframes",
            "keyframes": [{"position": [0, 0, 1], "look_at": [0, 0, 0], "fov_deg": 0}] * 2,
        },
        "video.keyframes.0.fov_deg",
        "1",
    ),
    (
        "video",
        {"path": "keyframes", "keyframes": [{"position": [0, 0, 1], "look_at": [0, 0, 0]}]},
        "video",
        "at least 2",
    ),
    ("video", {"outputs": []}, "video.outputs", "1"),
    ("mesh", {"crop": {"shape": "box", "size": [0, 1, 1]}}, "mesh.crop.size.0", "0"),
    ("mesh", {"texture_px": 3}, "mesh.texture_px", "8192"),
    ("pointcloud", {"num_points": 10**12}, "pointcloud.num_points", "50000000"),
    ("views", {"nonsense": 1}, "views.nonsense", "not permitted"),
    ("dataset", {"enabled": False}, "dataset.enabled", "asked for"),
)
"""Kind, options, which of them is wrong, and what is said of the range."""


def test_wrong_wishes_are_refused_at_once_with_the_range(service: Service, job: str) -> None:
    for kind, options, where, what in WRONG:
        found = problem(ask(service, job, kind, options=options), 422, "options_invalid")
        told = {item["path"]: item["detail"] for item in found["errors"]}
        assert what in told[where], told
    assert service.http.get(f"/v1/jobs/{job}/exports").json()["items"] == []


def test_an_unknown_kind_is_refused_with_those_that_there_are(service: Service, job: str) -> None:
    found = problem(ask(service, job, "hologram"), 422, "request_invalid")
    for kind in KINDS:
        assert f"'{kind}'" in found["errors"][0]["detail"]


def test_only_a_trained_job_can_be_exported(service: Service) -> None:
    running = service.job(preset="preview")["id"]
    for name in TRAINED:
        found = problem(ask(service, running, "cameras"), 409, "not_trained")
        assert "not ended" in found["detail"]
        run_stage(service.services, running, name, {"a": b"a"})
    made = export(service, running, "cameras")  # though it is evaluated yet

    found = problem(ask(service, made["id"], "cameras"), 409, "not_trained")
    assert running in found["hint"]
    draft = service.job(preset="draft")["id"]
    assert "draft" in problem(ask(service, draft, "mesh"), 409, "not_trained")["detail"]
    failed = service.job(preset="preview")["id"]
    for name in TRAINED[:-1]:
        run_stage(service.services, failed, name, {"a": b"a"})
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(failed, "train"), "test", LEASE_S)
        assert claim is not None
        fail_stage(session, claim, ERROR, retryable=False)
    assert "failed" in problem(ask(service, failed, "mesh"), 409, "not_trained")["detail"]
    problem(ask(service, "0" * 28, "mesh"), 404, "job_not_found")


def test_one_that_failed_is_retried_with_other_options(service: Service, job: str) -> None:
    made = export(service, job, options={"triangles": 1000})["id"]
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(made, "mesh"), "test", LEASE_S)
        assert claim is not None
        append_logs(session, claim, ["a line"])
        fail_stage(session, claim, ERROR, retryable=False)
    found = service.http.get(f"/v1/jobs/{made}").json()
    assert (found["state"], found["error"]["stage"]) == ("failed", "mesh")
    path = f"/v1/jobs/{made}/retry"
    for wrong in ({"video": {"fps": 24}}, {"mesh": 3}, {"mesh": {"triangles": -1}}):
        problem(service.http.post(path, json={"options": wrong}), 422, "options_invalid")
    problem(service.http.post(path, json={"from_stage": "train"}), 422, "stage_skipped")
    wanted = {"options": {"mesh": {"triangles": 500}}}
    again = service.http.post(path, json=wanted).json()
    assert (again["state"], again["generation"]) == ("queued", 2)
    assert again["options"]["mesh"]["triangles"] == 500
    assert again["options"]["mesh"]["max_faces"] == 4321
    assert make(service, again)["state"] == "succeeded"
    problem(service.http.post(path), 409, "nothing_to_retry")
    assert service.http.post(path, json={"from_stage": "mesh"}).status_code == 202


def test_an_export_holds_until_its_job_is_trained_anew(service: Service, job: str) -> None:
    made = make(service, export(service, job, "cameras"))["id"]
    retry = {"options": {"train": {"max_steps": 77}}}
    assert service.http.post(f"/v1/jobs/{job}/retry", json=retry).status_code == 202
    problem(service.http.post(f"/v1/jobs/{made}/retry"), 409, "not_trained")
    problem(ask(service, job, "cameras"), 409, "not_trained")
    run_stage(service.services, job, "train", {"model.zip": b"another"})
    again = service.http.post(f"/v1/jobs/{made}/retry")
    assert again.status_code == 202, again.text
    assert again.json()["stages"][0]["state"] == "ready"


def test_what_an_export_reads_is_not_made_anew_under_it(service: Service, job: str) -> None:
    made = export(service, job, "cameras")["id"]
    path = f"/v1/jobs/{job}/retry"
    found = problem(
        service.http.post(path, json={"options": {"train": {"max_steps": 77}}}), 409, "conflict"
    )
    assert made in found["detail"]
    assert service.http.post(path, json={"from_stage": "mesh"}).status_code == 202
    service.http.post(f"/v1/jobs/{job}/cancel")
    service.http.post(f"/v1/jobs/{made}/cancel")
    assert service.http.post(path, json={"from_stage": "train"}).status_code == 202


def test_exports_go_with_their_job_once_they_have_stopped(service: Service, job: str) -> None:
    done = make(service, export(service, job))["id"]
    queued = export(service, job, "cameras")["id"]
    running = export(service, job, "video")["id"]
    with service.services.database.session_scope() as session:
        assert claim_stage(session, stage_id(running, "video"), "test", LEASE_S) is not None
    found = problem(service.http.delete(f"/v1/jobs/{job}"), 409, "conflict")
    assert running in found["detail"]
    assert service.http.get(f"/v1/jobs/{queued}").status_code == 200, "and nothing is lost yet"
    assert service.http.delete(f"/v1/jobs/{done}").status_code == 204
    assert service.http.get(f"/v1/jobs/{job}/artifacts/mesh.glb").content == b"mesh.glb"

    other = make(service, export(service, job))["id"]
    service.http.post(f"/v1/jobs/{running}/cancel")
    problem(service.http.delete(f"/v1/jobs/{job}"), 409, "conflict")
    _stop(service, running, "video")
    assert service.http.delete(f"/v1/jobs/{job}").status_code == 204
    for gone in (job, done, queued, running, other):
        problem(service.http.get(f"/v1/jobs/{gone}"), 404, "job_not_found")
    assert [path for path in service.objects() if "/jobs/" in str(path)] == []


def _stop(service: Service, job_id: str, stage: str) -> None:
    """What a worker does with a stage whose job was cancelled."""
    claim = Claim(stage_id(job_id, stage), job_id, stage, "test", token=1, attempt=1)
    with service.services.database.session_scope() as session:
        assert cancel_stage(session, claim) == "cancelled"


def test_kinds_say_what_each_takes_and_writes(service: Service) -> None:
    found = service.http.get("/v1/exports/kinds").json()["items"]
    assert [item["kind"] for item in found] == [*KINDS]
    mesh = next(item for item in found if item["kind"] == "mesh")
    assert mesh["options"]["properties"]["triangles"]["maximum"] == 20_000_000
    assert {"mesh.glb", "mesh.usdz"} <= {one["name"] for one in mesh["artifacts"]}
    assert all(item["summary"] for item in found)
    assert problem(service.anyone.get("/v1/exports/kinds"), 401, "unauthorized")
    check_documented("POST", f"/v1/jobs/{'0' * 28}/exports", 409, "not_trained")
