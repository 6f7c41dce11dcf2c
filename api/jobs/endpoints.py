"""`/v1/jobs`."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Body, Query, Request, Response

from api.codes import BODY, ONCE, RETRY
from api.deps import CallerDep, ServicesDep
from api.errors import responses
from api.idempotency import IdempotencyKey, Once
from api.ids import JobId, LabelFilter
from api.jobs import service
from api.jobs.schemas import (
    EventPage,
    EventView,
    JobPage,
    JobPlan,
    JobRequest,
    JobState,
    JobSummary,
    JobView,
    JobWish,
    LogView,
    RetryRequest,
    StageName,
)
from storage import queries, records
from storage.states import JOB_TERMINAL

POLL_S = "1"
LINKS = {
    name: {"operationId": name, "parameters": {"job_id": "$response.body#/id"}}
    for name in (
        *("get_job", "cancel_job", "retry_job", "list_job_events", "get_job_logs"),
        *("list_artifacts", "delete_job"),
    )
}
router = APIRouter(prefix="/v1/jobs", tags=["jobs"])


def _polled(job: JobView, status: int = 200) -> Response:
    """A job as the answer to who asks for it again and again.

    Written here, in the endpoint's own thread: a view that is returned is checked once more in
    another one, and written in the one that serves all connections.
    """
    headers = {"Cache-Control": "no-store"}
    if job.state not in JOB_TERMINAL:
        headers["Retry-After"] = POLL_S
    return Response(job.model_dump_json(), status, headers, media_type="application/json")


@router.post(
    "",
    status_code=202,
    responses={
        **responses("capture_not_found", "preset_unknown", "options_invalid", *BODY, *ONCE),
        202: {"links": LINKS},
    },
    response_model=JobView,
)
async def create_job(
    wanted: JobRequest,
    services: ServicesDep,
    caller: CallerDep,
    request: Request,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Make a capture into assets. The answer's `Location` is the job's address."""
    once = Once.of(caller, "POST /v1/jobs", idempotency_key, wanted.model_dump_json())
    answer = await services.creating(partial(service.create, services, wanted, once, request))
    answer.headers["Retry-After"] = POLL_S
    return answer


@router.post(":validate", responses=responses("preset_unknown", "options_invalid", *BODY))
def validate_job(wanted: JobWish, services: ServicesDep) -> JobPlan:
    """Check preset, options and labels before a capture is uploaded. Creates nothing."""
    return service.plan(services, wanted)


@router.get("", responses=responses("cursor_invalid"))
def list_jobs(
    services: ServicesDep,
    state: Annotated[JobState | None, Query()] = None,
    label: Annotated[LabelFilter | None, Query(description="KEY (has it) or KEY=VALUE.")] = None,
    limit: Annotated[int, Query(ge=1, le=100)] = 50,
    cursor: Annotated[str | None, Query(max_length=500)] = None,
) -> JobPage:
    """Jobs, newest first."""
    with services.database.read_scope() as session:
        found, following = queries.list_jobs(
            session, state=state, label=label, limit=limit, cursor=cursor
        )
        return JobPage(items=[JobSummary.of(job) for job in found], next_cursor=following)


@router.get("/{job_id}", responses=responses("job_not_found"), response_model=JobView)
def get_job(job_id: JobId, services: ServicesDep, request: Request) -> Response:
    """One job: state, stages with progress and time left, metrics, error, artifacts."""
    with services.database.read_scope() as session:
        job = service.view(services, session, job_id, request)
    return _polled(job)


@router.post(
    "/{job_id}/cancel",
    status_code=202,
    responses=responses("job_not_found", "job_finished"),
    response_model=JobView,
)
def cancel_job(
    job_id: JobId, services: ServicesDep, caller: CallerDep, request: Request
) -> Response:
    """Ask a job to stop; asking twice changes nothing. The running stage stops within 10 s."""
    service.cancel(services, job_id, caller)
    with services.database.read_scope() as session:
        job = service.view(services, session, job_id, request)
    return _polled(job, 202)


@router.post(
    "/{job_id}/retry",
    status_code=202,
    responses=responses(*RETRY, *BODY, *ONCE),
    response_model=JobView,
)
async def retry_job(
    job_id: JobId,
    services: ServicesDep,
    caller: CallerDep,
    request: Request,
    wanted: Annotated[RetryRequest | None, Body()] = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Run a job that is over again, from what failed or from where options change its results.

    What still holds is used as it is: same stage version, options, inputs and seed. Where the retry
    is cancelled, or fails, what was not made anew is offered as before; a cancel also brings back
    the options that it was made with.
    """
    wanted = wanted or RetryRequest()
    call = f"POST /v1/jobs/{job_id}/retry"
    once = Once.of(caller, call, idempotency_key, wanted.model_dump_json())
    answer = await services.creating(
        partial(service.retry, services, job_id, wanted, once, request)
    )
    answer.headers["Retry-After"] = POLL_S
    return answer


@router.get("/{job_id}/events", responses=responses("job_not_found"))
def list_job_events(
    job_id: JobId,
    services: ServicesDep,
    after: Annotated[int, Query(ge=0, lt=2**62, description="Events behind this `seq`.")] = 0,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
) -> EventPage:
    """What happened to a job, in order: when, who, why."""
    with services.database.read_scope() as session:
        queries.get_job(session, job_id)
        found = queries.list_events(session, job_id, after, limit + 1)
    items = [EventView.model_validate(event) for event in found[:limit]]
    return EventPage(items=items, next=items[-1].seq if len(found) > limit else None)


@router.delete("/{job_id}", status_code=204, responses=responses("job_not_found", "conflict"))
def delete_job(job_id: JobId, services: ServicesDep) -> None:
    """Delete a job and its bytes."""
    service.delete(services, job_id)


@router.get("/{job_id}/logs", responses=responses("job_not_found"))
def get_job_logs(
    job_id: JobId,
    services: ServicesDep,
    stage: Annotated[StageName | None, Query(description="One stage; left out: all.")] = None,
    line: Annotated[
        int, Query(ge=-(2**31), lt=2**31, description="From this line on; negative: the tail.")
    ] = 0,
    limit: Annotated[int, Query(ge=1, le=10_000)] = 1000,
) -> LogView:
    """Lines that the stages wrote."""
    with services.database.read_scope() as session:
        queries.get_job(session, job_id)
        page = records.read_logs(
            session, job_id, stage=None if stage is None else str(stage), line=line, limit=limit
        )
    return LogView(
        lines=page.lines, first=page.first, next=page.first + len(page.lines), total=page.total
    )
