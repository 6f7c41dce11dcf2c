"""When the bell rings again, what is cleaned, and what counts as a GPU."""

from __future__ import annotations

import shutil
import threading
import time
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from storage.bell import Bell
from storage.claims import Claim, claim_stage
from storage.db import Database, now
from storage.jobs import request_cancel, stage_id
from storage.leases import cancel_stage, heartbeat
from storage.models import PendingDeletion, StageRow, Worker
from storage.objects import ObjectStore
from storage.objects_local import LocalObjectStore
from storage.open_objects import open_object_store
from storage.queries import WaitingStage
from storage.records import register_worker
from storage.settings import StorageSettings
from tests.factories import make_database, make_job
from tests.services import Gate
from worker.housekeeping import Grace, Housekeeping, is_ring_due
from worker.runtime import WorkerIdentity
from worker.settings import WorkerSettings

T0 = datetime(2026, 1, 1, tzinfo=UTC)
NO_BROKER = "redis://127.0.0.1:1/0"


def keeper_of(
    database: Database,
    tmp_path: Path,
    settings: WorkerSettings | None = None,
    *,
    store: ObjectStore | None = None,
    bell: Bell | None = None,
    register: Callable[[], None] = lambda: None,
) -> Housekeeping:
    """A worker's housekeeping, with `work` and `objects` below the folder, and no broker."""
    return Housekeeping(
        database,
        store or LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b""),
        bell or Bell(NO_BROKER, database),
        settings or WorkerSettings(),
        work_dir=tmp_path / "work",
        register=register,
        offer=lambda: None,
    )


def waiting(rung_after_s: float | None) -> WaitingStage:
    rung = None if rung_after_s is None else T0 + timedelta(seconds=rung_after_s)
    return WaitingStage("s", "cpu", T0, rung)


@pytest.mark.parametrize(
    ("rung_after_s", "asked_after_s", "due"),
    [
        (None, 0, True),
        (-5, 0, True),  # it rang before the retry's time had come
        (0, 59, False),
        (0, 60, True),
        (60, 119, False),
        (60, 120, True),
        (480, 900, False),
        (480, 960, True),
    ],
)
def test_the_bell_rings_again_after_pauses_that_double(
    rung_after_s: float | None, asked_after_s: float, due: bool
) -> None:
    moment = T0 + timedelta(seconds=asked_after_s)
    assert is_ring_due(waiting(rung_after_s), moment, 60.0) is due


def test_cleaning_forgets_workers_that_are_long_gone(tmp_path: Path) -> None:
    database = make_database(tmp_path)
    with database.session_scope() as session:
        register_worker(
            session,
            "killed",
            hostname="h",
            pid=1,
            boot="b",
            queues=["cpu"],
            slots=1,
            has_gpu=False,
            when=T0,
        )
    keeper_of(database, tmp_path).clean()
    with database.read_scope() as session:
        assert session.query(Worker).count() == 0


def test_folders_go_when_their_job_is_over_and_nothing_of_it_runs(tmp_path: Path) -> None:
    database = make_database(tmp_path)
    work = tmp_path / "work"
    with database.session_scope() as session:
        live, over = make_job(session).id, make_job(session).id
        claim = claim_stage(session, stage_id(over, "first"), "w", 60.0)
        request_cancel(session, over)
    for name in (live, over, "of-no-job"):
        (work / name / "train").mkdir(parents=True)
    keeper = keeper_of(database, tmp_path)
    keeper.clean()
    assert {path.name for path in work.iterdir()} == {live, over}
    assert claim is not None
    with database.session_scope() as session:
        cancel_stage(session, claim)
    keeper.clean()
    assert {path.name for path in work.iterdir()} == {live}


def test_a_job_that_is_retried_while_its_old_folder_goes_keeps_its_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = make_database(tmp_path)
    work = tmp_path / "work"
    with database.session_scope() as session:
        job = make_job(session).id
        request_cancel(session, job)
    (work / job / "train").mkdir(parents=True)
    (work / ".gone-of-a-worker-that-died").mkdir()
    remove = shutil.rmtree

    def retried_meanwhile(folder: Path, ignore_errors: bool) -> None:
        (work / job / "ingest").mkdir(parents=True, exist_ok=True)
        remove(folder, ignore_errors=ignore_errors)

    monkeypatch.setattr("worker.housekeeping.shutil.rmtree", retried_meanwhile)
    keeper = keeper_of(database, tmp_path)
    keeper._clean_folders()
    assert [path.name for path in work.iterdir()] == [job]
    assert (work / job / "ingest").is_dir()
    assert not (work / job / "train").exists()
    database.dispose()


def test_the_loop_outlives_a_round_that_fails(tmp_path: Path) -> None:
    rounds: list[float] = []
    third = threading.Event()

    def register() -> None:
        rounds.append(time.monotonic())
        if len(rounds) == 3:
            third.set()
        raise RuntimeError("no database today")

    database = make_database(tmp_path)
    keeper = keeper_of(database, tmp_path, WorkerSettings(tick_s=0.01), register=register)
    keeper.start()
    assert third.wait(10)
    keeper.stop(10)


