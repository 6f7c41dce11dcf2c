"""A claimed stage's life to its end: every change that a worker makes, as a named operation.

A write under a token that is no longer the stage's raises LostLeaseError, and the caller throws its
work away. An operation that ends a claim may be repeated after a COMMIT whose answer was lost: the
second call finds the end recorded (`storage.runs`), changes nothing and says what the first did.
Callers commit, and ring the bell for the stage ids that an operation returns after the commit.
`when` is for tests; it defaults to the database's clock.

A stage that keeps ending badly fails for good by the cap of the cause: an error that trying again
may help (`fail_stage`, up to the row's max_attempts), or one of `CAPS`. A run that saved a
checkpoint got on, and the counts start anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, cast

from sqlalchemy import ColumnElement, CursorResult, select, update
from sqlalchemy.exc import OperationalError
from sqlalchemy.orm import Session

from storage.claims import Claim
from storage.db import is_locked, name_actor, now
from storage.errors import ConflictError, LostLeaseError, NotFoundError
from storage.models import Job, StageRow, StageRun
from storage.runs import RunEnd, count_checkpoint, count_ends, run_of
from storage.transitions import fail_for_good, lock_job, set_stage, settle

CAPS = {
    "killed": 3,
    "out_of_memory": 2,
    "crashed": 2,
    "stalled": 2,
    "time_limit": 1,
    "lost": 5,
}
"""How often in a row a stage may end so, without getting on between."""

LESS_MEMORY = "less_memory"
"""Why a stage that ran out of memory is tried again: the next attempt takes less."""

BOOT_MARK = "#"
BACKOFF_FIRST_S = 5.0
BACKOFF_FACTOR = 4.0
BACKOFF_MOST_S = 300.0
WORKER_LOST = {
    "code": "worker_lost",
    "message": "The worker that ran this stage stopped without a word, several times.",
    "hint": "Look at the worker's log and the machine's memory; then retry the job.",
}


@dataclass(frozen=True)
class FailureReport:
    """What an attempt published of its own failure. files: `{path, bytes, sha256}` below prefix."""

    prefix: str
    files: list[dict[str, Any]]

    def values(self) -> dict[str, Any]:
        """Columns of the stage's row."""
        return {"report_prefix": self.prefix, "report_files": self.files}


@dataclass(frozen=True)
class HeartbeatReply:
    """lost: the claim is void, stop and discard. cancel_requested: stop, then `cancel_stage`."""

    cancel_requested: bool
    lost: bool


def backoff_s(failures: int) -> float:
    """Seconds to wait before the attempt that follows the given number of failed ones."""
    return min(BACKOFF_FIRST_S * BACKOFF_FACTOR ** max(failures - 1, 0), BACKOFF_MOST_S)


def heartbeat(
    session: Session,
    claim: Claim,
    lease_s: float,
    *,
    progress: float | None = None,
    message: str | None = None,
    eta_s: float | None = None,
    moved: bool = True,
    when: datetime | None = None,
) -> HeartbeatReply:
    """Extend the lease and record progress (where given, with its message and seconds left).

    moved: whether the stage got on, or only the seconds left are new.
    """
    when = when or now(session)
    values: dict[str, Any] = {
        "lease_until": when + timedelta(seconds=lease_s),
        "heartbeat_at": when,
    }
    if progress is not None:
        values |= {"progress": progress, "message": message or "", "eta_s": eta_s}
        values |= {"progress_at": when} if moved else {}
    statement = (
        update(StageRow)
        .where(
            StageRow.id == claim.stage_id,
            StageRow.state == "running",
            StageRow.lease_token == claim.token,
        )
        .values(**values)
        .execution_options(synchronize_session=False)
    )
    if cast("CursorResult[Any]", session.execute(statement)).rowcount != 1:
        return HeartbeatReply(cancel_requested=False, lost=True)
    state = session.scalar(select(Job.state).where(Job.id == claim.job_id))
    return HeartbeatReply(cancel_requested=state != "running", lost=False)


def _locked(session: Session, claim: Claim) -> tuple[Job, list[StageRow], StageRow]:
    """The job, locked, and the stage. Raises LostLeaseError where the job was deleted."""
    name_actor(session, f"worker:{claim.owner}")
    try:
        job, stages = lock_job(session, claim.job_id)
    except NotFoundError as error:
        raise LostLeaseError(f"job {claim.job_id} was deleted") from error
    return job, stages, next(row for row in stages if row.id == claim.stage_id)


