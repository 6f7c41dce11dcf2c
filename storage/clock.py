"""A clock that went back, and the times that it left ahead of itself.

A lease of the future would not run out, a worker of the future would pass for alive, a retry would
wait, for as long as the clock went back: a virtual machine that was restored, a wrong time that was
put right. So whoever reaps looks at each step back, and at its own start, for times that are not
yet, and says them anew. A clock that leaps ahead needs nothing of the kind: leases then get the
grace of a machine that slept (`worker.housekeeping.Grace`).

Times that only tell when something was stay as they were noted. Callers commit.
"""

from __future__ import annotations

from datetime import datetime, timedelta

from sqlalchemy import or_, select, update
from sqlalchemy.orm import Session

from storage.idempotency import HOLD_S
from storage.models import IdempotentCall, StageRow, Worker

SLACK = timedelta(seconds=10)
"""Others may have asked the clock a little later than the caller, and written before it read."""


def bring_times_back(session: Session, when: datetime) -> list[str]:
    """Say anew what lies ahead of the clock. Ids of the stages that it concerned.

    when: now. A running stage keeps its lease, as long as it was, from now on: a worker that lives
    extends it in time. A stage that waits to be retried need not wait any more. A worker counts as
    seen now, and a call that is at work as begun now. Stages are locked in the order of
    `storage.transitions.lock_job`.
    """
    edge = when + SLACK
    in_order = (StageRow.job_id, StageRow.seq)
    running = select(StageRow).where(StageRow.state == "running", StageRow.heartbeat_at > edge)
    held = session.scalars(running.order_by(*in_order).with_for_update(key_share=True)).all()
    for row in held:
        if row.lease_until is not None and row.heartbeat_at is not None:
            row.lease_until = when + (row.lease_until - row.heartbeat_at)
            row.heartbeat_at = when
            row.progress_at = min(row.progress_at, when) if row.progress_at else when
    waits = (StageRow.state == "ready") & or_(StageRow.ready_at > edge, StageRow.rung_at > edge)
    waiting = select(StageRow.id).where(waits).order_by(*in_order)
    ids = session.scalars(waiting.with_for_update(key_share=True)).all()
    if ids:
        due = update(StageRow).where(waits).values(ready_at=when, rung_at=None, not_before=None)
        session.execute(due, execution_options={"synchronize_session": False})
    session.execute(update(Worker).where(Worker.seen_at > edge).values(seen_at=when))
    hold = timedelta(seconds=HOLD_S)
    at_work = (IdempotentCall.status.is_(None), IdempotentCall.held_until > edge + hold)
    session.execute(update(IdempotentCall).where(*at_work).values(held_until=when + hold))
    return [*(row.id for row in held), *ids]
