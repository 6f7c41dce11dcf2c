"""Pages, logs, workers, keys, captures, deletions, and values that databases refuse."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from storage import api_keys, records
from storage.claims import Claim, claim_stage
from storage.db import Database, now
from storage.deletions import drain_deletions
from storage.errors import ConflictError, InvalidCursorError, NotFoundError
from storage.jobs import open_for_retry, request_cancel, retry_job, stage_id
from storage.leases import fail_stage
from storage.models import ApiKey, Capture, Worker
from storage.objects_local import LocalObjectStore
from storage.queries import get_job, list_captures, list_jobs, queue_position
from storage.queue import QUEUE_CPU, QUEUE_GPU, queue_for
from storage.records import (
    MAX_LOG_LINES,
    append_logs,
    delete_capture,
    forget_lost_workers,
    forget_worker,
    get_capture,
    has_live_gpu,
    live_workers,
    read_logs,
    register_worker,
)
from tests.factories import make_capture, make_job

T0 = datetime(2026, 1, 1, tzinfo=UTC)


def test_pages_go_newest_first_and_are_stable_under_new_jobs(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session)
        ids = [
            make_job(session, capture=capture, when=T0 + timedelta(seconds=number // 2)).id
            for number in range(7)
        ]
    newest_first = ids[::-1]
    seen: list[str] = []
    cursor = None
    while True:
        with database.session_scope() as session:
            page, cursor = list_jobs(session, limit=3, cursor=cursor)
            seen += [job.id for job in page]
            make_job(session, capture=session.merge(capture), when=T0 + timedelta(days=1))
        if cursor is None:
            break
    assert sorted(seen) == sorted(ids)
    assert [key for key in seen if key in (ids[6], ids[0])] == [newest_first[0], newest_first[-1]]


def test_jobs_are_found_by_state_and_by_label(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session)
        red = make_job(session, capture=capture, labels={"colour": "red", "it's": "1"}).id
        blue = make_job(session, capture=capture, labels={"colour": "blue"}).id
        plain = make_job(session, capture=capture).id
        request_cancel(session, plain)
    with database.read_scope() as session:
        by = {
            text: {job.id for job in list_jobs(session, label=text)[0]}
            for text in ("colour=red", "colour", "size", "it's=1")
        }
        assert by == {"colour=red": {red}, "colour": {red, blue}, "size": set(), "it's=1": {red}}
        assert [job.id for job in list_jobs(session, state="cancelled")[0]] == [plain]
        with pytest.raises(ValueError, match="no job state"):
            list_jobs(session, state="sleeping")


@pytest.mark.parametrize("cursor", ["x", "!!!", "e30", "WzEsMl0", "ä"])
def test_a_foreign_cursor_is_refused(database: Database, cursor: str) -> None:
    with database.read_scope() as session, pytest.raises(InvalidCursorError):
        list_jobs(session, cursor=cursor)


def test_the_queue_position_counts_older_queued_jobs(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session)
        jobs = [
            make_job(session, capture=capture, when=T0 + timedelta(seconds=number))
            for number in range(3)
        ]
        assert [queue_position(session, job) for job in jobs] == [1, 2, 3]
        claim_stage(session, stage_id(jobs[0].id, "first"), "w", 60.0)
        session.refresh(jobs[0])
        assert [queue_position(session, job) for job in jobs] == [None, 1, 2]


def test_log_lines_are_numbered_from_either_end(database: Database) -> None:
    with database.session_scope() as session:
        job = make_job(session).id
        claim = Claim(stage_id(job, "first"), job, "first", "w", 1, 1)
        other = Claim(stage_id(job, "second"), job, "second", "w", 1, 1)
        append_logs(session, claim, ["a\x00b", "\ud800"])
        append_logs(session, other, ["c"])
        append_logs(session, claim, ["d"])
        everything = read_logs(session, job)
        assert (len(everything.lines), everything.total) == (4, 4)
        assert everything.lines[0] == "ab"
        assert read_logs(session, job, stage="first", line=2).lines == ["d"]
        tail = read_logs(session, job, line=-2)
        assert (tail.lines, tail.first) == (["c", "d"], 2)
        assert read_logs(session, job, line=99).lines == []
        assert read_logs(session, job, line=-99, limit=1).first == 0


def test_the_log_of_a_stage_is_bounded(database: Database) -> None:
    with database.session_scope() as session:
        job = make_job(session).id
        claim = Claim(stage_id(job, "first"), job, "first", "w", 1, 1)
        assert append_logs(session, claim, ["x"] * (MAX_LOG_LINES + 5)) == MAX_LOG_LINES
        assert append_logs(session, claim, ["y"]) == 0
        assert "ends here" in read_logs(session, job, line=-1).lines[0]


def test_every_attempt_can_write_down_why_it_failed(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(records, "MAX_LOG_LINES", 50)
    monkeypatch.setattr(records, "MAX_STAGE_LOG_LINES", 120)
    monkeypatch.setattr(records, "MIN_LOG_LINES", 10)
    written = []
    with database.session_scope() as session:
        job = make_job(session).id
    for number in range(5):
        when = T0 + timedelta(minutes=number)
        with database.session_scope() as session:
            claim = claim_stage(session, stage_id(job, "first"), "w", 60.0, when=when)
            assert claim is not None
            kept = [append_logs(session, claim, ["x"] * 30, when=when) for _ in range(3)]
            written.append(sum(kept))
            assert "ends here" in read_logs(session, job, line=-1).lines[0]
        with database.session_scope() as session:
            fail_stage(session, claim, {"code": "c"}, retryable=number % 2 == 0, when=when)
            if number % 2:
                found = open_for_retry(session, job)
                retry_job(session, found, ["first"], {}, changes={}, when=when)
                assert append_logs(session, claim, ["late"], when=when) == 0
    assert written == [50, 50, 20, 10, 10]


def test_a_gpu_counts_while_its_worker_is_live_and_serves_gpu_stages(database: Database) -> None:
    with database.session_scope() as session:
        common = {"hostname": "h", "pid": 1, "boot": "b0", "slots": 1}
        register_worker(session, "a", queues=["cpu"], has_gpu=True, when=T0, **common)  # type: ignore[arg-type]
        assert not has_live_gpu(session, T0)
        register_worker(session, "b", queues=["gpu"], has_gpu=True, when=T0, **common)  # type: ignore[arg-type]
        assert has_live_gpu(session, T0)
        assert not has_live_gpu(session, T0 + timedelta(seconds=61))
        register_worker(
            session,
            "b",
            queues=["gpu"],
            has_gpu=True,
            when=T0 + timedelta(seconds=50),
            **common,  # type: ignore[arg-type]
        )
        assert [row.id for row in live_workers(session, T0 + timedelta(seconds=61))] == ["b"]
        forget_worker(session, "b", "another boot")
        assert has_live_gpu(session, T0)
        forget_worker(session, "b", "b0")
        assert not has_live_gpu(session, T0)


def test_workers_that_ended_without_a_word_are_forgotten_after_a_day(database: Database) -> None:
    common = {"hostname": "h", "pid": 1, "boot": "b0", "slots": 1, "queues": [], "has_gpu": False}
    with database.session_scope() as session:
        for name, age_h in (("killed", 25), ("asleep", 23), ("live", 0)):
            when = T0 - timedelta(hours=age_h)
            register_worker(session, name, when=when, **common)  # type: ignore[arg-type]
        forget_lost_workers(session, T0)
        assert {row.id for row in session.query(Worker)} == {"asleep", "live"}


def test_gpu_stages_go_to_cpu_workers_where_no_gpu_is() -> None:
    assert queue_for("gpu", gpu_is_live=False) == QUEUE_CPU
    assert queue_for("gpu", gpu_is_live=True) == QUEUE_GPU
    assert queue_for("cpu", gpu_is_live=True) == QUEUE_CPU


def test_a_capture_stays_while_a_job_runs_on_it_and_then_its_bytes_go(
    database: Database, tmp_path: Path
) -> None:
    store = LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"k")
    with database.session_scope() as session:
        capture = make_capture(session)
        job = make_job(session, capture=capture).id
    (tmp_path / "bytes").write_bytes(b"abc")
    store.put_file(capture.object_key, tmp_path / "bytes")
    with pytest.raises(ConflictError), database.session_scope() as session:
        delete_capture(session, capture.id)
    with database.session_scope() as session:
        request_cancel(session, job)
        delete_capture(session, capture.id)
    assert drain_deletions(database, store) == 1
    assert drain_deletions(database, store) == 0
    assert not store.exists(capture.object_key)
    with database.session_scope() as session:
        assert list_captures(session) == ([], None)
        assert session.get(Capture, capture.id) is not None, "the job still speaks of it"
        for refused in (get_capture, delete_capture):
            with pytest.raises(NotFoundError):
                refused(session, capture.id)
        with pytest.raises(NotFoundError):
            make_job(session, capture=capture)


def test_only_the_hash_of_a_key_is_kept_and_a_revoked_key_is_unknown(database: Database) -> None:
    with database.session_scope() as session:
        record, key = api_keys.create_api_key(session, "laptop")
        assert key.startswith("nw_")
        assert key not in str(vars(record))
        assert api_keys.ensure_api_key(session, key, "again").id == record.id
        found = api_keys.find_api_key(session, key)
        assert found is not None
        mine, when = found
        assert abs(when - now(session)) < timedelta(seconds=30)
        assert api_keys.is_use_due(mine, when)
        api_keys.touch_api_keys(session, [mine.id])
        session.flush()
        assert mine.last_used_at is not None
        assert not api_keys.is_use_due(mine, mine.last_used_at + timedelta(seconds=5))
        assert api_keys.find_api_key(session, key + "x") is None
        api_keys.revoke_api_key(session, record.id)
        assert api_keys.find_api_key(session, key) is None
        assert session.query(ApiKey).count() == 1


def test_values_that_databases_refuse_are_cleaned(database: Database) -> None:
    with database.session_scope() as session:
        options = {"first": {"bad": float("nan"), "text": "a\x00b\ud800"}}
        job = make_job(session, options=options).id
    with database.read_scope() as session:
        assert get_job(session, job).options["first"] == {"bad": None, "text": "ab?"}


def test_times_come_back_aware_and_in_utc(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session, when=datetime.fromisoformat("2026-05-01T12:00:00+02:00"))
    with database.read_scope() as session:
        assert get_capture(session, capture.id).created_at == datetime(2026, 5, 1, 10, tzinfo=UTC)
    with pytest.raises(Exception, match="zone"), database.session_scope() as session:
        make_capture(session, when=datetime(2026, 1, 1))