def _held(
    session: Session, claim: Claim, outcome: str = ""
) -> tuple[Job, list[StageRow], StageRow, StageRun | None]:
    """The same, where the claim still holds; raises LostLeaseError where it is void.

    The last value is the claim's run where it has ended with this outcome before: an earlier call
    was recorded, and there is nothing left to do.
    """
    job, stages, row = _locked(session, claim)
    if row.state == "running" and row.lease_token == claim.token:
        return job, stages, row, None
    if outcome:
        run = run_of(session, claim.job_id, claim.name, claim.token)
        if run is not None and run.outcome == outcome:
            return job, stages, row, run
    raise LostLeaseError(f"stage {claim.stage_id} is {row.state} under token {row.lease_token}")


def succeed_stage(
    session: Session,
    claim: Claim,
    *,
    manifest: dict[str, Any],
    output_prefix: str,
    peak_bytes: int | None = None,
    when: datetime | None = None,
) -> list[str]:
    """Publish: the stage succeeded, those behind it may start. Ids newly ready."""
    job, stages, row, earlier = _held(session, claim, "succeeded")
    if earlier is not None:
        return [other.id for other in stages if other.state == "ready"]
    when = when or now(session)
    fingerprint = manifest.get("fingerprint")
    set_stage(
        session,
        row,
        "succeeded",
        when,
        run=RunEnd(
            "succeeded",
            peak_bytes=peak_bytes,
            output_prefix=output_prefix,
            fingerprint=fingerprint,
        ),
        manifest=manifest,
        summary=manifest.get("summary"),
        output_prefix=output_prefix,
        fingerprint=fingerprint,
        checkpoint_prefix=None,
        progress=1.0,
        progress_at=when,
    )
    return settle(session, job, stages, when)


def save_checkpoint(session: Session, claim: Claim, prefix: str) -> str | None:
    """Make an uploaded checkpoint the stage's latest. Returns the one it replaces, to delete."""
    _, _, row, _ = _held(session, claim)
    old = row.checkpoint_prefix
    if old == prefix:
        return None
    row.checkpoint_prefix = prefix
    count_checkpoint(session, row)
    return old


def fail_stage(
    session: Session,
    claim: Claim,
    error: dict[str, Any],
    *,
    retryable: bool,
    report: FailureReport | None = None,
    peak_bytes: int | None = None,
    when: datetime | None = None,
) -> str:
    """An attempt ended with an error: try again later if that can help, else fail the job.

    error: `{code, message, hint, ...}`. report: kept where the job fails. Returns the stage's new
    state.
    """
    job, stages, row, earlier = _held(session, claim, "error")
    if earlier is not None:
        return str(earlier.led_to)
    when = when or now(session)
    run = RunEnd("error", error, peak_bytes=peak_bytes)
    failures = count_ends(session, row, "error")
    if retryable and failures < row.max_attempts and job.state == "running":
        later = when + timedelta(seconds=backoff_s(failures))
        set_stage(session, row, "ready", when, run=run, not_before=later, error=error)
        return "ready"
    values = report.values() if report else {}
    fail_for_good(session, job, stages, row, error, when, run=run, **values)
    return "failed"


def _lose(
    session: Session,
    job: Job,
    stages: list[StageRow],
    row: StageRow,
    run: RunEnd,
    when: datetime,
    report: FailureReport | None = None,
    reason: str = "",
) -> str:
    error = run.error or {}
    count = count_ends(session, row, run.outcome)
    if job.state != "running":
        reason = reason or f"job_{job.state}"
        set_stage(session, row, "cancelled", when, run=run, reason=reason)
        settle(session, job, stages, when)
        return "cancelled"
    if count >= CAPS[run.outcome]:
        values = report.values() if report else {}
        fail_for_good(session, job, stages, row, error, when, run=run, **values)
        return "failed"
    reason = reason or (LESS_MEMORY if run.outcome == "out_of_memory" else "")
    later = when + timedelta(seconds=backoff_s(count - 1)) if count > 1 else None
    set_stage(session, row, "ready", when, run=run, reason=reason, not_before=later, error=error)
    return "ready"


