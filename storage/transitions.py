"""How a state changes: the one mechanism under `storage.jobs`, `storage.claims`, `storage.leases`.

Every change locks rows in one order, a job's stages by their places and then the job (on SQLite a
writing session holds the whole file), names the old state, the fencing token and the lease that was
read in its UPDATE, is checked against `storage.states`, and records an event in the same
transaction. Only those three modules use this one.
"""

from __future__ import annotations

from collections.abc import Mapping
from datetime import datetime
from types import MappingProxyType
from typing import Any, cast

from sqlalchemy import CursorResult, select, update
from sqlalchemy.orm import Session

from storage.db import ACTOR
from storage.errors import ConflictError, LostLeaseError, NotFoundError
from storage.models import Event, Job, StageRow
from storage.results import fitting
from storage.runs import RunEnd, end_run, maker_of, options_of
from storage.states import JOB_TERMINAL, STAGE_DONE, check_transition


def record_event(
    session: Session,
    of: Job | StageRow,
    kind: str,
    when: datetime,
    stage: str | None = None,
    reason: str = "",
    **data: Any,
) -> None:
    """Note what happened, under the session's actor (`Database.session_scope`).

    of: the job; or the stage, which the event then names.
    """
    session.add(
        Event(
            tenant_id=of.tenant_id,
            job_id=of.job_id if isinstance(of, StageRow) else of.id,
            stage=of.name if isinstance(of, StageRow) else stage,
            kind=kind,
            actor=session.info.get(ACTOR, "service"),
            reason=reason,
            data=data,
            created_at=when,
        )
    )


def lock_job(session: Session, job_id: str, *, nowait: bool = False) -> tuple[Job, list[StageRow]]:
    """The job and its stages as they are now, locked until the transaction ends.

    Stages before the job: so does a claim, which begins with one stage. Others may still add rows
    that name the job (events, log lines). nowait: with an OperationalError where another has one of
    them locked (`storage.db.is_locked`).
    """
    fresh = {"populate_existing": True}
    stages = session.scalars(
        select(StageRow)
        .where(StageRow.job_id == job_id)
        .order_by(StageRow.seq)
        .with_for_update(key_share=True, nowait=nowait),
        execution_options=fresh,
    ).all()
    job = session.scalars(
        select(Job).where(Job.id == job_id).with_for_update(key_share=True, nowait=nowait),
        execution_options=fresh,
    ).one_or_none()
    if job is None:
        raise NotFoundError("job", job_id)
    return job, list(stages)


def set_stage(
    session: Session,
    row: StageRow,
    state: str,
    when: datetime,
    *,
    run: RunEnd | None = None,
    reason: str = "",
    **values: Any,
) -> None:
    """Compare-and-set on state, token and lease; drops the lease where the stage leaves `running`.

    run: how the claim ended, where the stage leaves `running`.
    """
    check_transition("stage", row.state, state)
    old, data = row.state, {"attempt": values.get("attempt", row.attempt)}
    if old == "running":
        if run is None:
            raise ValueError(f"stage {row.id} leaves running, and nobody says how its claim ended")
        values |= {"lease_owner": None, "lease_until": None, "eta_s": None}
        end_run(session, row, run, state, when)
        data["outcome"] = run.outcome
    if state == "ready":
        values.setdefault("ready_at", when)
        values.setdefault("rung_at", None)
    if state in ("succeeded", "failed", "cancelled"):
        values.setdefault("finished_at", when)
    statement = (
        update(StageRow)
        .where(
            StageRow.id == row.id,
            StageRow.state == old,
            StageRow.lease_token == row.lease_token,
            StageRow.lease_until == row.lease_until
            if row.lease_until is not None
            else StageRow.lease_until.is_(None),
        )
        .values(state=state, **values)
    )
    if cast("CursorResult[Any]", session.execute(statement)).rowcount != 1:
        raise LostLeaseError(f"stage {row.id} is no longer {old}, or its lease was extended")
    if values.get("error"):
        data["error"] = values["error"]
        reason = reason or str(values["error"].get("code", ""))
    record_event(session, row, f"stage.{state}", when, reason=reason, was=old, **data)


