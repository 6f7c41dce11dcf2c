"""A job's life: create, cancel, retry, delete.

What workers do to its stages is in `storage.claims` and `storage.leases`.

Callers commit, and ring the bell (`storage.queue`) for stages that became ready after the commit.
Reading is in `storage.queries`. `when` is for tests; it defaults to the database's clock.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import delete, select
from sqlalchemy.orm import Session, joinedload, selectinload

from storage.damage import damaged_results
from storage.db import now
from storage.errors import ConflictError, NotFoundError
from storage.keys import job_root
from storage.models import (
    Capture,
    Event,
    Job,
    JobGeneration,
    LogLine,
    PendingDeletion,
    StageRow,
    StageRun,
    new_id,
)
from storage.queue import resource_of
from storage.runs import start_generation
from storage.states import JOB_TERMINAL
from storage.transitions import (
    drop_waiting,
    lock_job,
    record_event,
    restore,
    set_job,
    set_stage,
    settle,
)

MAX_ATTEMPTS = 3
_UNTRIED: dict[str, Any] = {
    "attempt": 0,
    "not_before": None,
    "progress": 0.0,
    "message": "",
    "heartbeat_at": None,
    "progress_at": None,
    "started_at": None,
    "finished_at": None,
    "error": None,
    "report_prefix": None,
    "report_files": None,
}
"""Of a stage that is done again. What its last success published it keeps until the next."""
_UNMADE: dict[str, Any] = {
    "output_prefix": None,
    "summary": None,
    "manifest": None,
    "fingerprint": None,
}
"""Of one whose files were found damaged, too: they are no result."""


@dataclass(frozen=True)
class StageSeed:
    """A stage as the job's creator names it. `after`: names of stages earlier in the list."""

    name: str
    after: tuple[str, ...]
    needs_gpu: bool = False
    skipped: bool = False


def stage_id(job_id: str, name: str) -> str:
    """The id of a stage's row: all that a message carries."""
    return f"{job_id}-{name}"


def queue_key(created_at: datetime, job_id: str, seq: int) -> str:
    """Sorts stages that wait: the oldest job first, of a job the earliest stage."""
    return f"{int(created_at.timestamp() * 1000):012x}{job_id}{seq:04d}"


def _stage_rows(job: Job, stages: Sequence[StageSeed], max_attempts: int) -> list[StageRow]:
    return [
        StageRow(
            id=stage_id(job.id, stage.name),
            tenant_id=job.tenant_id,
            job_id=job.id,
            name=stage.name,
            seq=position,
            after=list(stage.after),
            state="skipped" if stage.skipped else "blocked",
            queue_key=queue_key(job.created_at, job.id, position),
            resource=resource_of(stage.needs_gpu),
            max_attempts=max_attempts,
            lease_token=0,
            attempt=0,
            progress=0.0,
            message="",
        )
        for position, stage in enumerate(stages)
    ]


def create_job(
    session: Session,
    *,
    capture_id: str,
    preset: str,
    preset_reason: str,
    options: dict[str, Any],
    stages: Sequence[StageSeed],
    labels: dict[str, str] | None = None,
    seed: int = 0,
    max_attempts: int = MAX_ATTEMPTS,
    when: datetime | None = None,
) -> Job:
    """Record a job and its stages; those with nothing to wait for are `ready`.

    It belongs to its capture's tenant. Ring for `ready_stage_ids(job)` after the commit. Raises
    NotFoundError for an unknown or deleted capture, ValueError for stages that nothing could start.
    """
    when = when or now(session)
    # Looked at anew: the caller may have read it before another deleted it.
    capture = session.get(
        Capture, capture_id, with_for_update={"read": True}, populate_existing=True
    )
    if capture is None or capture.deleted_at is not None:
        raise NotFoundError("capture", capture_id)
    job = Job(
        **identity(capture.tenant_id),
        capture_id=capture_id,
        state="queued",
        preset=preset,
        preset_reason=preset_reason,
        options=options,
        labels=labels or {},
        seed=seed,
        generation=1,
        created_at=when,
    )
    return enter(session, job, stages, max_attempts, when)


def identity(tenant_id: str) -> dict[str, str]:
    """What a new job of a tenant is called, and where its bytes will lie."""
    job_id = new_id()
    return {"id": job_id, "tenant_id": tenant_id, "object_root": job_root(tenant_id, job_id)}


def enter(
    session: Session, job: Job, stages: Sequence[StageSeed], max_attempts: int, when: datetime
) -> Job:
    """Write a new job and its stages. Raises ValueError for stages that nothing could start."""
    names = [stage.name for stage in stages]
    for position, stage in enumerate(stages):
        if not set(stage.after) <= set(names[:position]):
            raise ValueError(f"stage {stage.name} waits for a stage that is not before it")
    session.add(job)
    session.flush()
    rows = _stage_rows(job, stages, max_attempts)
    session.add_all(rows)
    start_generation(session, job, when)
    record_event(session, job, "job.queued", when)
    session.flush()
    if not settle(session, job, rows, when):
        raise ValueError("a job needs at least one stage that can start")
    return job


def ready_stage_ids(job: Job) -> list[str]:
    """The stages of a loaded job that can start now."""
    return [row.id for row in job.stages if row.state == "ready"]


