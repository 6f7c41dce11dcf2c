"""What the keeper of a lease writes, and what it learns."""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from storage.claims import Claim, claim_stage
from storage.db import Database
from storage.jobs import request_cancel, stage_id
from storage.leases import release_worker
from storage.models import StageRow
from storage.objects_local import LocalObjectStore
from storage.records import read_logs
from storage.settings import StorageSettings
from tests.factories import make_database, make_job
from worker.containment.planning import make_plan
from worker.outcomes import StopRunError
from worker.progress import LeaseKeeper
from worker.runner import Runner
from worker.settings import WorkerSettings

SETTINGS = WorkerSettings(lease_s=3.0, heartbeat_s=0.5, cancel_poll_s=0.5)


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    made = make_database(tmp_path)
    yield made
    made.dispose()


@pytest.fixture
def claim(database: Database) -> Claim:
    with database.session_scope() as session:
        made = claim_stage(session, stage_id(make_job(session).id, "first"), "w", 3.0)
    assert made is not None
    return made


def wait(what: Callable[[], bool], timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not what():
        assert time.monotonic() < deadline
        time.sleep(0.05)


def row(database: Database, claim: Claim) -> StageRow:
    with database.read_scope() as session:
        return session.get_one(StageRow, claim.stage_id)


def test_the_lease_is_extended_and_progress_and_log_are_written(
    database: Database, claim: Claim
) -> None:
    before = row(database, claim).lease_until
    assert before is not None
    with LeaseKeeper(database, claim, SETTINGS) as keeper:
        for step in range(50):
            keeper.report(step / 100, f"step {step}", 1.0)
            keeper.log(f"line {step}")
        wait(lambda: row(database, claim).message == "step 49")
        wait(lambda: (row(database, claim).lease_until or before) > before)
        keeper.flush()
    with database.read_scope() as session:
        assert read_logs(session, claim.job_id).lines == [f"line {step}" for step in range(50)]


def test_seconds_left_alone_are_written_and_are_no_step_forward(
    database: Database, claim: Claim
) -> None:
    with LeaseKeeper(database, claim, SETTINGS) as keeper:
        keeper.report(0.5, "half", 9.0)
        wait(lambda: row(database, claim).eta_s == 9.0)
        moved_at = row(database, claim).progress_at
        keeper.report(0.5, "half", 8.0, moved=False)
        wait(lambda: row(database, claim).eta_s == 8.0)
        assert row(database, claim).progress_at == moved_at
        keeper.report(0.6, "more", 7.0)
        keeper.report(0.6, "more", 6.0, moved=False)
        wait(lambda: row(database, claim).eta_s == 6.0)
        assert row(database, claim).progress_at != moved_at


def test_a_cancel_is_noticed_within_seconds(database: Database, claim: Claim) -> None:
    with LeaseKeeper(database, claim, SETTINGS) as keeper:
        with database.session_scope() as session:
            request_cancel(session, claim.job_id)
        assert keeper.cancel_requested.wait(3)
        assert not keeper.lost.is_set()


def test_a_lease_that_another_took_is_noticed(database: Database, claim: Claim) -> None:
    with LeaseKeeper(database, claim, SETTINGS) as keeper:
        with database.session_scope() as session:
            release_worker(session, "w")
        assert keeper.lost.wait(3)


def test_a_database_that_is_away_for_a_lease_means_the_lease_is_lost(
    tmp_path: Path, database: Database, claim: Claim
) -> None:
    (tmp_path / "empty").mkdir()
    away = Database(f"sqlite:///{tmp_path / 'empty' / 'no-tables.db'}")
    begun = time.monotonic()
    with LeaseKeeper(away, claim, SETTINGS) as keeper:
        assert keeper.lost.wait(10)
    assert time.monotonic() - begun >= SETTINGS.lease_s


def test_who_stood_still_for_a_lease_is_not_up_to_date_until_it_was_told(
    database: Database, claim: Claim
) -> None:
    """As a process that goes on before its heartbeat does."""
    with LeaseKeeper(database, claim, SETTINGS) as keeper:
        assert keeper.is_up_to_date()
        keeper._beat_at -= SETTINGS.lease_s + 1.0
        assert not keeper.is_up_to_date()
        wait(keeper.is_up_to_date)
        assert not keeper.lost.is_set()
        with database.session_scope() as session:
            release_worker(session, "w")
        keeper._beat_at -= SETTINGS.lease_s + 1.0
        wait(keeper.is_up_to_date)
        assert keeper.lost.is_set()


def test_an_attempt_that_stood_still_goes_on_only_once_it_knows_whose_the_stage_is(
    tmp_path: Path, database: Database, claim: Claim
) -> None:
    runner = Runner(
        database,
        LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b""),
        SETTINGS,
        work_dir=tmp_path,
        registry="tests.integration.toy_stages",
        plan=make_plan(StorageSettings(home=tmp_path), SETTINGS, os.environ, has_gpu=False),
        threads=lambda: 1,
        shutdown=threading.Event(),
    )
    with LeaseKeeper(database, claim, SETTINGS) as keeper:
        guard = runner._guard_of(keeper, waits=True)
        keeper._beat_at -= SETTINGS.lease_s + 1.0
        guard()  # nobody took it
        with database.session_scope() as session:
            release_worker(session, "w")
        keeper._beat_at -= SETTINGS.lease_s + 1.0
        with pytest.raises(StopRunError, match="lost"):
            guard()