def crash_stage(
    session: Session,
    claim: Claim,
    run: RunEnd,
    *,
    report: FailureReport | None = None,
    when: datetime | None = None,
) -> str:
    """The stage's process died, or was ended, under the claim. The new state.

    run: how, with its error; the outcome is one of `CAPS`. The first retry is at once. report: kept
    where the job fails.
    """
    job, stages, row, earlier = _held(session, claim, run.outcome)
    if earlier is not None:
        return str(earlier.led_to)
    return _lose(session, job, stages, row, run, when or now(session), report)


def release_stage(
    session: Session,
    claim: Claim,
    when: datetime | None = None,
    *,
    error: dict[str, Any] | None = None,
) -> str:
    """Give a stage back unharmed: the attempt does not count.

    error: what the worker lacks; without one it shuts down.
    """
    job, stages, row, earlier = _held(session, claim, "released")
    if earlier is not None:
        return str(earlier.led_to)
    when, run = when or now(session), RunEnd("released", error)
    if job.state != "running":
        set_stage(session, row, "cancelled", when, run=run, reason=f"job_{job.state}")
        settle(session, job, stages, when)
        return "cancelled"
    attempt = row.attempt - 1
    reason = str(error["code"]) if error else "shutdown"
    set_stage(session, row, "ready", when, run=run, reason=reason, attempt=attempt)
    return "ready"


def cancel_stage(session: Session, claim: Claim, when: datetime | None = None) -> str:
    """The claimed stage was stopped because its job was cancelled, or failed elsewhere.

    Raises ConflictError where neither is so: a job without this stage would never end.
    """
    job, stages, row, earlier = _held(session, claim, "cancelled")
    if earlier is None:
        if job.state == "running":
            raise ConflictError(f"Job {job.id} goes on: its stages are not to be cancelled.")
        when = when or now(session)
        reason = f"job_{job.state}"
        set_stage(session, row, "cancelled", when, run=RunEnd("cancelled"), reason=reason)
        settle(session, job, stages, when)
    return "cancelled"


def _lock_if_free(session: Session, job_id: str) -> tuple[Job, list[StageRow]] | None:
    """`lock_job`; None where another holds one of the rows, or deleted the job meanwhile."""
    try:
        with session.begin_nested():
            return lock_job(session, job_id, nowait=True)
    except NotFoundError:
        return None
    except OperationalError as error:
        if not is_locked(error):
            raise
        return None


def _lose_all(
    session: Session, lost: ColumnElement[bool], when: datetime, reason: str, *, wait: bool
) -> list[str]:
    """Lose the leases that a condition finds, job by job in one order. Ids that are ready again.

    What was found is looked at again under the job's lock: a heartbeat may have come between.
    wait: for who has a job locked; else it is passed over.
    """
    running = (StageRow.state == "running") & lost
    job_ids = session.scalars(select(StageRow.job_id).where(running).distinct())
    ready = []
    for job_id in sorted(job_ids):
        locked = lock_job(session, job_id) if wait else _lock_if_free(session, job_id)
        if locked is None:
            continue
        job, stages = locked
        still = set(session.scalars(select(StageRow.id).where(running, StageRow.job_id == job_id)))
        for row in stages:
            if row.id in still:
                run = RunEnd("lost", WORKER_LOST)
                state = _lose(session, job, stages, row, run, when, reason=reason)
                ready += [row.id] if state == "ready" else []
    return ready


def reap_expired(session: Session, when: datetime | None = None) -> list[str]:
    """Take back the stages whose leases ran out. Ids that are ready again.

    Jobs that another has locked wait for the next round. Mostly that is a heartbeat; but a process
    that was frozen, or cut off, within a transaction holds its rows until the database ends that
    (`storage.postgres`), and must not keep all other leases from being taken back.
    """
    when = when or now(session)
    expired = StageRow.lease_until < when
    return _lose_all(session, expired, when, reason="lease_expired", wait=False)


def owner_name(worker_id: str, boot: str) -> str:
    """Who holds a lease: a worker's id, and which of the processes that ever bore it."""
    return f"{worker_id}{BOOT_MARK}{boot}"


def release_worker(session: Session, worker_id: str, when: datetime | None = None) -> list[str]:
    """Free what a worker's former selves held: for one that starts again under its old id."""
    owner = StageRow.lease_owner
    mine = (owner == worker_id) | owner.startswith(worker_id + BOOT_MARK, autoescape=True)
    return _lose_all(session, mine, when or now(session), reason="worker_restarted", wait=True)