def set_job(
    session: Session,
    job: Job,
    state: str,
    when: datetime,
    *,
    reason: str = "",
    data: Mapping[str, Any] = MappingProxyType({}),
    **values: Any,
) -> None:
    """Compare-and-set on the state. data: what the event says besides."""
    check_transition("job", job.state, state)
    old = job.state
    if state in JOB_TERMINAL:
        values.setdefault("finished_at", when)
    statement = update(Job).where(Job.id == job.id, Job.state == old)
    result = session.execute(statement.values(state=state, **values))
    if cast("CursorResult[Any]", result).rowcount != 1:
        raise ConflictError(f"job {job.id} is no longer {old}")
    if values.get("error"):
        reason = reason or str(values["error"].get("code", ""))
    record_event(session, job, f"job.{state}", when, reason=reason, was=old, **data)


def _is_done(name: str, by_name: dict[str, StageRow]) -> bool:
    """Succeeded; or skipped, with all that it waits for done: a skipped stage passes through."""
    row = by_name[name]
    if row.state == "skipped":
        return all(_is_done(earlier, by_name) for earlier in row.after)
    return row.state in STAGE_DONE


def settle(session: Session, job: Job, stages: list[StageRow], when: datetime) -> list[str]:
    """Draw the consequences for the job: unblock, succeed, finish a cancel, put back what a retry
    left undone. Ids newly ready."""
    if job.state == "cancelling" or job.state in JOB_TERMINAL:
        if not any(row.state == "running" for row in stages):
            if job.state == "cancelling":
                set_job(session, job, "cancelled", when)
            put_back(session, job, stages, when)
        return []
    by_name = {row.name: row for row in stages}
    ready = [
        row
        for row in stages
        if row.state == "blocked" and all(_is_done(earlier, by_name) for earlier in row.after)
    ]
    for row in ready:
        set_stage(session, row, "ready", when)
    if all(row.state in STAGE_DONE for row in stages):
        set_job(session, job, "succeeded", when)
    return [row.id for row in ready]


def put_back(session: Session, job: Job, stages: list[StageRow], when: datetime) -> None:
    """Of a job that is over: stages that a retry left undone have again what they had made before.

    But not where what that was made of is no more (`storage.results`). A failed stage stays failed,
    and a failed job keeps the options that it was to be run with; one that was cancelled gets those
    that its results were made with.
    """
    undone = [row for row in stages if row.state == "cancelled" and row.output_prefix is not None]
    if not undone:
        return
    fit = fitting(stages)
    options = dict(job.options)
    for row in undone:
        if row.name not in fit:
            continue
        made_with = restore(session, row, when)
        if job.state == "cancelled" and made_with is not None:
            options[row.name] = made_with
    if options != job.options:
        job.options = options


def restore(session: Session, row: StageRow, when: datetime) -> dict[str, Any] | None:
    """Make what a stage had made before its result again. The options that it was made with."""
    run = maker_of(session, row)
    values: dict[str, Any] = {"progress": 1.0, "message": "", "error": None, "not_before": None}
    if run is not None:
        values |= {"attempt": run.attempt, "started_at": run.started_at}
        values |= {"finished_at": run.finished_at, "progress_at": run.finished_at}
    values |= {"report_prefix": None, "report_files": None}
    set_stage(session, row, "succeeded", when, reason="earlier_result", **values)
    return None if run is None else options_of(session, run)


def drop_waiting(
    session: Session, stages: list[StageRow], when: datetime, reason: str = ""
) -> None:
    for row in stages:
        if row.state in ("blocked", "ready"):
            set_stage(session, row, "cancelled", when, reason=reason)


def fail_for_good(
    session: Session,
    job: Job,
    stages: list[StageRow],
    row: StageRow,
    error: dict[str, Any],
    when: datetime,
    *,
    run: RunEnd,
    **values: Any,
) -> None:
    """The stage and, unless it ends otherwise already, the job fail; what waits is dropped."""
    set_stage(session, row, "failed", when, run=run, error=error, **values)
    if job.state == "running":
        set_job(session, job, "failed", when, error={**error, "stage": row.name})
        drop_waiting(session, stages, when, "job_failed")
    settle(session, job, stages, when)
