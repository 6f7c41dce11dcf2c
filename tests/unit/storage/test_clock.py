"""A clock that went back by an hour holds up nothing."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

import pytest
from sqlalchemy import select

from storage.claims import Claim, claim_stage
from storage.clock import SLACK, bring_times_back
from storage.db import Database
from storage.errors import IdempotencyRunningError
from storage.idempotency import claim as hold_key
from storage.jobs import stage_id
from storage.leases import fail_stage, heartbeat, reap_expired
from storage.models import StageRow
from storage.queries import ready_unclaimed
from storage.records import has_live_gpu, live_workers, register_worker
from tests.factories import make_job

BEFORE = datetime(2026, 1, 1, 13, tzinfo=UTC)
HOUR = timedelta(hours=1)
ERROR = {"code": "tool_failed", "message": "It broke.", "hint": "Mend it."}


def after(count: float) -> datetime:
    """So many seconds after the clock went back by an hour."""
    return BEFORE - HOUR + timedelta(seconds=count)


def claimed(database: Database) -> Claim:
    with database.session_scope() as session:
        job = make_job(session, when=BEFORE - HOUR)
        found = claim_stage(session, stage_id(job.id, "first"), "w", 60.0, when=BEFORE)
    assert found is not None
    return found


def test_a_lease_of_the_future_runs_out_in_its_time(either_database: Database) -> None:
    held = claimed(either_database)
    with either_database.session_scope() as session:
        assert bring_times_back(session, after(0)) == [held.stage_id]
        assert reap_expired(session, after(59)) == []
        assert reap_expired(session, after(61)) == [held.stage_id]


def test_a_worker_that_lives_keeps_its_lease(either_database: Database) -> None:
    held = claimed(either_database)
    with either_database.session_scope() as session:
        bring_times_back(session, after(0))
        assert not heartbeat(session, held, 60.0, when=after(30)).lost
        assert bring_times_back(session, after(31)) == []
        assert reap_expired(session, after(89)) == []


def test_what_others_write_at_this_moment_is_left_alone(either_database: Database) -> None:
    held = claimed(either_database)
    with either_database.session_scope() as session:
        assert bring_times_back(session, BEFORE - SLACK) == []
        row = session.get_one(StageRow, held.stage_id)
        assert row.lease_until == BEFORE + timedelta(seconds=60)


def test_a_stage_that_waits_is_found_and_served_at_once(either_database: Database) -> None:
    held = claimed(either_database)
    with either_database.session_scope() as session:
        assert fail_stage(session, held, ERROR, retryable=True, when=BEFORE) == "ready"
    with either_database.session_scope() as session:
        assert bring_times_back(session, after(0)) == [held.stage_id]
        (waiting,) = ready_unclaimed(session, when=after(1))
        assert (waiting.id, waiting.since, waiting.rung_at) == (held.stage_id, after(0), None)
        assert claim_stage(session, held.stage_id, "w", 60.0, when=after(1)) is not None


def test_a_worker_that_is_gone_passes_for_alive_no_longer_than_it_would(
    either_database: Database,
) -> None:
    with either_database.session_scope() as session:
        register_worker(
            session,
            "gone",
            hostname="h",
            pid=1,
            boot="b",
            queues=("gpu",),
            slots=1,
            has_gpu=True,
            when=BEFORE,
        )
        bring_times_back(session, after(0))
        session.expire_all()
        assert has_live_gpu(session, after(59))
        assert live_workers(session, after(61)) == []


def test_a_call_whose_caller_is_gone_can_be_sent_again(either_database: Database) -> None:
    hold_key(either_database, "scope", "what", when=BEFORE)
    with either_database.session_scope() as session:
        bring_times_back(session, after(0))
    with pytest.raises(IdempotencyRunningError):
        hold_key(either_database, "scope", "what", when=after(29))
    assert isinstance(hold_key(either_database, "scope", "what", when=after(31)), str)


def test_times_that_only_tell_when_something_was_stay(either_database: Database) -> None:
    held = claimed(either_database)
    with either_database.session_scope() as session:
        bring_times_back(session, after(0))
        started = session.scalar(select(StageRow.started_at).where(StageRow.id == held.stage_id))
    assert started == BEFORE
