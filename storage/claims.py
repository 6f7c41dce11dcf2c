"""Choosing a stage and claiming it: one statement, whatever waits.

A claim is the right to run one attempt of a stage. Its token rises with every claim and goes with
every write (`storage.leases`). A stage that is `ready` belongs to a job that is live: whoever ends
a job takes its waiting stages along, so that a claim looks at the stage's row alone.

The next stage is the head of an index on (state, resource, queue_key), so that it is found at one
cost however many wait, and stages for another resource are never looked at. On PostgreSQL rows that
others are just claiming are skipped (SKIP LOCKED); on SQLite writers come one after the other.
Callers commit. `when` is for tests; it defaults to the database's clock.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from typing import Any

from sqlalchemy import ColumnElement, ScalarSelect, literal, or_, select, union_all, update
from sqlalchemy.orm import Session

from storage.db import name_actor, now
from storage.models import Job, StageRow
from storage.queue import RESOURCE_CPU, RESOURCES
from storage.runs import start_run
from storage.states import check_transition
from storage.transitions import record_event, set_job


@dataclass(frozen=True)
class Claim:
    """The right to run one attempt of a stage. `token` goes with every write.

    root: below which its job's bytes lie (`storage.keys`).
    """

    stage_id: str
    job_id: str
    name: str
    owner: str
    token: int
    attempt: int
    resource: str = RESOURCE_CPU
    root: str = ""


def is_due(when: datetime) -> ColumnElement[bool]:
    """Whether a stage that is ready may start."""
    return or_(StageRow.not_before.is_(None), StageRow.not_before <= when)


def _head(resource: str, when: datetime, rank: int) -> Any:
    """(id, rank, queue_key) of the first stage that waits for a resource, locked."""
    first = (
        select(StageRow.id, StageRow.queue_key)
        .where(StageRow.state == "ready", StageRow.resource == resource, is_due(when))
        .order_by(StageRow.queue_key)
        .limit(1)
        .with_for_update(skip_locked=True, key_share=True)
        .subquery()
    )
    return select(first.c.id, literal(rank).label("rank"), first.c.queue_key)


def _choice(groups: Sequence[Sequence[str]], when: datetime) -> ScalarSelect[str]:
    heads = [_head(resource, when, rank) for rank, group in enumerate(groups) for resource in group]
    every = union_all(*heads).subquery()
    return select(every.c.id).order_by(every.c.rank, every.c.queue_key).limit(1).scalar_subquery()


def claim_next(
    session: Session,
    groups: Sequence[Sequence[str]],
    owner: str,
    lease_s: float,
    when: datetime | None = None,
) -> Claim | None:
    """Take the stage that is served next, or None where none waits.

    groups: resources that the caller has. All that waits for one of the first group goes before
    the second; within a group the oldest job goes first, and of that its earliest stage.
    """
    groups = [group for group in groups if group]
    if not groups:
        return None
    when = when or now(session)
    return _claim(session, StageRow.id == _choice(groups, when), owner, lease_s, when)


def claim_stage(
    session: Session,
    stage: str,
    owner: str,
    lease_s: float,
    *,
    resources: Sequence[str] = RESOURCES,
    when: datetime | None = None,
) -> Claim | None:
    """Take a stage that is `ready` and due. None where another was first, or it is not time.

    Waits for who holds the row at the moment.
    """
    mine = (StageRow.id == stage) & StageRow.resource.in_(resources)
    return _claim(session, mine, owner, lease_s, when or now(session))


def _claim(
    session: Session, which: ColumnElement[bool], owner: str, lease_s: float, when: datetime
) -> Claim | None:
    check_transition("stage", "ready", "running")
    name_actor(session, f"worker:{owner}")
    statement = (
        update(StageRow)
        .where(which, StageRow.state == "ready", is_due(when))
        .values(
            state="running",
            lease_token=StageRow.lease_token + 1,
            lease_owner=owner,
            lease_until=when + timedelta(seconds=lease_s),
            heartbeat_at=when,
            progress_at=when,
            attempt=StageRow.attempt + 1,
            not_before=None,
            progress=0.0,
            message="",
            eta_s=None,
            started_at=when,
            finished_at=None,
            error=None,
        )
        .returning(
            StageRow.id,
            StageRow.job_id,
            StageRow.name,
            StageRow.lease_token,
            StageRow.attempt,
            StageRow.resource,
        )
        .execution_options(synchronize_session=False)
    )
    found = session.execute(statement).one_or_none()
    if found is None:
        return None
    stage_id, job_id, name, token, attempt, resource = found
    job = session.get_one(Job, job_id, populate_existing=True, with_for_update={"key_share": True})
    start_run(session, job, stage=name, token=token, attempt=attempt, owner=owner, when=when)
    record_event(session, job, "stage.running", when, name, was="ready", attempt=attempt)
    if job.state == "queued":
        set_job(session, job, "running", when, started_at=when)
    return Claim(stage_id, job_id, name, owner, token, attempt, resource, job.object_root)