def test_reaping_is_on_time_while_broker_and_object_store_hang(
    tmp_path: Path, gate: Callable[..., Gate]
) -> None:
    """Both accept and never answer. Cleaning waits for the store; nothing else waits for either."""
    database = make_database(tmp_path)
    hung = gate().port
    store = open_object_store(
        StorageSettings(
            home=tmp_path,
            objects_url="s3://bucket/prefix",
            s3_endpoint_url=f"http://127.0.0.1:{hung}",
            s3_access_key_id="a",
            s3_secret_access_key="b",
            s3_timeout_s=60.0,
        )
    )
    with database.session_scope() as session:
        session.add(PendingDeletion(prefix="jobs/gone/", created_at=T0))
    bell = Bell(f"redis://127.0.0.1:{hung}/0", database, timeout_s=1.0)
    settings = WorkerSettings(tick_s=0.05, clean_s=0.05)
    keeper = keeper_of(database, tmp_path, settings, store=store, bell=bell)
    keeper.start()
    try:
        for _ in range(3):
            with database.session_scope() as session:
                wanted = stage_id(make_job(session).id, "first")
                assert claim_stage(session, wanted, "w", -1.0) is not None  # its lease is over
            deadline = time.monotonic() + 5
            while time.monotonic() < deadline:
                with database.read_scope() as session:
                    row = session.get(StageRow, wanted)
                    if row is not None and row.state == "ready":
                        break
                time.sleep(0.02)
            else:
                pytest.fail("a lease that is over was not taken back within 5 s")
    finally:
        keeper.stop(0.1)
        bell.close()


def test_a_worker_without_a_gpu_leaves_the_gpu_queue_alone() -> None:
    assert WorkerIdentity.of("w", 1, ("cpu", "gpu"), has_gpu=False).queues == ("cpu",)
    assert WorkerIdentity.of("w", 1, ("cpu", "gpu"), has_gpu=True).queues == ("cpu", "gpu")


@pytest.mark.parametrize(
    ("rounds_s", "believed"),
    [
        ([0, 2, 4, 6], [True, True, True, True]),
        ([0, 2, 100, 102, 108, 110, 112], [True, True, False, False, False, True, True]),
        ([0, 100, 200, 300], [True, False, False, False]),  # it sleeps again and again
        ([0, 25, 50], [True, True, True]),  # slow, but no lease could have run out
    ],
)
def test_a_reaper_that_was_away_gives_all_their_turn_before_it_reaps(
    rounds_s: list[int], believed: list[bool]
) -> None:
    grace = Grace(WorkerSettings(lease_s=60, heartbeat_s=5, tick_s=2))
    assert [grace.is_over(T0 + timedelta(seconds=at)) for at in rounds_s] == believed


def at(seconds: float) -> datetime:
    """So long after T0."""
    return T0 + timedelta(seconds=seconds)


def two_claims(
    database: Database, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> tuple[list[Claim], Callable[[float], list[str]]]:
    """Two stages that are claimed at T0 for 60 s, and a reaper of them.

    It has one round, so many seconds after T0 by its clock, and tells their states then.
    """
    with database.session_scope() as session:
        made = [
            claim_stage(session, stage_id(make_job(session).id, "first"), "w", 60.0, when=T0)
            for _ in range(2)
        ]
    claims = [claim for claim in made if claim is not None]
    assert len(claims) == 2
    keeper = keeper_of(database, tmp_path)

    def reap(at_s: float) -> list[str]:
        monkeypatch.setattr("worker.housekeeping.now", lambda session: at(at_s))
        keeper.reap()
        with database.read_scope() as session:
            return [session.get_one(StageRow, claim.stage_id).state for claim in claims]

    return claims, reap


def test_a_machine_that_slept_loses_no_lease_but_one_whose_worker_is_gone(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    database = make_database(tmp_path)
    (lives, _), reap = two_claims(database, tmp_path, monkeypatch)
    assert reap(2) == ["running", "running"]
    assert reap(3600) == ["running", "running"]
    with database.session_scope() as session:
        assert not heartbeat(session, lives, 60.0, when=at(3603)).lost
    assert reap(3602) == ["running", "running"]
    assert reap(3611) == ["running", "ready"]
    database.dispose()


def test_a_clock_that_goes_back_an_hour_leaves_no_lease_for_an_hour(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where the reaper was away before: the grace that it gave ends in its time."""
    database = make_database(tmp_path)
    (lives, _), reap = two_claims(database, tmp_path, monkeypatch)
    assert reap(2) == ["running", "running"]
    assert reap(40) == ["running", "running"]
    assert reap(40 - 3600) == ["running", "running"]
    with database.session_scope() as session:
        assert not heartbeat(session, lives, 60.0, when=at(90 - 3600)).lost
    assert reap(60 - 3600) == ["running", "running"]
    assert reap(80 - 3600) == ["running", "running"]
    assert reap(99 - 3600) == ["running", "running"]
    assert reap(102 - 3600) == ["running", "ready"]
    database.dispose()


def test_a_reaper_that_starts_after_the_clock_went_back_sees_it(tmp_path: Path) -> None:
    database = make_database(tmp_path)
    with database.session_scope() as session:
        later = now(session) + timedelta(hours=1)
        held = stage_id(make_job(session).id, "first")
        assert claim_stage(session, held, "w", 60.0, when=later) is not None
    keeper_of(database, tmp_path).reap()
    with database.read_scope() as session:
        until = session.get_one(StageRow, held).lease_until
        assert until is not None
        assert until - now(session) < timedelta(seconds=61)
    database.dispose()
