"""Exports: jobs of their own that read what another job's stages published.

An export has one stage, named after its kind, and takes seed and capture from the job it is of. The
capture may be gone: only the job's published stages are read, and they stay as long as the job.
Locks go from the job to its exports. Callers commit, and ring the bell for `ready_stage_ids` after
the commit. `when` is for tests; it defaults to the database's clock.
"""

from __future__ import annotations

from datetime import datetime
from typing import Any

from sqlalchemy import select
from sqlalchemy.orm import Session, selectinload

from storage.db import now
from storage.jobs import MAX_ATTEMPTS, StageSeed, enter, identity
from storage.models import Job
from storage.states import JOB_LIVE
from storage.transitions import lock_job


def open_for_export(session: Session, job_id: str) -> Job:
    """A job with its stages, locked: nobody retries or deletes it meanwhile.

    Raises NotFoundError.
    """
    job, _ = lock_job(session, job_id)
    return job


def create_export(
    session: Session,
    parent: Job,
    kind: str,
    options: dict[str, Any],
    *,
    needs_gpu: bool = False,
    labels: dict[str, str] | None = None,
    max_attempts: int = MAX_ATTEMPTS,
    when: datetime | None = None,
) -> Job:
    """Record an export, whose only stage is `ready`.

    parent: from `open_for_export`, in the same session. kind: name of the stage. options: of it.
    """
    when = when or now(session)
    export = Job(
        **identity(parent.tenant_id),
        capture_id=parent.capture_id,
        parent_id=parent.id,
        state="queued",
        preset=parent.preset,
        preset_reason="of the job that it is an export of",
        options={kind: options},
        labels=labels or {},
        seed=parent.seed,
        generation=1,
        created_at=when,
    )
    return enter(session, export, [StageSeed(kind, (), needs_gpu)], max_attempts, when)


def live_exports(session: Session, job_id: str) -> list[Job]:
    """The exports of a job that are not over, with their stages, oldest first."""
    query = select(Job).where(Job.parent_id == job_id, Job.state.in_(JOB_LIVE))
    query = query.options(selectinload(Job.stages)).order_by(Job.created_at, Job.id)
    return list(session.scalars(query))
