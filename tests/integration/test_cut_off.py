"""PostgreSQL that is cut off within a transaction: packets are lost, and neither end is told.

Whoever waits gives up in time and takes the outcome for unknown; the rows that the transaction
holds are free again soon; all that was connected finds its way back without a restart.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError, SQLAlchemyError
from sqlalchemy.orm import Session

from api.errors import to_api_error
from storage.claims import Claim, claim_stage
from storage.db import Database, is_away, now
from storage.jobs import stage_id
from storage.leases import heartbeat, reap_expired, save_checkpoint, succeed_stage
from storage.models import StageRow
from storage.postgres import FRESH_S
from storage.transitions import lock_job
from tests.factories import make_job
from tests.faults import at_step
from tests.histories import check_history
from tests.services import Gate, behind_gate
from tests.unit.api.conftest import problem, serving, settings_for
from worker.settings import WorkerSettings

pytestmark = pytest.mark.services
MakeGate = Callable[..., Gate]
DEADLINE_S = 1.0
SOON_S = 15.0
"""Far more than it takes, for a loaded machine; far less than the locks were held before."""
LEASE_S = 600.0

OPERATIONS: dict[str, Callable[[Session, Claim], Any]] = {
    "claim": lambda session, claim: claim_stage(session, claim.stage_id, "second", LEASE_S),
    "beat": lambda session, claim: heartbeat(session, claim, LEASE_S, progress=0.7, message="on"),
    "checkpoint": lambda session, claim: save_checkpoint(session, claim, "prefix/"),
    "finish": lambda session, claim: succeed_stage(
        session, claim, manifest={"files": []}, output_prefix="prefix/"
    ),
}


@pytest.fixture
def cut_off(
    database: Database, postgres_url: str, gate: MakeGate
) -> Iterator[tuple[Database, Gate]]:
    """The same database by a way that can be cut off, and that way."""
    url, way = behind_gate(postgres_url, gate)
    made = Database(url, deadline_s=DEADLINE_S)
    yield made, way
    made.dispose()


def claimed(database: Database) -> Claim:
    """A stage that was just claimed."""
    with database.session_scope() as session:
        claim = claim_stage(session, stage_id(make_job(session).id, "first"), "w", LEASE_S)
    assert claim is not None
    return claim


def until_it_answers(call: Callable[[], Any], timeout_s: float = SOON_S) -> Any:
    """Repeat a call that meets locks or dead connections, as workers do."""
    give_up_at = time.monotonic() + timeout_s
    while True:
        try:
            return call()
        except OperationalError:
            assert time.monotonic() < give_up_at, f"not within {timeout_s:.0f} s"
            time.sleep(0.1)


@pytest.mark.parametrize(
    ("step", "applied"),
    [
        *((step, False) for step in OPERATIONS),  # the COMMIT is lost
        *((step, True) for step in ("claim", "finish")),  # its answer is
    ],
)
def test_what_is_cut_off_within_a_transaction_is_given_up_repeated_and_recorded_once(
    database: Database, cut_off: tuple[Database, Gate], step: str, applied: bool
) -> None:
    through, way = cut_off
    claim = claimed(database)
    if step == "claim":  # of a stage that waits again
        with database.session_scope() as session:
            reap_expired(session, now(session) + timedelta(seconds=LEASE_S + 1))

    def operate() -> Any:
        with through.session_scope(step=step) as session:
            done = OPERATIONS[step](session, claim)
            session.flush()  # so that the COMMIT alone is left to be sent
            return done

    begun = time.monotonic()
    with (
        at_step(f"{step}.commit", lambda: way.cut_off(answers_alone=applied)) as happened,
        pytest.raises(OperationalError, match="what became of the transaction is not known"),
    ):
        operate()
    assert happened.is_set()
    assert time.monotonic() - begun < SOON_S
    again = until_it_answers(operate)
    with database.read_scope() as session:
        row = session.get_one(StageRow, claim.stage_id)
        check_history(session, claim.job_id)
    if step == "claim":  # of a claim that nobody knows of the lease runs out
        assert (again is None) is applied
        assert (row.state, row.lease_token) == ("running", 2)
    if step == "beat":
        assert (row.progress, row.message) == (0.7, "on")
        assert not again.lost
    if step == "checkpoint":
        assert row.checkpoint_prefix == "prefix/"
    if step == "finish":
        assert (row.state, row.output_prefix) == ("succeeded", "prefix/")
        assert again == [stage_id(claim.job_id, "second")]


def test_a_transaction_that_nobody_ends_is_ended_well_before_a_lease(database: Database) -> None:
    """Or a worker that was cut off in a heartbeat could not extend its lease in time."""
    with database.read_scope() as session:
        told = session.scalar(text("SHOW idle_in_transaction_session_timeout"))
    assert told is not None
    assert told.endswith("s")
    most_s = float(told.removesuffix("s"))
    settings = WorkerSettings()
    assert 0 < most_s <= (settings.lease_s - settings.heartbeat_s) / 3


def test_a_client_too_slow_within_a_transaction_is_told_to_come_again(postgres_url: str) -> None:
    """PostgreSQL ends its connection, as after a sleep of the machine; the driver calls that an
    internal error, and a caller must not.
    """
    slow = Database(postgres_url, deadline_s=DEADLINE_S)

    def dawdle() -> None:
        with slow.session_scope() as session:
            session.execute(text("SELECT 1"))
            time.sleep(DEADLINE_S + 1.0)
            session.execute(text("SELECT 1"))

    with pytest.raises(SQLAlchemyError) as caught:
        dawdle()
    assert not isinstance(caught.value, OperationalError), "then this test asks for nothing"
    assert is_away(caught.value)
    answer = to_api_error(caught.value)
    assert (answer.status, answer.code) == (503, "database_unavailable")
    with slow.session_scope() as session:
        assert session.scalar(text("SELECT 1")) == 1
    slow.dispose()


@pytest.mark.parametrize("held", ["stage", "job"])
def test_one_job_that_is_locked_keeps_no_other_lease_from_being_taken_back(
    database: Database, held: str
) -> None:
    stuck, other = claimed(database), claimed(database)
    with database.session_scope() as holder:
        if held == "stage":
            heartbeat(holder, stuck, 1.0)
        else:
            lock_job(holder, stuck.job_id)
        with database.session_scope() as session:
            later = now(session) + timedelta(seconds=LEASE_S + 1)
            assert reap_expired(session, later) == [other.stage_id]
    with database.session_scope() as session:
        assert reap_expired(session, later) == [stuck.stage_id]


def fill_pool(database: Database, num: int) -> set[int]:
    """Leave so many idle connections behind. Ids of their servers' processes."""
    scopes = [database.read_scope() for _ in range(num)]
    pids = {scope.__enter__().scalar(text("SELECT pg_backend_pid()")) for scope in scopes}
    for scope in scopes:
        scope.__exit__(None, None, None)
    assert len(pids) == num
    return {pid for pid in pids if pid is not None}


