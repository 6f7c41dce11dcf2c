"""Choosing and claiming at once: the order of service, who may take what, on both databases."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from typing import Any

import pytest
from sqlalchemy import event

from storage.claims import claim_next, claim_stage
from storage.db import Database
from storage.errors import LostLeaseError
from storage.jobs import StageSeed, request_cancel, stage_id
from storage.leases import (
    crash_stage,
    fail_stage,
    heartbeat,
    reap_expired,
    release_stage,
    succeed_stage,
)
from storage.models import StageRow
from storage.queries import ready_unclaimed
from storage.queue import RESOURCES
from storage.runs import RunEnd
from storage.transitions import lock_job, set_stage
from tests.factories import DIAMOND, make_capture, make_job, states

T0 = datetime(2026, 1, 1, tzinfo=UTC)
CPU = (StageSeed("first", ()),)
GPU = (StageSeed("first", (), needs_gpu=True),)
ANY = [list(RESOURCES)]
ERROR = {"code": "tool_failed", "message": "It broke.", "hint": "Mend it."}


def seconds(count: float) -> datetime:
    return T0 + timedelta(seconds=count)


def jobs(database: Database, *plans: tuple[StageSeed, ...]) -> list[str]:
    """Jobs with these stages, each made a second after the one before it."""
    with database.session_scope() as session:
        capture = make_capture(session, when=T0)
        return [
            make_job(session, plan, capture=capture, when=seconds(number)).id
            for number, plan in enumerate(plans)
        ]


def take(database: Database, groups: list[list[str]], at: float = 100.0) -> str | None:
    """The id of the stage that is served next, claimed."""
    with database.session_scope() as session:
        claim = claim_next(session, groups, "w", 60.0, when=seconds(at))
    return None if claim is None else claim.stage_id


def test_the_oldest_job_is_served_first_whatever_it_needs(either_database: Database) -> None:
    made = jobs(either_database, CPU, GPU, CPU)
    served = [take(either_database, ANY) for _ in range(4)]
    assert served == [*(stage_id(job, "first") for job in made), None]
    with either_database.read_scope() as session:
        assert states(session, made[0]) == {"first": "running", "job": "running"}


def test_a_gpu_serves_what_needs_it_first(either_database: Database) -> None:
    cpu, gpu = jobs(either_database, CPU, GPU)
    groups = [["gpu"], ["cpu"]]
    assert [take(either_database, groups) for _ in range(3)] == [
        stage_id(gpu, "first"),
        stage_id(cpu, "first"),
        None,
    ]


def test_a_hundred_waiting_gpu_stages_hide_no_cpu_stage(either_database: Database) -> None:
    *gpu, cpu = jobs(either_database, *[GPU] * 110, CPU)
    with either_database.read_scope() as session:
        found = ready_unclaimed(session, when=seconds(500), resources=["cpu"])
        assert [item.id for item in found] == [stage_id(cpu, "first")]
        assert found[0].id in [item.id for item in ready_unclaimed(session, when=seconds(500))]
    assert take(either_database, [["cpu"]]) == stage_id(cpu, "first")
    assert take(either_database, [["cpu"]]) is None
    assert take(either_database, ANY) == stage_id(gpu[0], "first")


def test_what_backs_off_is_passed_over_until_its_time(either_database: Database) -> None:
    first, second = jobs(either_database, CPU, CPU)
    with either_database.session_scope() as session:
        claim = claim_next(session, ANY, "w", 60.0, when=seconds(10))
        assert claim is not None
        fail_stage(session, claim, ERROR, retryable=True, when=seconds(10))
    assert take(either_database, ANY, at=11) == stage_id(second, "first")
    assert take(either_database, ANY, at=11) is None
    assert take(either_database, ANY, at=60) == stage_id(first, "first")


def test_a_wanted_stage_is_refused_to_who_has_not_what_it_needs(either_database: Database) -> None:
    (job,) = jobs(either_database, GPU)
    with either_database.session_scope() as session:
        wanted = stage_id(job, "first")
        assert claim_stage(session, wanted, "w", 60.0, resources=["cpu"]) is None
        assert claim_stage(session, wanted, "w", 60.0, resources=["gpu"]) is not None


def test_nobody_may_take_what_nobody_serves(either_database: Database) -> None:
    jobs(either_database, CPU)
    assert take(either_database, [[], []]) is None


def test_workers_at_once_share_the_queue_without_taking_anything_twice(
    either_database: Database,
) -> None:
    made = jobs(either_database, *[CPU] * 24)
    with ThreadPoolExecutor(8) as pool:
        taken = list(pool.map(lambda _: take(either_database, ANY), range(24)))
    served = [name for name in taken if name is not None]
    assert len(served) == len(set(served))
    rest = [take(either_database, ANY) for _ in range(24 - len(served))]
    assert {*served, *rest} == {stage_id(job, "first") for job in made}


def test_a_claim_passes_over_what_another_holds_and_a_wanted_one_waits_for_it(
    either_database: Database,
) -> None:
    """SQLite has one writer at a time: there the second claim waits in both cases."""
    if either_database.engine.dialect.name == "sqlite":
        return
    first, second = jobs(either_database, CPU, CPU)
    with ThreadPoolExecutor(1) as pool:
        with either_database.session_scope() as session:
            lock_job(session, first)
            assert take(either_database, ANY) == stage_id(second, "first")
            assert take(either_database, ANY) is None

            def want() -> bool:
                with either_database.session_scope() as other:
                    return claim_stage(other, stage_id(first, "first"), "w", 60.0) is not None

            wanted = pool.submit(want)
        assert wanted.result(10)


def test_choosing_and_claiming_is_one_statement_and_reads_no_table_of_what_waits(
    either_database: Database,
) -> None:
    jobs(either_database, *[CPU] * 5)
    statements: list[tuple[str, Any]] = []

    def note(conn: Any, cursor: Any, statement: str, parameters: Any, *more: Any) -> None:
        statements.append((statement, parameters))

    event.listen(either_database.engine, "before_cursor_execute", note)
    take(either_database, ANY)
    event.remove(either_database.engine, "before_cursor_execute", note)
    updates = [item for item in statements if item[0].startswith("UPDATE stages")]
    assert len(updates) == 1
    assert not [item for item in statements if item[0].startswith("SELECT stages")]
    statement, parameters = updates[0]
    with either_database.engine.connect() as connection:
        if connection.dialect.name == "sqlite":
            plan = connection.exec_driver_sql(f"EXPLAIN QUERY PLAN {statement}", parameters).all()
            steps = " ".join(str(row[-1]) for row in plan)
            assert "USING INDEX ix_stages_state_resource_queue_key" in steps
            assert "SCAN stages" not in steps
        else:
            assert "FOR NO KEY UPDATE SKIP LOCKED" in statement
            connection.exec_driver_sql("SET enable_seqscan = off")  # five rows are read faster so
            plan = connection.exec_driver_sql(f"EXPLAIN {statement}", parameters).all()
            steps = " ".join(str(row[0]) for row in plan)
            assert steps.count("ix_stages_state_resource_queue_key") >= len(RESOURCES)
            assert "Seq Scan on stages" not in steps


def test_the_reaper_leaves_a_lease_that_was_extended_while_it_looked(
    either_database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A heartbeat comes after the reaper found the lease expired, before it takes it back."""
    (job,) = jobs(either_database, CPU)
    with either_database.session_scope() as session:
        claim = claim_next(session, ANY, "w", 60.0, when=seconds(0))
    assert claim is not None
    found = lock_job

    def beat_first(session: Any, job_id: str, **how: Any) -> Any:
        heartbeat(session, claim, 60.0, when=seconds(70))
        return found(session, job_id, **how)

    monkeypatch.setattr("storage.leases.lock_job", beat_first)
    with either_database.session_scope() as session:
        assert reap_expired(session, when=seconds(71)) == []
    monkeypatch.undo()
    with either_database.session_scope() as session:
        assert states(session, job)["first"] == "running"
        assert succeed_stage(session, claim, manifest={}, output_prefix="p/") == []


