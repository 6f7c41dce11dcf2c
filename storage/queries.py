"""Reading: jobs by page, queue positions, what a claimed stage needs, what waits for a worker."""

from __future__ import annotations

import base64
import binascii
import json
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from typing import Any, TypeVar

from sqlalchemy import Select, and_, func, or_, select, tuple_
from sqlalchemy.orm import Session, joinedload, selectinload, undefer

from storage.claims import Claim, is_due
from storage.db import now
from storage.errors import InvalidCursorError, NotFoundError
from storage.models import Capture, Event, Job, StageRow, is_id
from storage.queue import RESOURCES
from storage.results import fitting
from storage.runs import has_ended
from storage.states import JOB_STATES
from storage.tenants import OF_ALL

MAX_PAGE = 200
QUEUE_COUNTED = 300
Record = TypeVar("Record", Job, Capture)


@dataclass(frozen=True)
class StageInput:
    """A published folder that a stage may read."""

    name: str
    prefix: str
    manifest: dict[str, Any]


@dataclass(frozen=True)
class StageWork:
    """All that running a claimed stage takes.

    inputs: the published stages that go together, by name; of an export those of its job.
    ran_out_of_memory: whether an earlier attempt did.
    """

    capture_key: str
    capture_bytes: int
    capture_sha256: str
    filename: str
    kind: str
    seed: int
    options: dict[str, Any]
    inputs: dict[str, StageInput]
    checkpoint_prefix: str | None
    is_export: bool = False
    ran_out_of_memory: bool = False


@dataclass(frozen=True)
class WaitingStage:
    """A stage that could run now. since: from when on."""

    id: str
    resource: str
    since: datetime
    rung_at: datetime | None


def encode_cursor(created_at: datetime, record_id: str) -> str:
    """An opaque place in a newest-first list."""
    raw = json.dumps([created_at.isoformat(), record_id]).encode()
    return base64.urlsafe_b64encode(raw).decode().rstrip("=")


def decode_cursor(cursor: str) -> tuple[datetime, str]:
    """The inverse. Raises InvalidCursorError."""
    try:
        raw = base64.urlsafe_b64decode(cursor + "=" * (-len(cursor) % 4))
        created_at, record_id = json.loads(raw)
        moment = datetime.fromisoformat(created_at)
        if moment.tzinfo is None or not is_id(record_id):
            raise ValueError("a cursor holds an aware time and an id")
        moment = moment.astimezone(UTC)
    except (ValueError, TypeError, OverflowError, RecursionError, binascii.Error) as error:
        raise InvalidCursorError("The cursor is not one that this service gave out.") from error
    return moment, record_id


def _page(
    session: Session,
    query: Select[Record],
    model: type[Record],
    limit: int,
    cursor: str | None,
) -> tuple[list[Record], str | None]:
    limit = min(max(limit, 1), MAX_PAGE)
    if cursor:
        query = query.where(tuple_(model.created_at, model.id) < tuple_(*decode_cursor(cursor)))
    query = query.order_by(model.created_at.desc(), model.id.desc()).limit(limit + 1)
    found = list(session.scalars(query))
    if len(found) <= limit:
        return found, None
    return found[:limit], encode_cursor(found[limit - 1].created_at, found[limit - 1].id)


def list_jobs(
    session: Session,
    *,
    state: str | None = None,
    label: str | None = None,
    limit: int = 50,
    cursor: str | None = None,
    exports_of: str | None = None,
) -> tuple[list[Job], str | None]:
    """A page of jobs with their stages, newest first, and the next page's cursor (None: the last).

    label: "key" (has it) or "key=value". exports_of: a job, whose exports are listed; else none
    are. Raises InvalidCursorError; ValueError for no such state.
    """
    query = select(Job).options(selectinload(Job.stages)).where(Job.parent_id == exports_of)
    if state is not None:
        if state not in JOB_STATES:
            raise ValueError(f"no job state is called {state}; there are {', '.join(JOB_STATES)}")
        query = query.where(Job.state == state)
    if label is not None:
        key, equals, value = label.partition("=")
        held = Job.labels[key].as_string()
        query = query.where(held == value if equals else held.is_not(None))
    return _page(session, query, Job, limit, cursor)


def list_captures(
    session: Session, *, limit: int = 50, cursor: str | None = None
) -> tuple[list[Capture], str | None]:
    """A page of captures that were not deleted, newest first, and the next page's cursor."""
    query = select(Capture).where(Capture.deleted_at.is_(None))
    return _page(session, query, Capture, limit, cursor)