def test_a_pool_of_connections_that_died_unheard_is_replaced_without_an_error(
    cut_off: tuple[Database, Gate],
) -> None:
    through, way = cut_off
    dead = fill_pool(through, 5)
    way.cut_off()
    time.sleep(FRESH_S + 0.1)

    def ask(_: int) -> Any:
        with through.read_scope() as session:
            return session.scalar(text("SELECT pg_backend_pid()"))

    begun = time.monotonic()
    assert ask(0) not in dead
    with ThreadPoolExecutor(5) as pool:
        assert not dead & set(pool.map(ask, range(20)))
    assert time.monotonic() - begun < SOON_S


def test_connections_that_the_server_ended_are_seen_to_be_over_however_fresh(
    database: Database,
) -> None:
    dead = fill_pool(database, 5)
    other = Database(str(database.engine.url.render_as_string(hide_password=False)))
    with other.session_scope() as session:
        for pid in dead:
            session.execute(text("SELECT pg_terminate_backend(:pid, 10000)"), {"pid": pid})
    other.dispose()
    assert not dead & fill_pool(database, 5)


def test_a_job_that_is_cut_off_as_it_is_made_is_a_503_in_time_and_there_once(
    tmp_path: Path, gate: MakeGate, postgres_url: str
) -> None:
    url, way = behind_gate(postgres_url, gate)
    settings = settings_for(
        tmp_path / "home", database_url=url, database_timeout_s=DEADLINE_S, check_timeout_s=0.2
    )
    with serving(settings) as service:
        body = {"capture_id": service.upload()["id"]}

        def create(key: str) -> Any:
            return service.http.post("/v1/jobs", json=body, headers={"Idempotency-Key": key})

        for applied in (True, False):
            begun = time.monotonic()
            with at_step("create.commit", lambda: way.cut_off(answers_alone=applied)):  # noqa: B023
                problem(create(f"key-{applied}"), 503, "database_unavailable")
            assert time.monotonic() - begun < SOON_S
            give_up_at = time.monotonic() + SOON_S
            # A key whose COMMIT was lost is held for a while: that caller waits, others need not.
            while (answer := create(f"key-{applied}" if applied else "other")).status_code != 202:
                assert time.monotonic() < give_up_at, answer.text
                time.sleep(0.2)
        assert len(service.http.get("/v1/jobs").json()["items"]) == 2
