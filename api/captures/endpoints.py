"""`/v1/captures`."""

from __future__ import annotations

import asyncio
from contextlib import ExitStack
from functools import partial
from typing import Annotated

from fastapi import APIRouter, Query, Request, Response
from fastapi import Body as JsonBody
from starlette.requests import ClientDisconnect

from api.captures import service
from api.captures.receiving import Body, receive, staging_file
from api.captures.schemas import CapturePage, CaptureView
from api.codes import BODY as JSON_BODY
from api.codes import CAPTURE, ONCE, UPLOAD
from api.deps import CallerDep, ServicesDep
from api.errors import responses
from api.idempotency import IdempotencyKey, Once
from api.ids import CaptureId
from api.jobs.endpoints import LINKS as JOB_LINKS
from api.jobs.endpoints import POLL_S
from api.jobs.schemas import CheckRequest, JobRequest, JobView
from api.jobs.service import create as create_job
from api.problems import ApiError
from storage import queries, records

PATH = "/v1/captures"
CLIENT_WENT_AWAY = 499
CHECK = "check"
"""The preset that finds poses, judges the capture by them, and ends there."""
router = APIRouter(prefix=PATH, tags=["captures"])

MADE = "$response.body#/id"
LINKS = {
    "get_capture": {"operationId": "get_capture", "parameters": {"capture_id": MADE}},
    "delete_capture": {"operationId": "delete_capture", "parameters": {"capture_id": MADE}},
    "check_capture": {"operationId": "check_capture", "parameters": {"capture_id": MADE}},
    "create_job": {"operationId": "create_job", "requestBody": {"capture_id": MADE}},
}
_UPLOAD_SCHEMA = {
    "requestBody": {
        "required": True,
        "content": {
            "multipart/form-data": {
                "schema": {
                    "type": "object",
                    "required": ["file"],
                    "properties": {"file": {"type": "string", "format": "binary"}},
                }
            }
        },
    }
}


@router.post(
    "",
    status_code=201,
    responses={**responses(*UPLOAD, *CAPTURE, *ONCE), 201: {"links": LINKS}},
    openapi_extra=_UPLOAD_SCHEMA,
    response_model=CaptureView,
)
async def create_capture(
    request: Request,
    services: ServicesDep,
    caller: CallerDep,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Upload a capture as multipart part `file`. What it is, the bytes decide."""
    settings = services.settings
    body = Body(request.receive, settings.min_upload_bytes_per_s)
    headers = request.headers
    with ExitStack() as held:
        try:
            held.enter_context(services.taking_an_upload())
            staging = held.enter_context(staging_file(settings.staging_dir))
            limits = await asyncio.to_thread(service.limits, services, staging[0])
            received = await receive(
                body,
                headers.get("content-type"),
                headers.get("content-length"),
                staging,
                limits,
            )
        except ClientDisconnect:
            return Response(status_code=CLIENT_WENT_AWAY)
        except ApiError:
            await body.linger()
            raise
        content = (received.sha256, received.filename)
        once = Once.of(caller, f"POST {PATH}", idempotency_key, *content)
        return await asyncio.to_thread(service.keep, services, received, once)


@router.get("", responses=responses("cursor_invalid"))
def list_captures(
    services: ServicesDep,
    limit: Annotated[int, Query(ge=1, le=100)] = 50,
    cursor: Annotated[str | None, Query(max_length=500)] = None,
) -> CapturePage:
    """Captures, newest first."""
    with services.database.read_scope() as session:
        found, following = queries.list_captures(session, limit=limit, cursor=cursor)
        return CapturePage(items=[CaptureView.of(one) for one in found], next_cursor=following)


@router.get("/{capture_id}", responses=responses("capture_not_found"))
def get_capture(capture_id: CaptureId, services: ServicesDep) -> CaptureView:
    """One capture."""
    with services.database.read_scope() as session:
        return CaptureView.of(records.get_capture(session, capture_id))


@router.post(
    "/{capture_id}/check",
    status_code=202,
    responses={
        **responses("capture_not_found", "options_invalid", *JSON_BODY, *ONCE),
        202: {"links": JOB_LINKS},
    },
    response_model=JobView,
)
async def check_capture(
    capture_id: CaptureId,
    services: ServicesDep,
    caller: CallerDep,
    request: Request,
    wanted: Annotated[CheckRequest | None, JsonBody()] = None,
    idempotency_key: IdempotencyKey = None,
) -> Response:
    """Is the capture any good? A job that ends after the poses, with preset `check`.

    Poll and cancel it as any other. `check` in its view is the verdict, what it rests on, and what
    to do better; `capture-report.html` shows it. A job that fails for what the capture is says so
    there, too.
    """
    wanted = wanted or CheckRequest()
    once = Once.of(
        caller, f"POST {PATH}/{capture_id}/check", idempotency_key, wanted.model_dump_json()
    )
    job = JobRequest(
        capture_id=capture_id, preset=CHECK, options=wanted.options, labels=wanted.labels
    )
    answer = await services.creating(partial(create_job, services, job, once, request))
    answer.headers["Retry-After"] = POLL_S
    return answer


@router.delete(
    "/{capture_id}", status_code=204, responses=responses("capture_not_found", "conflict")
)
def delete_capture(capture_id: CaptureId, services: ServicesDep) -> None:
    """Delete a capture and its bytes. Finished jobs keep their results."""
    service.delete(services, capture_id)
