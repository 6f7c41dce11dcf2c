"""A stage's life from claim to end: every change that a worker makes, as a named operation.

A claim is the right to run one attempt. Its token rises with every claim and goes with every write:
a write under another token raises LostLeaseError, and the caller throws its work away. Callers
commit, and ring the bell for the stage ids that an operation returns after the commit. `when` is
for tests; it defaults to the database's clock.

Two counts end a stage that keeps failing: errors (`fail_stage`, up to the row's max_attempts) and
crashes, where the process or its worker died (`crash_stage`, `reap_expired`, `release_worker`).
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any, cast

from sqlalchemy import CursorResult, select, update
from sqlalchemy.orm import Session

from storage.db import now
from storage.errors import LostLeaseError, NotFoundError
from storage.models import Job, StageRow
from storage.transitions import fail_for_good, lock_job, set_job, set_stage, settle

MAX_CRASHES = 3
BACKOFF_FIRST_S = 5.0
BACKOFF_FACTOR = 4.0
BACKOFF_MOST_S = 300.0
WORKER_LOST = {
    "code": "worker_lost",
    "message": "The worker that ran this stage stopped without a word, several times.",
    "hint": "Look at the worker's log and the machine's memory; then submit the job again.",
}


@dataclass(frozen=True)
class Claim:
    """The right to run one attempt of a stage. `token` goes with every write."""

    stage_id: str
    job_id: str
    name: str
    owner: str
    token: int
    attempt: int


@dataclass(frozen=True)
class FailureReport:
    """What an attempt published of its own failure. files: `{path, bytes, sha256}` below prefix."""

    prefix: str
    files: list[dict[str, Any]]

    def values(self) -> dict[str, Any]:
        """Columns of the stage's row."""
        return {"output_prefix": self.prefix, "manifest": {"files": self.files}}


@dataclass(frozen=True)
class HeartbeatReply:
    """lost: the claim is void, stop and discard. cancel_requested: stop, then `cancel_stage`."""

    cancel_requested: bool
    lost: bool


def backoff_s(failures: int) -> float:
    """Seconds to wait before the attempt that follows the given number of failed ones."""
    return min(BACKOFF_FIRST_S * BACKOFF_FACTOR ** max(failures - 1, 0), BACKOFF_MOST_S)


def claim_stage(
    session: Session, stage: str, owner: str, lease_s: float, when: datetime | None = None
) -> Claim | None:
    """Take a stage that is `ready` and due. None where another was first, or it is not time."""
    job_id = session.scalar(select(StageRow.job_id).where(StageRow.id == stage))
    if job_id is None:
        return None
    job, stages = lock_job(session, job_id)
    when = when or now(session)
    row = next(row for row in stages if row.id == stage)
    due = row.not_before is None or row.not_before <= when
    if row.state != "ready" or not due or job.state not in ("queued", "running"):
        return None
    token, attempt = row.lease_token + 1, row.attempt + 1
    set_stage(
        session,
        row,
        "running",
        when,
        lease_token=token,
        lease_owner=owner,
        lease_until=when + timedelta(seconds=lease_s),
        heartbeat_at=when,
        attempt=attempt,
        not_before=None,
        progress=0.0,
        message="",
        eta_s=None,
        started_at=when,
        finished_at=None,
        error=None,
    )
    if job.state == "queued":
        set_job(session, job, "running", when, started_at=when)
    return Claim(row.id, job_id, row.name, owner, token, attempt)


def heartbeat(
    session: Session,
    claim: Claim,
    lease_s: float,
    *,
    progress: float | None = None,
    message: str | None = None,
    eta_s: float | None = None,
    when: datetime | None = None,
) -> HeartbeatReply:
    """Extend the lease and record progress (where given, with its message and seconds left)."""
    when = when or now(session)
    values: dict[str, Any] = {
        "lease_until": when + timedelta(seconds=lease_s),
        "heartbeat_at": when,
    }
    if progress is not None:
        values |= {"progress": progress, "message": message or "", "eta_s": eta_s}
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
    try:
        job, stages = lock_job(session, claim.job_id)
    except NotFoundError as error:
        raise LostLeaseError(f"job {claim.job_id} was deleted") from error
    return job, stages, next(row for row in stages if row.id == claim.stage_id)


def _held(session: Session, claim: Claim) -> tuple[Job, list[StageRow], StageRow]:
    """The same, where the claim still holds; raises LostLeaseError where it is void."""
    job, stages, row = _locked(session, claim)
    if row.state != "running" or row.lease_token != claim.token:
        raise LostLeaseError(f"stage {claim.stage_id} is {row.state} under token {row.lease_token}")
    return job, stages, row


