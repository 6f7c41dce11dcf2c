"""`/v1/jobs/{job_id}/artifacts`, and the signed URLs of the local object store."""

from __future__ import annotations

from typing import Any

from fastapi import APIRouter, Request
from starlette.responses import RedirectResponse, Response

from api.artifacts import service
from api.artifacts.content import content_response
from api.artifacts.schemas import ArtifactList
from api.codes import BYTES
from api.deps import ServicesDep, SharedServicesDep
from api.errors import responses
from api.ids import JobId
from storage import queries
from storage.objects_local import LocalObjectStore
from storage.signed_urls import verify_object_token

router = APIRouter(prefix="/v1/jobs/{job_id}/artifacts", tags=["artifacts"])
signed_router = APIRouter(prefix="/v1/objects", tags=["artifacts"])

_BINARY = {"*/*": {"schema": {"type": "string", "format": "binary"}}}
_CONTENT: dict[int | str, dict[str, Any]] = {
    200: {"description": "The bytes.", "content": _BINARY},
    206: {"description": "The range that was asked for.", "content": _BINARY},
    304: {"description": "The client has these bytes already."},
}


@router.get("", responses=responses("job_not_found"))
def list_artifacts(job_id: JobId, services: ServicesDep, request: Request) -> ArtifactList:
    """What the job offers for download."""
    with services.database.read_scope() as session:
        job = queries.get_job(session, job_id, manifests=True)
        return ArtifactList(items=service.list_of(services, job, request))


@router.head("/{name}", include_in_schema=False)
@router.get(
    "/{name}",
    response_class=Response,
    responses={
        **responses("job_not_found", "artifact_not_found", *BYTES),
        **_CONTENT,
        307: {"description": "The bytes are at this signed URL."},
    },
)
def download_artifact(
    job_id: JobId, name: str, services: ServicesDep, request: Request
) -> Response:
    """The bytes (`Range`, `ETag`), or a redirect to a signed URL of the object store."""
    with services.database.read_scope() as session:
        found = service.find(queries.get_job(session, job_id, manifests=True), name)
    is_local = isinstance(services.store, LocalObjectStore)
    if request.method == "GET" and not is_local:  # a presigned URL is good for GET alone
        return RedirectResponse(
            service.signed_url(services, found, request),
            status_code=307,
            headers={"Cache-Control": "no-store"},
        )
    return content_response(
        request,
        services,
        key=found.key,
        size=found.bytes,
        tag=found.sha256,
        filename=found.artifact.name,
        media_type=found.artifact.media_type,
    )


@signed_router.head("/{token}", include_in_schema=False)
@signed_router.get(
    "/{token}", response_class=Response, responses={**responses("url_invalid", *BYTES), **_CONTENT}
)
def download_object(token: str, services: SharedServicesDep, request: Request) -> Response:
    """A signed, expiring URL of the local object store: needs no key."""
    signed = verify_object_token(services.settings.signing_key(), token)
    with services.asking_the_store():
        stat = services.store.stat(signed.key)
    return content_response(
        request,
        services,
        key=signed.key,
        size=stat.bytes,
        tag=signed.sha256 or stat.etag,
        filename=signed.filename,
        media_type=signed.media_type,
    )
