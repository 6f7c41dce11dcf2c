"""Exports: what they are asked for, and of which jobs; then the records and the bell."""

from __future__ import annotations

from functools import cache

from fastapi import Request
from sqlalchemy.orm import Session
from starlette.responses import Response

from api.deps import Services
from api.exports.schemas import ArtifactKind, ExportKindView, ExportRequest
from api.idempotency import Once, do_once
from api.jobs.exportable import check_exportable
from api.jobs.schemas import JobView
from api.jobs.service import view
from pipelines.exports.catalogue import EXPORTS
from pipelines.exports.requests import resolve_export
from pipelines.registry import get_stage
from storage import exports, jobs


def create(
    services: Services, job_id: str, wanted: ExportRequest, once: Once, request: Request
) -> Response:
    """Record an export of a job, once, and have workers told of it. Returns the answer.

    Raises NotFoundError, ConflictedError (not_trained), OptionsError.
    """
    ready: list[str] = []

    def make(session: Session) -> tuple[JobView, str]:
        parent = exports.open_for_export(session, job_id)
        check_exportable(parent)
        stage = get_stage(str(wanted.kind))
        export = exports.create_export(
            session,
            parent,
            stage.name,
            resolve_export(
                stage.name, parent.preset, parent.options.get(stage.name, {}), wanted.options
            ),
            needs_gpu=stage.needs_gpu,
            labels=wanted.labels,
        )
        made = view(services, session, export.id, request)
        ready.extend(jobs.ready_stage_ids(export))  # which the view has loaded
        return made, f"/v1/jobs/{export.id}"

    done = do_once(services, once, 202, make)
    if not done.is_replayed:
        services.bell.ring(ready)
    return done.response


@cache
def kind_views() -> tuple[ExportKindView, ...]:
    """All kinds of export, with JSON Schema of their options."""
    return tuple(
        ExportKindView(
            kind=export.kind,
            summary=(export.options.__doc__ or "").strip(),
            version=export.version,
            on_request=export.on_request,
            artifacts=[
                ArtifactKind(
                    name=artifact.name,
                    media_type=artifact.media_type,
                    opens_with=artifact.opens_with,
                    on_request=artifact.on_request,
                )
                for artifact in export.artifacts
            ],
            options={
                **export.options.model_json_schema(),
                "$schema": "https://json-schema.org/draft/2020-12/schema",
            },
        )
        for export in EXPORTS
    )
