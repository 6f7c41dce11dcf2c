"""The records on a real PostgreSQL: locks, clocks, JSON; and a whole toy job beside real S3."""

from __future__ import annotations

import time
from concurrent.futures import Future, ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from sqlalchemy import select, text
from sqlalchemy.orm import Session

from storage.claims import claim_stage
from storage.damage import is_found_damaged
from storage.db import Database, now
from storage.errors import NotFoundError
from storage.jobs import StageSeed, create_job, delete_job, request_cancel, stage_id
from storage.leases import cancel_stage, fail_stage, reap_expired, succeed_stage
from storage.models import LogLine
from storage.queries import get_job, list_jobs
from storage.records import append_logs, delete_capture, get_capture, read_logs
from tests.factories import make_capture, make_job, states
from tests.integration.engine import Engine
from tests.services import RedisServer, S3Endpoint

pytestmark = pytest.mark.services
HOUR = timedelta(hours=1)


def test_one_of_many_claims_at_once_wins(database: Database) -> None:
    with database.session_scope() as session:
        stage = stage_id(make_job(session).id, "first")

    def attempt(number: int) -> bool:
        with database.session_scope() as session:
            return claim_stage(session, stage, f"w{number}", 60.0) is not None

    with ThreadPoolExecutor(8) as pool:
        assert sum(pool.map(attempt, range(16))) == 1


def test_siblings_that_end_at_once_still_unblock_what_waits_for_both(database: Database) -> None:
    stages = (
        *(StageSeed(f"side{number}", ()) for number in range(6)),
        StageSeed("last", tuple(f"side{number}" for number in range(6))),
    )
    for _ in range(5):
        with database.session_scope() as session:
            job = make_job(session, stages).id
        claims = []
        for number in range(6):
            with database.session_scope() as session:
                claims.append(claim_stage(session, stage_id(job, f"side{number}"), "w", 60.0))

        def end(claim: object) -> list[str]:
            with database.session_scope() as session:
                return succeed_stage(session, claim, manifest={}, output_prefix="p/")  # type: ignore[arg-type]

        with ThreadPoolExecutor(6) as pool:
            ready = [key for keys in pool.map(end, claims) for key in keys]
        assert ready == [stage_id(job, "last")]


def test_leases_go_by_the_database_s_clock(database: Database) -> None:
    with database.session_scope() as session:
        assert abs((now(session) - datetime.now(UTC)).total_seconds()) < 60
        job = make_job(session).id
        claim = claim_stage(session, stage_id(job, "first"), "w", -1.0)
        assert claim is not None
        assert reap_expired(session) == [claim.stage_id]


def test_values_and_labels_that_postgresql_is_strict_about(database: Database) -> None:
    with database.session_scope() as session:
        options = {"first": {"bad": float("inf"), "text": "a\x00b\ud800"}}
        job = make_job(session, labels={"colour": "red"}, options=options).id
        claim = claim_stage(session, stage_id(job, "first"), "w", 60.0)
        assert claim is not None
        append_logs(session, claim, ["nul \x00", "half \ud800"])
    with database.read_scope() as session:
        assert get_job(session, job).options["first"] == {"bad": None, "text": "ab?"}
        assert read_logs(session, job).lines == ["nul ", "half ?"]
        assert [found.id for found in list_jobs(session, label="colour=red")[0]] == [job]
        assert list_jobs(session, label="colour=blue")[0] == []


def test_pages_and_deletion(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session)
        ids = [make_job(session, capture=capture).id for _ in range(5)]
    seen: list[str] = []
    cursor = None
    with database.read_scope() as session:
        for _ in range(3):
            page, cursor = list_jobs(session, limit=2, cursor=cursor)
            seen += [job.id for job in page]
    assert sorted(seen) == sorted(ids)
    assert cursor is None
    with database.session_scope() as session:
        delete_job(session, ids[0])
        assert len(list_jobs(session)[0]) == 4


def test_bytes_that_a_stage_found_damaged_are_known(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session)
        blob, job = str(capture.blob_id), make_job(session, capture=capture).id
    for name in ("ingest", "capture"):
        error = {"code": "input_damaged", "message": "", "hint": "", "details": {"input": name}}
        with database.session_scope() as session:
            assert not is_found_damaged(session, blob)
            claim = claim_stage(session, stage_id(job, "first"), "w", 60.0)
            assert claim is not None
            fail_stage(session, claim, error, retryable=True, when=now(session) - HOUR)
    with database.read_scope() as session:
        assert is_found_damaged(session, blob)
        assert not is_found_damaged(session, job)