def succeed_stage(
    session: Session,
    claim: Claim,
    *,
    manifest: dict[str, Any],
    output_prefix: str,
    when: datetime | None = None,
) -> list[str]:
    """Publish: the stage succeeded, those behind it may start. Ids newly ready.

    Safe to repeat after a commit whose outcome is unknown: the second call changes nothing.
    """
    _, stages, row = _locked(session, claim)
    if row.state == "succeeded" and row.lease_token == claim.token:
        return [other.id for other in stages if other.state == "ready"]
    job, stages, row = _held(session, claim)
    when = when or now(session)
    set_stage(
        session,
        row,
        "succeeded",
        when,
        manifest=manifest,
        summary=manifest.get("summary"),
        output_prefix=output_prefix,
        checkpoint_prefix=None,
        progress=1.0,
    )
    return settle(session, job, stages, when)


def save_checkpoint(session: Session, claim: Claim, prefix: str) -> str | None:
    """Make an uploaded checkpoint the stage's latest. Returns the one it replaces, to delete."""
    _, _, row = _held(session, claim)
    old = row.checkpoint_prefix
    row.checkpoint_prefix = prefix
    return old


def fail_stage(
    session: Session,
    claim: Claim,
    error: dict[str, Any],
    *,
    retryable: bool,
    report: FailureReport | None = None,
    when: datetime | None = None,
) -> str:
    """An attempt ended with an error: try again later if that can help, else fail the job.

    error: `{code, message, hint, ...}`. report: kept where the job fails. Returns the stage's new
    state.
    """
    job, stages, row = _held(session, claim)
    when = when or now(session)
    failures = row.attempt - row.crashes
    if retryable and failures < row.max_attempts and job.state == "running":
        later = when + timedelta(seconds=backoff_s(failures))
        set_stage(session, row, "ready", when, not_before=later, error=error)
        return "ready"
    fail_for_good(session, job, stages, row, error, when, **(report.values() if report else {}))
    return "failed"


def _lose(
    session: Session,
    job: Job,
    stages: list[StageRow],
    row: StageRow,
    error: dict[str, Any],
    max_crashes: int,
    when: datetime,
    report: FailureReport | None = None,
) -> str:
    crashes = row.crashes + 1
    if job.state != "running":
        set_stage(session, row, "cancelled", when, crashes=crashes)
        settle(session, job, stages, when)
        return "cancelled"
    if crashes >= max_crashes:
        values = report.values() if report else {}
        fail_for_good(session, job, stages, row, error, when, crashes=crashes, **values)
        return "failed"
    later = when + timedelta(seconds=backoff_s(crashes - 1)) if crashes > 1 else None
    set_stage(session, row, "ready", when, crashes=crashes, not_before=later, error=error)
    return "ready"


def crash_stage(
    session: Session,
    claim: Claim,
    error: dict[str, Any],
    *,
    max_crashes: int = MAX_CRASHES,
    report: FailureReport | None = None,
    when: datetime | None = None,
) -> str:
    """The stage's process died under the claim. The first retry is at once. The new state.

    report: kept where the job fails.
    """
    job, stages, row = _held(session, claim)
    return _lose(session, job, stages, row, error, max_crashes, when or now(session), report)


def release_stage(session: Session, claim: Claim, when: datetime | None = None) -> str:
    """Give a stage back unharmed (the worker shuts down): the attempt does not count."""
    job, stages, row = _held(session, claim)
    when = when or now(session)
    if job.state != "running":
        set_stage(session, row, "cancelled", when)
        settle(session, job, stages, when)
        return "cancelled"
    set_stage(session, row, "ready", when, attempt=row.attempt - 1)
    return "ready"


def cancel_stage(session: Session, claim: Claim, when: datetime | None = None) -> None:
    """The claimed stage was stopped because its job was cancelled, or failed elsewhere."""
    job, stages, row = _held(session, claim)
    when = when or now(session)
    set_stage(session, row, "cancelled", when)
    settle(session, job, stages, when)


def _lose_all(session: Session, owner: str | None, when: datetime) -> list[str]:
    """Lose the leases that ran out, or all of one owner, job by job in one order. Ids now ready."""
    lost = StageRow.lease_until < when if owner is None else StageRow.lease_owner == owner
    job_ids = session.scalars(
        select(StageRow.job_id).where(StageRow.state == "running", lost).distinct()
    )
    ready = []
    for job_id in sorted(job_ids):
        job, stages = lock_job(session, job_id)
        for row in stages:
            if row.state != "running" or row.lease_until is None:
                continue
            if row.lease_until >= when if owner is None else row.lease_owner != owner:
                continue
            if _lose(session, job, stages, row, WORKER_LOST, MAX_CRASHES, when) == "ready":
                ready.append(row.id)
    return ready


def reap_expired(session: Session, when: datetime | None = None) -> list[str]:
    """Take back the stages whose leases ran out. Ids that are ready again."""
    return _lose_all(session, None, when or now(session))


def release_worker(session: Session, owner: str, when: datetime | None = None) -> list[str]:
    """Free what a worker's former self held: for a worker that starts again under its old id."""
    return _lose_all(session, owner, when or now(session))
