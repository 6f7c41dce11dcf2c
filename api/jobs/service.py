"""Jobs: which preset, which options, which stages; then the records and the bell."""

from __future__ import annotations

from collections.abc import Collection
from datetime import datetime

from fastapi import Request
from sqlalchemy.orm import Session
from starlette.responses import Response

from api.artifacts import service as artifacts
from api.deps import DELETE_WAIT_S, Caller, Services, actor_of
from api.idempotency import Once, do_once
from api.jobs import retrying
from api.jobs.schemas import JobPlan, JobRequest, JobView, JobWish, RetryRequest
from api.problems import ConflictedError, FieldProblem, InvalidRequestError
from pipelines.options import resolve_options, stages_skipped
from pipelines.presets import PRESETS
from pipelines.registry import STAGE_NAMES, STAGES
from storage import jobs, queries, records
from storage.db import now
from storage.jobs import StageSeed
from storage.models import Job

PRESET_WITH_GPU = "standard"
PRESET_WITHOUT_GPU = "preview"


def default_preset(session: Session, when: datetime | None = None) -> tuple[str, str]:
    """The preset of a job that names none, and why it is that one."""
    if records.has_live_gpu(session, when):
        return PRESET_WITH_GPU, "no preset was asked for, and a GPU worker is registered"
    return PRESET_WITHOUT_GPU, "no preset was asked for, and no GPU worker is registered"


def choose_preset(
    session: Session, asked: str | None, when: datetime | None = None
) -> tuple[str, str]:
    """The preset and the reason. Raises InvalidRequestError for one that does not exist."""
    if asked is None:
        return default_preset(session, when)
    if asked not in PRESETS:
        known = ", ".join(PRESETS)
        raise InvalidRequestError(
            f"There is no preset of that name; there are {known}.",
            code="preset_unknown",
            hint="GET /v1/presets lists them; leave it out and the service chooses.",
            errors=[FieldProblem(path="preset", detail=f"one of {known}")],
        )
    return asked, "asked for"


def stage_seeds(preset: str, kind: str, asked: Collection[str]) -> list[StageSeed]:
    """The stages of a job with this preset on a capture of this kind. asked: with options."""
    skipped = stages_skipped(preset, kind, asked)
    return [
        StageSeed(stage.name, stage.after, stage.needs_gpu, stage.name in skipped)
        for stage in STAGES
    ]


def plan(services: Services, wanted: JobWish) -> JobPlan:
    """Check what a job is asked for, before there is a capture.

    Raises InvalidRequestError (preset), OptionsError.
    """
    with services.database.read_scope() as session:
        preset, reason = choose_preset(session, wanted.preset)
    return JobPlan(
        preset=preset,
        preset_reason=reason,
        options=resolve_options(preset, wanted.options),
        labels=wanted.labels,
        without=[name for name in STAGE_NAMES if name in PRESETS[preset].without],
    )


def create(services: Services, wanted: JobRequest, once: Once, request: Request) -> Response:
    """Record a job, once, and have workers told of it. Returns the answer.

    Everything is checked before anything is written. Raises NotFoundError (capture),
    InvalidRequestError (preset), OptionsError.
    """
    ready: list[str] = []

    def make(session: Session) -> tuple[JobView, str]:
        when = now(session)
        kind = records.get_capture(session, wanted.capture_id).kind
        preset, reason = choose_preset(session, wanted.preset, when)
        job = jobs.create_job(
            session,
            capture_id=wanted.capture_id,
            preset=preset,
            preset_reason=reason,
            options=resolve_options(preset, wanted.options),
            stages=stage_seeds(preset, kind, wanted.options),
            labels=wanted.labels,
            when=when,
        )
        made = view(services, session, job.id, request)
        ready.extend(jobs.ready_stage_ids(job))  # which the view has loaded
        return made, f"/v1/jobs/{job.id}"

    done = do_once(services, once, 202, make)
    if not done.is_replayed:
        services.bell.ring(ready)
    return done.response


def view(services: Services, session: Session, job_id: str, request: Request) -> JobView:
    """A job with all that the API says of it. Raises NotFoundError."""
    job = queries.get_job(session, job_id, manifests=True)
    return JobView(
        **JobView.fields_of(job),
        queue_position=queries.queue_position(session, job),
        artifacts=artifacts.list_of(services, job, request),
    )


def retry(
    services: Services, job_id: str, wanted: RetryRequest, once: Once, request: Request
) -> Response:
    """Run a job that is over again, once. Raises what `retrying.retry` raises."""
    ready: list[str] = []

    def make(session: Session) -> tuple[JobView, str]:
        ready.extend(retrying.retry(session, job_id, wanted))
        session.flush()
        session.expire_all()  # the answer is what the database now holds
        return view(services, session, job_id, request), f"/v1/jobs/{job_id}"

    done = do_once(services, once, 202, make)
    if not done.is_replayed:
        services.bell.ring(ready)
    return done.response


def cancel(services: Services, job_id: str, caller: Caller) -> None:
    """Ask a job to stop. Raises ConflictedError where it ended otherwise already."""
    with services.database.session_scope(actor_of(caller), step="cancel") as session:
        job = jobs.request_cancel(session, job_id)
        _check_cancelled(job)


def _check_cancelled(job: Job) -> None:
    if job.state in ("succeeded", "failed"):
        raise ConflictedError(
            f"The job has {job.state} already.",
            code="job_finished",
            hint="There is nothing left to cancel; DELETE removes it.",
        )


def delete(services: Services, job_id: str) -> None:
    """Delete a job and its bytes. Raises ConflictError while it runs."""
    with services.database.session_scope(step="delete") as session:
        jobs.delete_job(session, job_id)
    services.drainer.drain(DELETE_WAIT_S)