def request_cancel(session: Session, job_id: str, when: datetime | None = None) -> Job:
    """Ask a job to stop; a second request, or one for a finished job, changes nothing.

    The job is `cancelled` at once where no stage runs, else `cancelling` until it has stopped. What
    a retry was to make anew is then as it was before it.
    """
    job, stages = lock_job(session, job_id)
    when = when or now(session)
    if job.state in ("queued", "running"):
        drop_waiting(session, stages, when, "job_cancelled")
        running = any(row.state == "running" for row in stages)
        state = "cancelling" if running else "cancelled"
        set_job(session, job, state, when, cancel_requested_at=when)
        settle(session, job, stages, when)
    return job


def open_for_retry(session: Session, job_id: str) -> Job:
    """A job that is over, locked, with its stages, their manifests and its capture's row.

    Of an export its job is locked too, and loaded likewise. Raises NotFoundError; ConflictError
    while it runs, or a stage of it has not stopped.
    """
    parent_id = session.scalar(select(Job.parent_id).where(Job.id == job_id))
    if parent_id is not None:
        lock_job(session, parent_id)  # before its exports: so does who deletes it
    job, stages = lock_job(session, job_id)
    if job.state not in JOB_TERMINAL or any(row.state == "running" for row in stages):
        raise ConflictError(f"Job {job_id} is not over yet.")
    session.get(Capture, job.capture_id, with_for_update={"read": True}, populate_existing=True)
    query = select(Job).where(Job.id == job_id)
    loaded = selectinload(Job.stages).undefer(StageRow.manifest)
    parents = joinedload(Job.parent).selectinload(Job.stages).undefer(StageRow.manifest)
    return session.scalars(query.options(joinedload(Job.capture), loaded, parents)).one()


def _with_other_inputs(stages: Sequence[StageRow], redo: Collection[str]) -> set[str]:
    """The stages behind those that are done again, also behind skipped ones, which pass through.

    stages: in order.
    """
    moved: set[str] = set()
    for row in stages:
        if any(name in redo or name in moved for name in row.after):
            moved.add(row.name)
    return moved


def retry_job(
    session: Session,
    job: Job,
    redo: Collection[str],
    options: dict[str, Any],
    *,
    changes: dict[str, Any],
    from_stage: str | None = None,
    when: datetime | None = None,
) -> list[str]:
    """Run some stages of a job again, as its next generation. Ids newly ready.

    job: from `open_for_retry`, in the same session. redo: their names; with a stage all that wait
    for it. options: of all stages, as they are to be from now on; changes: what is new in them,
    for the record. What the other stages published stays and is used; so does the checkpoint of a
    stage that had not succeeded, which decides itself whether it fits its options. Behind a stage
    that is done again no checkpoint is kept: it was begun on inputs that are no more. What a stage
    that is done again had published stays its own until it has succeeded anew: where that does not
    happen it is its result again (`storage.transitions.put_back`), unless a later stage found it
    damaged. So it is of a stage that ended badly and is not done again.
    """
    when = when or now(session)
    stages = list(job.stages)
    moved = _with_other_inputs(stages, redo)
    damaged = damaged_results(session, job)
    for row in stages:
        gone, kept = [row.report_prefix], row.checkpoint_prefix
        if row.name in redo:
            if row.name in moved:
                gone, kept = [*gone, kept], None
            values = {**_UNTRIED, "checkpoint_prefix": kept}
            values |= _UNMADE if row.name in damaged else {}
            set_stage(session, row, "blocked", when, reason="retry", **values)
        elif row.state in ("failed", "cancelled") and row.output_prefix is not None:
            restore(session, row, when)
        else:
            continue
        session.add_all(PendingDeletion(prefix=old, created_at=when) for old in gone if old)
    record = {"generation": job.generation + 1, "from_stage": from_stage, "options": changes}
    set_job(
        session,
        job,
        "queued",
        when,
        reason="retry",
        data={**record, "stages": [row.name for row in stages if row.name in redo]},
        generation=job.generation + 1,
        options=options,
        error=None,
        started_at=None,
        finished_at=None,
        cancel_requested_at=None,
    )
    start_generation(session, job, when, from_stage)
    return settle(session, job, stages, when)


def delete_job(session: Session, job_id: str, when: datetime | None = None) -> None:
    """Delete a job's records and put its bytes up for deletion (`storage.deletions`).

    Its exports go with it; a queued job or export is dropped. Raises ConflictError while it or an
    export of it runs, or has not stopped.
    """
    when = when or now(session)
    exports = select(Job.id).where(Job.parent_id == job_id).order_by(Job.id)
    gone = [_locked_and_stopped(session, job_id)]
    gone += [_locked_and_stopped(session, one) for one in session.scalars(exports).all()]
    for job in reversed(gone):
        # Stages first: that waits for who just adds log lines, and holds off who would.
        for record in (StageRow, Event, LogLine, StageRun, JobGeneration):
            session.execute(delete(record).where(record.job_id == job.id))
        session.add(PendingDeletion(prefix=job.object_root, created_at=when))
        session.execute(delete(Job).where(Job.id == job.id))


def _locked_and_stopped(session: Session, job_id: str) -> Job:
    job, stages = lock_job(session, job_id)
    what = f"Job {job.id}" if job.parent_id is None else f"The job's export {job.id}"
    if job.state == "running":
        raise ConflictError(f"{what} is running; cancel it first.")
    if job.state == "cancelling" or any(row.state == "running" for row in stages):
        raise ConflictError(f"{what} is {job.state}; wait until it has stopped.")
    return job