def test_no_job_is_made_on_a_capture_that_was_just_deleted(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session).id
    with database.session_scope() as session:
        seen = get_capture(session, capture)  # by who chooses a preset for it
        with database.session_scope() as other:
            delete_capture(other, capture)
        with pytest.raises(NotFoundError):
            create_job(
                session,
                capture_id=capture,
                preset="preview",
                preset_reason="",
                options={},
                stages=[StageSeed("first", ())],
            )
        assert seen.deleted_at is not None


def wait_for_a_lock(database: Database) -> None:
    """Until somebody waits for a lock that another session holds."""
    deadline = time.monotonic() + 10
    query = text("SELECT count(*) FROM pg_locks WHERE NOT granted")
    while True:
        with database.read_scope() as session:
            if session.scalar(query):
                return
        assert time.monotonic() < deadline, "nobody waits"
        time.sleep(0.02)


def test_who_follows_a_log_sees_each_line_once_beside_two_stages_that_write(
    database: Database,
) -> None:
    side = (StageSeed("evaluate", ()), StageSeed("mesh", ()))
    seen: list[str] = []

    def follow() -> None:
        with database.read_scope() as session:
            seen.extend(read_logs(session, job, line=len(seen)).lines)

    def add(number: int) -> int:
        with database.session_scope() as session:
            return append_logs(session, claims[number], [f"{number}.{line}" for line in range(3)])

    with database.session_scope() as session:
        job = make_job(session, side).id
        found = [claim_stage(session, stage_id(job, seed.name), "w", 60.0) for seed in side]
        claims = [claim for claim in found if claim is not None]
    with ThreadPoolExecutor(1) as pool:
        with database.session_scope() as session:
            append_logs(session, claims[0], ["0.a", "0.b"])
            other = pool.submit(add, 1)
            wait_for_a_lock(database)
            with database.session_scope() as third:  # the rows of the job are nobody's meanwhile
                succeed_stage(third, claims[1], manifest={}, output_prefix="p/")
            follow()
        follow()
        assert other.result(10) == 3
    follow()
    assert seen == ["0.a", "0.b", "1.0", "1.1", "1.2"]


@pytest.mark.parametrize("first", ["lines", "deletion"])
def test_a_job_is_deleted_beside_a_late_log_line(database: Database, first: str) -> None:
    """The worker still flushes what the cancelled stage wrote."""
    with database.session_scope() as session:
        job = make_job(session).id
        claim = claim_stage(session, stage_id(job, "first"), "w", 60.0)
        assert claim is not None
        request_cancel(session, job)
        cancel_stage(session, claim)

    def add() -> int:
        with database.session_scope() as session:
            return append_logs(session, claim, ["late"])

    def drop() -> None:
        with database.session_scope() as session:
            delete_job(session, job)

    other: Future[int] | Future[None]
    with ThreadPoolExecutor(1) as pool, database.session_scope() as session:
        if first == "lines":
            assert append_logs(session, claim, ["late"]) == 1
            other = pool.submit(drop)
        else:
            delete_job(session, job)
            other = pool.submit(add)
        wait_for_a_lock(database)
        session.commit()
        assert other.result(10) == (None if first == "lines" else 0)
    with database.read_scope() as session:
        assert session.scalars(select(LogLine)).all() == []
        with pytest.raises(NotFoundError):
            get_job(session, job)


def last_state(session: Session, job: str) -> str:
    return states(session, job)["job"]


def test_a_job_on_postgresql_and_s3_with_two_workers_in_two_homes(
    tmp_path: Path, redis_server: RedisServer, postgres_url: str, s3_endpoint: S3Endpoint
) -> None:
    """The workers share nothing but the services, so inputs come through the object store."""
    engine = Engine(
        tmp_path,
        redis_server.url,
        NERFWORKS_DATABASE_URL=postgres_url,
        **s3_endpoint.environment(),
    )
    try:
        # Both homes' stages may write here, as to a cache: what they did is noted in it.
        engine.environment["TORCH_HOME"] = str(engine.witness.parent)
        for number in (1, 2):
            engine.environment["NERFWORKS_HOME"] = str(tmp_path / f"home{number}")
            engine.start_worker(f"w{number}")
        met = engine.witness.parent / "met"  # neither ends before both have started
        plan = {"mesh": {"until": str(met)}, "video": {"until": str(met)}}
        job_id = engine.submit({**plan, "train": {"steps": 20, "step_s": 0.1, "save_every": 4}})
        engine.wait(lambda: engine.notes("mesh start") and engine.notes("video start"), 90)
        met.touch()
        job = engine.wait_for(job_id, "succeeded", "failed", timeout_s=90)
        assert job.state == "succeeded", job.error
        pids = {line.split()[-1] for line in engine.notes("") if " start " in line}
        assert len(pids) == 2, "each worker has a process of its own"
        report = engine.stage(job_id, "report").summary
        assert report is not None
        assert report["read"] == ["ingest", "train", "mesh", "video"]
    finally:
        engine.close()
