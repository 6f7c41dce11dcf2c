"""`/v1/jobs/{job_id}/exports` and `/v1/exports/kinds`. An export itself is a job: `/v1/jobs`."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response

from api.codes import BODY, ONCE
from api.deps import CallerDep, ServicesDep
from api.errors import responses
from api.exports import service
from api.exports.schemas import ExportKindList, ExportRequest
from api.idempotency import IdempotencyKey, Once
from api.ids import JobId, LabelFilter
from api.jobs.endpoints import LINKS, POLL_S
from api.jobs.schemas import JobPage, JobState, JobSummary, JobView
from storage import queries

router = APIRouter(prefix="/v1", tags=["exports"])


@router.post(
    "/jobs/{job_id}/exports",
    status_code=202,
    responses={
        **responses("job_not_found", "not_trained", "options_invalid", *BODY, *ONCE),
        202: {"links": LINKS},
    },
    response_model=JobView,
)
async def create_export(
    job_id: JobId,
    wanted: ExportRequest,
    services: ServicesDep,
    caller: CallerDep,
    request: Request,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Export a trained job's scene, whenever: its capture is not needed, nothing is trained.

    The answer is a job of its own, whose address is in `Location`; it is deleted with the job.
    """
    call = f"POST /v1/jobs/{job_id}/exports"
    once = Once.of(caller, call, idempotency_key, wanted.model_dump_json())
    answer = await services.creating(
        partial(service.create, services, job_id, wanted, once, request)
    )
    answer.headers["Retry-After"] = POLL_S
    return answer


@router.get("/jobs/{job_id}/exports", responses=responses("job_not_found", "cursor_invalid"))
def list_exports(
    job_id: JobId,
    services: ServicesDep,
    state: Annotated[JobState | None, Query()] = None,
    label: Annotated[LabelFilter | None, Query(description="KEY (has it) or KEY=VALUE.")] = None,
    limit: Annotated[int, Query(ge=1, le=100)] = 50,
    cursor: Annotated[str | None, Query(max_length=500)] = None,
) -> JobPage:
    """The exports that were asked for of a job, newest first."""
    with services.database.read_scope() as session:
        queries.get_job(session, job_id)
        found, following = queries.list_jobs(
            session, state=state, label=label, limit=limit, cursor=cursor, exports_of=job_id
        )
        return JobPage(items=[JobSummary.of(job) for job in found], next_cursor=following)


@router.get("/exports/kinds", responses=responses())
def list_export_kinds() -> ExportKindList:
    """What can be exported, with JSON Schema of each kind's options."""
    return ExportKindList(items=list(service.kind_views()))
