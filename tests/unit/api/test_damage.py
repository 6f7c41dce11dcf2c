"""Bytes that are damaged in the object store, from a worker's word on."""

from __future__ import annotations

from storage.claims import claim_stage
from storage.damage import CAPTURE
from storage.jobs import stage_id
from storage.leases import fail_stage
from tests.unit.api.conftest import LEASE_S, Service, zip_of_pictures
from worker.outcomes import InputDamagedError, failure_of


def fail_on(service: Service, job_id: str, name: str) -> None:
    """Fail the first stage of a job as a worker does that found this input damaged."""
    error = failure_of("ingest", InputDamagedError(name, "rotten"))
    with service.services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, "ingest"), "test", LEASE_S)
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
