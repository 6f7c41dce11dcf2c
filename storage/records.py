"""Captures, workers and log lines: records without a state machine."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import delete, func, insert, select, text
from sqlalchemy.orm import Session

from storage.blobs import drop_blob, take_blob
from storage.claims import Claim
from storage.db import clean_text, now
from storage.errors import ConflictError, NotFoundError
from storage.models import Capture, Job, LogLine, StageRow, Worker
from storage.states import JOB_LIVE
from storage.tenants import DEFAULT_TENANT

WORKER_LIVE_S = 60.0
WORKER_KEPT = timedelta(days=1)
MAX_LOG_LINES = 20_000
"""Of one attempt."""
MAX_STAGE_LOG_LINES = 60_000
"""Of all attempts of a stage, but for MIN_LOG_LINES that each may write in any case."""
MIN_LOG_LINES = 1_000
MAX_LINE_CHARS = 2_000


@dataclass(frozen=True)
class LogPage:
    """Lines of a job. first: the number of the first one, from 0. total: lines there are."""

    lines: list[str]
    first: int
    total: int


def create_capture(
    session: Session,
    *,
    capture_id: str,
    filename: str,
    kind: str,
    num_bytes: int,
    sha256: str,
    brought: str | None,
    details: dict[str, Any],
    tenant_id: str = DEFAULT_TENANT,
    when: datetime | None = None,
) -> Capture:
    """Record an upload whose bytes are in the object store already.

    brought: the key under which the caller has put them, or None where it relies on what is there
    (`storage.blobs.take_blob`; raises BlobMissingError). The capture's `object_key` says which of
    the two count: where it is not `brought`, the caller deletes that.
    """
    when = when or now(session)
    blob_id, object_key = take_blob(session, tenant_id, sha256, brought, when)
    capture = Capture(
        id=capture_id,
        tenant_id=tenant_id,
        blob_id=blob_id,
        filename=filename,
        kind=kind,
        bytes=num_bytes,
        sha256=sha256,
        object_key=object_key,
        details=details,
        created_at=when,
    )
    session.add(capture)
    session.flush()
    return capture


def get_capture(session: Session, capture_id: str) -> Capture:
    """A capture that was not deleted. Raises NotFoundError."""
    capture = session.get(Capture, capture_id)
    if capture is None or capture.deleted_at is not None:
        raise NotFoundError("capture", capture_id)
    return capture


def delete_capture(session: Session, capture_id: str, when: datetime | None = None) -> None:
    """Delete a capture, and its bytes where no other capture has them (`storage.blobs`).

    Finished jobs keep their results, and exports of them need no capture. Raises ConflictError
    while a job on it is not over.
    """
    capture = session.get(Capture, capture_id, with_for_update=True, populate_existing=True)
    if capture is None or capture.deleted_at is not None:
        raise NotFoundError("capture", capture_id)
    live = select(func.count()).select_from(Job)
    live = live.where(
        Job.capture_id == capture_id, Job.state.in_(JOB_LIVE), Job.parent_id.is_(None)
    )
    if session.scalars(live).one():
        raise ConflictError(f"A job is running on capture {capture_id}; cancel it first.")
    when = when or now(session)
    blob_id, capture.blob_id, capture.deleted_at = capture.blob_id, None, when
    session.flush()
    if blob_id is not None:
        drop_blob(session, blob_id, when)


def register_worker(
    session: Session,
    worker_id: str,
    *,
    hostname: str,
    pid: int,
    boot: str,
    queues: Sequence[str],
    slots: int,
    has_gpu: bool,
    contained: dict[str, list[str]] | None = None,
    take_over: bool = False,
    when: datetime | None = None,
) -> bool:
    """Record, or refresh, what a worker has.

    False where another process goes by this id (another boot), which changes nothing; take_over
    puts this one in its place.
    """
    when = when or now(session)
    row = session.get(Worker, worker_id, with_for_update=True, populate_existing=True)
    if row is not None and row.boot != boot:
        if not take_over:
            return False
        session.delete(row)
        session.flush()
        row = None
    if row is None:
        row = Worker(id=worker_id, started_at=when, boot=boot)
        session.add(row)
    row.hostname, row.pid, row.queues = hostname, pid, list(queues)
    row.slots, row.has_gpu, row.contained, row.seen_at = slots, has_gpu, contained, when
    return True


def worker_seen_lately(
    session: Session, worker_id: str, when: datetime | None = None
) -> Worker | None:
    """The worker that goes by this id and was seen within the last minute, its row locked."""
    row = session.get(Worker, worker_id, with_for_update=True, populate_existing=True)
    edge = (when or now(session)) - timedelta(seconds=WORKER_LIVE_S)
    return row if row is not None and row.seen_at >= edge else None


def forget_worker(session: Session, worker_id: str, boot: str) -> None:
    """A worker ends in order."""
    session.execute(delete(Worker).where(Worker.id == worker_id, Worker.boot == boot))


def forget_lost_workers(session: Session, when: datetime | None = None) -> None:
    """Drop the rows of workers that ended without a word, so long ago that nobody asks for them."""
    edge = (when or now(session)) - WORKER_KEPT
    session.execute(delete(Worker).where(Worker.seen_at < edge))


def live_workers(session: Session, when: datetime | None = None) -> list[Worker]:
    """The workers that were seen within the last minute."""
    edge = (when or now(session)) - timedelta(seconds=WORKER_LIVE_S)
    return list(session.scalars(select(Worker).where(Worker.seen_at >= edge).order_by(Worker.id)))


def has_live_gpu(session: Session, when: datetime | None = None) -> bool:
    """Whether a live worker has a GPU and serves the queue `gpu`."""
    return any(worker.has_gpu and "gpu" in worker.queues for worker in live_workers(session, when))


def _take_turn(session: Session, job_id: str) -> None:
    """Wait until who adds to the same job's log has committed, so that ids follow one another as
    the lines appear: readers count on it.

    A lock of its own, which keeps nobody from claiming or ending a stage; a session that writes
    holds all of SQLite as it is.
    """
    if session.get_bind().dialect.name == "postgresql":
        digest = hashlib.blake2b(f"log:{job_id}".encode(), digest_size=8).digest()
        key = int.from_bytes(digest, signed=True)
        session.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": key})


def _log_room(session: Session, claim: Claim, began_at: datetime | None) -> tuple[int, int]:
    """How many lines a claim may write in all, and how many it still may.

    began_at: None where the stage waits for its next claim.
    """
    written = select(func.count()).select_from(LogLine)
    written = written.where(LogLine.job_id == claim.job_id, LogLine.stage == claim.name)
    of_stage = of_claim = session.scalars(written).one()
    if began_at is not None and of_stage:
        of_claim = session.scalars(written.where(LogLine.created_at >= began_at)).one()
    left = max(MAX_STAGE_LOG_LINES - (of_stage - of_claim), MIN_LOG_LINES)
    allowed = min(left, MAX_LOG_LINES)
    return allowed, max(allowed - of_claim, 0)


def append_logs(
    session: Session, claim: Claim, lines: Sequence[str], when: datetime | None = None
) -> int:
    """Add lines that a stage wrote, up to MAX_LOG_LINES an attempt. Returns how many were kept.

    None of a claim that another one has replaced, or whose job was deleted. Until the lines are
    committed nobody deletes the job, or adds others to its log.
    """
    _take_turn(session, claim.job_id)
    query = select(StageRow.lease_token, StageRow.tenant_id, StageRow.started_at)
    query = query.where(StageRow.id == claim.stage_id)
    row = session.execute(query.with_for_update(read=True, key_share=True)).one_or_none()
    if row is None or row.lease_token > claim.token:
        return 0
    allowed, room = _log_room(session, claim, row.started_at)
    kept = [clean_text(line, MAX_LINE_CHARS) for line in lines[:room]]
    if kept and len(kept) == room:
        kept[-1] = f"[the log ends here: {allowed} lines are kept of this attempt]"
    if kept:
        moment = when or now(session)
        common = {
            "tenant_id": row.tenant_id,
            "job_id": claim.job_id,
            "stage": claim.name,
            "attempt": claim.attempt,
            "created_at": moment,
        }
        session.execute(insert(LogLine), [{**common, "text": text} for text in kept])
    return len(kept)


def read_logs(
    session: Session, job_id: str, *, stage: str | None = None, line: int = 0, limit: int = 1000
) -> LogPage:
    """Lines from number `line` on, of one stage or all; a negative `line` counts from the end.

    A line keeps its number: later ones are added behind it.
    """
    conditions = [LogLine.job_id == job_id]
    if stage is not None:
        conditions.append(LogLine.stage == stage)
    total = session.scalars(select(func.count()).select_from(LogLine).where(*conditions)).one()
    first = max(total + line, 0) if line < 0 else min(line, total)
    query = select(LogLine.text).where(*conditions).order_by(LogLine.id)
    lines = list(session.scalars(query.offset(first).limit(limit)))
    return LogPage(lines, first, total)
