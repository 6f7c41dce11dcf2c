"""Jobs that are done once more: what stays of them, and what is done again."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from storage.db import Database
from storage.errors import ConflictError
from storage.jobs import (
    StageSeed,
    open_for_retry,
    request_cancel,
    retry_job,
    stage_id,
)
from storage.leases import (
    FailureReport,
    cancel_stage,
    fail_stage,
    save_checkpoint,
)
from storage.models import PendingDeletion
from storage.queries import get_job, stage_work
from storage.runs import list_runs
from tests.unit.storage.committed import (
    ERROR,
    T0,
    claim,
    end_badly,
    look,
    new_job,
    seconds,
    succeed,
)


def test_a_retry_keeps_what_is_not_done_again(either_database: Database) -> None:
    """Results, checkpoints, tokens and history stay; the failed attempt's report goes."""
    database = either_database
    job = new_job(database)
    succeed(database, claim(database, job, "first"))
    held = claim(database, job, "second", at=2)
    with database.session_scope() as session:
        save_checkpoint(session, held, "c1/")
        fail_stage(
            session,
            held,
            ERROR,
            retryable=False,
            report=FailureReport("failed/", []),
            when=seconds(3),
        )
    with database.session_scope() as session:
        found = open_for_retry(session, job)
        changes = {"second": {"depth": 4}}
        ready = retry_job(
            session, found, {"second", "third"}, changes, changes=changes, when=seconds(9)
        )
        assert ready == [stage_id(job, "second")]
    assert look(database, job) == {
        "first": "succeeded",
        "second": "ready",
        "third": "blocked",
        "job": "queued",
    }
    with database.read_scope() as session:
        assert [row.prefix for row in session.query(PendingDeletion)] == ["failed/"]
        assert get_job(session, job).options == changes
    again = claim(database, job, "second", at=10)
    assert (again.token, again.attempt) == (held.token + 1, 1)
    with database.read_scope() as session:
        work = stage_work(session, again)
        assert work.checkpoint_prefix == "c1/"
        assert work.inputs["first"].prefix == "p/"
        assert [(run.generation, run.outcome) for run in list_runs(session, job)] == [
            (1, "succeeded"),
            (1, "error"),
            (2, None),
        ]
    with pytest.raises(ConflictError), database.session_scope() as session:
        open_for_retry(session, job)


def test_no_checkpoint_is_kept_behind_what_is_done_again(either_database: Database) -> None:
    """Through a skipped stage, too; a stage whose inputs hold keeps its own."""
    database = either_database
    stages = (
        StageSeed("first", ()),
        StageSeed("second", ("first",), skipped=True),
        StageSeed("third", ("second",)),
        StageSeed("fourth", ("third",)),
    )
    for redo, kept in (
        ({"third", "fourth"}, {"third": "c3/", "fourth": None}),
        ({"first", "third", "fourth"}, {"third": None, "fourth": None}),
    ):
        job = new_job(database, stages)
        succeed(database, claim(database, job, "first"))
        held = claim(database, job, "third")
        with database.session_scope() as session:
            save_checkpoint(session, held, "c3/")
            request_cancel(session, job)
            cancel_stage(session, held)
        with database.session_scope() as session:
            retry_job(session, open_for_retry(session, job), redo, {}, changes={}, when=T0)
        with database.session_scope() as session:
            rows = {row.name: row for row in get_job(session, job).stages}
            assert {name: rows[name].checkpoint_prefix for name in kept} == kept
            gone = [row.prefix for row in session.query(PendingDeletion)]
            assert gone == ([] if kept["third"] else ["c3/"])


def test_a_retry_starts_the_counts_anew(database: Database) -> None:
    job = new_job(database)
    for at in (0.0, 1000.0, 2000.0):
        last = end_badly(database, job, "killed", at)
    assert last == "failed"
    with database.session_scope() as session:
        found = open_for_retry(session, job)
        retry_job(session, found, {row.name for row in found.stages}, {}, changes={}, when=T0)
    assert end_badly(database, job, "killed", 3000.0) == "ready"


def test_of_two_retries_at_once_one_is_refused(either_database: Database) -> None:
    database = either_database
    job = new_job(database)
    with database.session_scope() as session:
        request_cancel(session, job)

    def retry(_: int) -> bool:
        try:
            with database.session_scope() as session:
                found = open_for_retry(session, job)
                names = {row.name for row in found.stages}
                return bool(retry_job(session, found, names, {}, changes={}))
        except ConflictError:
            return False

    with ThreadPoolExecutor(4) as pool:
        assert sum(pool.map(retry, range(4))) == 1
    with database.read_scope() as session:
        assert get_job(session, job).generation == 2