def get_job(session: Session, job_id: str, *, manifests: bool = False) -> Job:
    """A job with its stages (and their manifests where asked). Raises NotFoundError."""
    stages = selectinload(Job.stages)
    if manifests:
        stages = stages.options(undefer(StageRow.manifest))
    job = session.scalar(select(Job).where(Job.id == job_id).options(stages))
    if job is None:
        raise NotFoundError("job", job_id)
    return job


def queue_position(session: Session, job: Job) -> int | None:
    """1 for the job that is served next, and so on; None for a job that is not queued.

    All tenants wait in one queue. Counted up to QUEUE_COUNTED, which means so many or more: an
    answer costs the same in any queue.
    """
    if job.state != "queued":
        return None
    before = tuple_(Job.created_at, Job.id) < tuple_(job.created_at, job.id)
    earlier = select(Job.id).where(Job.state == "queued", before).limit(QUEUE_COUNTED - 1)
    counted = select(func.count()).select_from(earlier.subquery())
    return session.scalars(counted, execution_options=OF_ALL).one() + 1


def list_events(session: Session, job_id: str, after_seq: int = 0, limit: int = 500) -> list[Event]:
    """The job's events after a sequence number, oldest first."""
    query = select(Event).where(Event.job_id == job_id, Event.seq > after_seq)
    return list(session.scalars(query.order_by(Event.seq).limit(limit)))


def stage_work(session: Session, claim: Claim) -> StageWork:
    """What a claimed stage needs. Raises NotFoundError where its job was deleted."""
    query = select(Job).where(Job.id == claim.job_id)
    query = query.options(
        joinedload(Job.capture),
        selectinload(Job.stages).undefer(StageRow.manifest),
        joinedload(Job.parent).selectinload(Job.stages).undefer(StageRow.manifest),
    )
    job = session.scalar(query)
    if job is None:
        raise NotFoundError("job", claim.job_id)
    own = next(row for row in job.stages if row.id == claim.stage_id)
    made = job.stages if job.parent is None else job.parent.stages
    return StageWork(
        capture_key=job.capture.object_key,
        capture_bytes=job.capture.bytes,
        capture_sha256=job.capture.sha256,
        filename=job.capture.filename,
        kind=job.capture.kind,
        seed=job.seed,
        options=job.options.get(claim.name, {}),
        inputs={
            row.name: StageInput(row.name, row.output_prefix, row.manifest)
            for row in fitting(made).values()
            if row.output_prefix and row.manifest
        },
        checkpoint_prefix=own.checkpoint_prefix,
        is_export=job.parent is not None,
        ran_out_of_memory=has_ended(
            session, claim.job_id, claim.name, claim.token, "out_of_memory"
        ),
    )


def is_cancel_requested(session: Session, claim: Claim) -> bool:
    """Whether the claimed stage should stop, or is not this claim's any more. Reads only."""
    query = select(Job.state, StageRow.state, StageRow.lease_token)
    query = query.join(StageRow, StageRow.job_id == Job.id).where(StageRow.id == claim.stage_id)
    found = session.execute(query).one_or_none()
    return found is None or tuple(found) != ("running", "running", claim.token)


def ready_unclaimed(
    session: Session,
    older_than_s: float = 0.0,
    when: datetime | None = None,
    limit: int = 100,
    resources: Sequence[str] = RESOURCES,
) -> list[WaitingStage]:
    """Stages that could run since at least so many seconds, in the order of service.

    limit: of each resource, so that a queue for one hides none for the other.
    """
    when = when or now(session)
    edge = when - timedelta(seconds=older_than_s)
    found: list[StageRow] = []
    for resource in resources:
        query = (
            select(StageRow)
            .where(
                StageRow.state == "ready",
                StageRow.resource == resource,
                StageRow.ready_at <= edge,
                is_due(edge),
            )
            .order_by(StageRow.queue_key)
            .limit(limit)
        )
        found += session.scalars(query)
    return [
        WaitingStage(
            row.id,
            row.resource,
            max(moment for moment in (row.ready_at, row.not_before) if moment is not None),
            row.rung_at,
        )
        for row in sorted(found, key=lambda row: row.queue_key)
    ]


def finished_jobs(session: Session, job_ids: list[str]) -> set[str]:
    """Of these ids, those of no job, or of a job that is over with no stage still running."""
    live = select(Job.id).where(
        Job.id.in_(job_ids),
        or_(
            Job.state.in_(("queued", "running", "cancelling")),
            Job.stages.any(and_(StageRow.state == "running")),
        ),
    )
    return set(job_ids) - set(session.scalars(live))