def test_a_change_names_the_lease_that_it_read(either_database: Database) -> None:
    """Had the row not been locked, a lease extended since would still stop the reaper."""
    (job,) = jobs(either_database, CPU)
    with either_database.session_scope() as session:
        claim = claim_next(session, ANY, "w", 60.0, when=seconds(0))
        assert claim is not None
        row = session.get_one(StageRow, stage_id(job, "first"))
        assert row.lease_until == seconds(60)
        heartbeat(session, claim, 60.0, when=seconds(30))
        with pytest.raises(LostLeaseError):
            set_stage(session, row, "ready", seconds(61), run=RunEnd("lost"))


def test_siblings_of_one_job_are_claimed_and_ended_at_once_without_a_deadlock(
    either_database: Database,
) -> None:
    made = jobs(either_database, *[DIAMOND] * 4)
    for _ in made:
        with either_database.session_scope() as session:
            claim = claim_next(session, ANY, "w", 600.0)
            assert claim is not None
            succeed_stage(session, claim, manifest={}, output_prefix="p/")

    def work(number: int) -> None:
        for step in range(6):
            with either_database.session_scope() as session:
                claim = claim_next(session, ANY, f"w{number}", 600.0)
            if claim is None:
                continue
            with either_database.session_scope() as session:
                heartbeat(session, claim, 600.0, progress=0.5)
            with either_database.session_scope() as session:
                if (number + step) % 4 == 0:
                    release_stage(session, claim)
                elif (number + step) % 4 == 1:
                    crash_stage(session, claim, RunEnd("killed", ERROR))
                else:
                    succeed_stage(session, claim, manifest={}, output_prefix="p/")
            if step == 4 and number == 0:
                with either_database.session_scope() as session:
                    request_cancel(session, made[0])

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(work, range(4)))
    with either_database.read_scope() as session:
        for job in made:
            found = states(session, job)
            assert found["job"] != "queued"
            assert "running" not in [found[name] for name in ("left", "right", "last")]
