"""Bytes that are damaged in the object store, from a worker's word on."""

from __future__ import annotations

from pipelines.registry import STAGES
from storage.claims import claim_stage
from storage.damage import CAPTURE
from storage.jobs import stage_id
from storage.leases import fail_stage
from tests.unit.api.conftest import LEASE_S, Service, finish_job, run_stage, zip_of_pictures
from tests.unit.api.test_exports import export
from tests.unit.api.test_retry import BEHIND_MESH, again, retry
from worker.outcomes import InputDamagedError, failure_of


def fail_on(service: Service, job_id: str, name: str, stage: str = "ingest") -> None:
    """Fail a stage of a job as a worker does that found this input damaged."""
    error = failure_of(stage, InputDamagedError(name, "rotten", of_parent=stage != "ingest"))
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, stage), "test", LEASE_S)
        assert claim is not None
        fail_stage(session, claim, error, retryable=False)


def test_bytes_that_a_worker_found_rotten_are_put_right_by_the_next_upload(
    service: Service,
) -> None:
    content = zip_of_pictures()
    job = service.job(service.upload(content)["id"])["id"]
    (stored,) = service.objects()
    rotten = bytes(len(content))
    stored.write_bytes(rotten)
    other = service.upload(zip_of_pictures(4))["id"]
    fail_on(service, service.job(other)["id"], CAPTURE)
    service.upload(content)
    assert stored.read_bytes() == rotten, "nobody has told of these yet"
    fail_on(service, job, CAPTURE)
    service.upload(content)
    assert stored.read_bytes() == content
    service.http.post(f"/v1/jobs/{job}/retry")
    stored.write_bytes(rotten)
    service.upload(content)
    assert stored.read_bytes() == rotten, "the job has begun anew, and told nothing since"


def test_what_an_export_found_damaged_is_made_again_by_its_job(service: Service) -> None:
    job = service.job(preset="preview")["id"]
    finish_job(service.services, job, lambda name: name.encode())
    made = export(service, job, "mesh")["id"]
    fail_on(service, made, "train", "mesh")
    assert "runs train again" in service.http.get(f"/v1/jobs/{made}").json()["error"]["hint"]
    redone = again(retry(service, job))
    assert redone >= {"train", *BEHIND_MESH}
    assert "depth" not in redone
    found = service.http.post(f"/v1/jobs/{job}/cancel").json()
    names = {artifact["name"] for artifact in found["artifacts"]}
    assert "model.zip" not in names, "what is damaged is none to come back to"
    finish_again(service, job)
    assert retry(service, job, status=409)["code"] == "nothing_to_retry"


def finish_again(service: Service, job: str) -> None:
    """Retry a job, and run what that takes."""
    redone = again(retry(service, job))
    for stage in STAGES:
        if stage.name in redone:
            files = {artifact.path: stage.name.encode() for artifact in stage.artifacts}
            run_stage(service.services, job, stage.name, files)
