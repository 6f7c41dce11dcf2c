"""Exports as records: what they read, what they hold off, and what takes them along."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor

import pytest

from storage.db import Database
from storage.errors import ConflictError, NotFoundError
from storage.exports import create_export, live_exports, open_for_export
from storage.jobs import delete_job, open_for_retry, request_cancel, retry_job
from storage.models import Job, PendingDeletion
from storage.queries import get_job, list_jobs, stage_work
from storage.records import delete_capture
from tests.factories import root_of
from tests.unit.storage.committed import claim, look, new_job, seconds, succeed


def finished(database: Database) -> str:
    job = new_job(database)
    for name in ("first", "second", "third"):
        succeed(database, claim(database, job, name))
    return job


def export(database: Database, job: str, kind: str = "third", at: float = 9.0) -> str:
    with database.session_scope() as session:
        parent = open_for_export(session, job)
        return create_export(session, parent, kind, {"n": 1}, when=seconds(at)).id


def test_an_export_reads_what_its_job_published(either_database: Database) -> None:
    database = either_database
    job = finished(database)
    with database.session_scope() as session:
        delete_capture(session, get_job(session, job).capture_id)
    made = export(database, job)
    assert look(database, made) == {"third": "ready", "job": "queued"}
    held = claim(database, made, "third", at=10)
    with database.read_scope() as session:
        work = stage_work(session, held)
        parent, own = session.get_one(Job, job), session.get_one(Job, made)
        assert own.seed == parent.seed
    assert work.is_export
    assert work.options == {"n": 1}
    assert {name: found.prefix for name, found in work.inputs.items()} == dict.fromkeys(
        ("first", "second", "third"), "p/"
    )
    assert not succeed(database, held, at=11)
    assert look(database, made) == {"third": "succeeded", "job": "succeeded"}
    assert look(database, job)["job"] == "succeeded"


def test_jobs_and_exports_are_listed_apart(database: Database) -> None:
    job, other = finished(database), new_job(database)
    made = [export(database, job, at=at) for at in (5, 6)]
    with database.read_scope() as session:
        assert {one.id for one in list_jobs(session)[0]} == {job, other}
        assert [one.id for one in list_jobs(session, exports_of=job)[0]] == made[::-1]
        assert list_jobs(session, exports_of=other)[0] == []
        assert [one.id for one in live_exports(session, job)] == made
    with database.session_scope() as session:
        request_cancel(session, made[0])
        assert [one.id for one in live_exports(session, job)] == made[1:]


def test_a_job_takes_its_exports_along_but_none_that_runs(either_database: Database) -> None:
    database = either_database
    job = finished(database)
    waits, runs = export(database, job), export(database, job)
    held = claim(database, runs, "third", at=10)
    with pytest.raises(ConflictError, match=runs), database.session_scope() as session:
        delete_job(session, job)
    assert look(database, waits)["job"] == "queued"
    succeed(database, held, at=11)
    with database.session_scope() as session:
        delete_job(session, job)
    with database.read_scope() as session:
        gone = {row.prefix for row in session.query(PendingDeletion)}
        assert gone == {root_of(one) for one in (job, waits, runs)}
        for one in (job, waits, runs):
            with pytest.raises(NotFoundError):
                get_job(session, one)


def test_an_export_goes_alone(database: Database) -> None:
    job = finished(database)
    made = export(database, job)
    with database.session_scope() as session:
        delete_job(session, made)
    assert look(database, job)["job"] == "succeeded"
    with pytest.raises(NotFoundError):
        export(database, made)


def test_a_retried_export_comes_with_what_its_job_made(either_database: Database) -> None:
    database = either_database
    job = finished(database)
    made = export(database, job)
    succeed(database, claim(database, made, "third", at=10), at=11)
    with database.session_scope() as session:
        found = open_for_retry(session, made)
        assert found.parent is not None
        assert {row.name for row in found.parent.stages if row.manifest} == {
            *("first", "second", "third")
        }
        assert retry_job(session, found, {"third"}, found.options, changes={}) == [f"{made}-third"]


@pytest.mark.services
def test_who_deletes_and_who_exports_take_turns(either_database: Database) -> None:
    """Neither a deadlock nor an export without its job, whoever comes first."""
    database = either_database
    jobs = [finished(database) for _ in range(6)]

    def ask(job: str) -> bool:
        try:
            export(database, job)
        except NotFoundError:
            return False
        return True

    def delete(job: str) -> None:
        with database.session_scope() as session:
            delete_job(session, job)

    with ThreadPoolExecutor(4) as pool:
        asked = [pool.submit(ask, job) for job in jobs]
        gone = [pool.submit(delete, job) for job in jobs]
        for one in gone:
            one.result(30)
        assert all(one.result(30) in (True, False) for one in asked)
    with database.read_scope() as session:
        assert session.query(Job).count() == 0
