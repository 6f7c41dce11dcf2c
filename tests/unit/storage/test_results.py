"""Retries that were cancelled, or failed: what a job had made is its own until it is made anew."""

from __future__ import annotations

from collections.abc import Iterable
from datetime import timedelta
from pathlib import Path
from typing import Any

import pytest
from sqlalchemy.orm import undefer

from storage.claims import Claim
from storage.db import Database, now
from storage.exports import create_export, open_for_export
from storage.jobs import delete_job, open_for_retry, request_cancel, retry_job
from storage.leases import (
    CAPS,
    FailureReport,
    cancel_stage,
    fail_stage,
    reap_expired,
    succeed_stage,
)
from storage.models import PendingDeletion, StageRow
from storage.objects_local import LocalObjectStore
from storage.queries import get_job, list_events, stage_work
from storage.reconciling import sweep_orphans
from storage.results import fitting
from tests.factories import root_of
from tests.unit.storage.committed import ERROR, claim, look, new_job, seconds

BEFORE = {"first": None, "second": "first", "third": "second"}
DONE = dict.fromkeys(BEFORE, "succeeded")
ASKED = {name: {"n": 1} for name in BEFORE}
OTHERS = {name: {"n": 2} for name in BEFORE}


def publish(database: Database, held: Claim, content: str = "", at: float = 1.0) -> str:
    """The stage succeeds, with a manifest as `pipelines.manifest` writes it. Where it published."""
    content, before = content or f"{held.name} {held.token}", BEFORE[held.name]
    prefix = f"{held.root}{held.name}/{held.attempt}-{held.token}/"
    with database.session_scope() as session:
        rows = get_job(session, held.job_id, manifests=True).stages
        manifests = {row.name: row.manifest or {} for row in rows}
        inputs = {} if before is None else {before: manifests[before]["content"]}
        made = {"content": content, "inputs": inputs, "files": [], "summary": {"made": content}}
        made["fingerprint"] = f"{held.name} of {inputs}"
        succeed_stage(session, held, manifest=made, output_prefix=prefix, when=seconds(at))
    return prefix


def finished(database: Database) -> str:
    """A job whose stages succeeded at 1, 2 and 3 seconds."""
    job = new_job(database, options=ASKED)
    for at, name in enumerate(BEFORE):
        publish(database, claim(database, job, name, at=at), at=at + 1)
    assert look(database, job) == {**DONE, "job": "succeeded"}
    return job


def retry(database: Database, job: str, redo: Iterable[str], options: Any = OTHERS) -> None:
    with database.session_scope() as session:
        retry_job(session, open_for_retry(session, job), {*redo}, options, changes={})


def cancel(database: Database, job: str) -> None:
    with database.session_scope() as session:
        request_cancel(session, job)


def results(database: Database, job: str) -> dict[str, tuple[Any, ...]]:
    """What the stages say of what they made."""
    with database.read_scope() as session:
        query = session.query(StageRow).filter(StageRow.job_id == job).order_by(StageRow.seq)
        return {
            row.name: (row.output_prefix, row.manifest, row.summary, row.fingerprint)
            for row in query.options(undefer(StageRow.manifest))
        }


def offered(database: Database, job: str) -> set[str]:
    """What an export of the job would be given."""
    with database.session_scope() as session:
        parent = open_for_export(session, job)
        assert {*fitting(parent.stages)} <= {*BEFORE}
        made = create_export(session, parent, "third", {}).id
    held = claim(database, made, "third", at=1e9)
    with database.session_scope() as session:
        found = {*stage_work(session, held).inputs}
        request_cancel(session, made)
    with database.session_scope() as session:
        cancel_stage(session, held)
        delete_job(session, made)
    return found


def options_of(database: Database, job: str) -> dict[str, Any]:
    with database.read_scope() as session:
        return get_job(session, job).options


def test_a_retry_that_is_cancelled_leaves_everything_as_it_was(either_database: Database) -> None:
    """Times, options and results; also where it is cancelled twice, the second time at work."""
    database = either_database
    job = finished(database)
    before = results(database, job)
    retry(database, job, ("second", "third"))
    assert look(database, job) == {
        **{"first": "succeeded", "second": "ready", "third": "blocked"},
        "job": "queued",
    }
    assert options_of(database, job) == OTHERS
    cancel(database, job)
    assert look(database, job) == {**DONE, "job": "cancelled"}
    assert results(database, job) == before
    kept = {**ASKED, "first": OTHERS["first"]}  # which was not to be done again
    assert options_of(database, job) == kept

    retry(database, job, ("second", "third"))
    held = claim(database, job, "second", at=10)
    cancel(database, job)
    assert look(database, job) == {
        **{"first": "succeeded", "second": "running", "third": "cancelled"},
        "job": "cancelling",
    }
    for _ in range(2):  # the answer was lost, and it is said again
        with database.session_scope() as session:
            assert cancel_stage(session, held) == "cancelled"
    assert look(database, job) == {**DONE, "job": "cancelled"}
    assert results(database, job) == before
    assert options_of(database, job) == kept
    with database.read_scope() as session:
        rows = {row.name: row for row in get_job(session, job).stages}
        times = (rows["second"].started_at, rows["second"].finished_at, rows["second"].progress)
        assert times == (seconds(1), seconds(2), 1.0)
        told = [event for event in list_events(session, job) if event.stage == "second"][-2:]
        assert [(event.kind, event.reason) for event in told] == [
            ("stage.cancelled", "job_cancelling"),
            ("stage.succeeded", "earlier_result"),
        ]
    assert offered(database, job) == {*BEFORE}


def test_a_stage_that_fails_anew_keeps_what_it_had_made(either_database: Database) -> None:
    """Beside the report of its failure, which goes with the next retry."""
    database = either_database
    job = finished(database)
    before = results(database, job)
    retry(database, job, ("second", "third"))
    held = claim(database, job, "second", at=10)
    report = FailureReport("report/", [{"path": "report.json", "bytes": 1, "sha256": "0"}])
    with database.session_scope() as session:
        fail_stage(session, held, ERROR, retryable=False, report=report)
    assert look(database, job) == {**DONE, "second": "failed", "job": "failed"}
    assert results(database, job) == before
    assert options_of(database, job) == OTHERS, "a retry goes on with what was asked for"
    assert offered(database, job) == {*BEFORE}
    with database.read_scope() as session:
        row = get_job(session, job).stages[1]
        assert (row.report_prefix, row.report_files) == (report.prefix, report.files)

    retry(database, job, ())  # as with options that bring back what it had made
    assert look(database, job) == {**DONE, "job": "succeeded"}
    assert results(database, job) == before
    with database.read_scope() as session:
        row = get_job(session, job).stages[1]
        assert (row.report_prefix, row.report_files, row.error) == (None, None, None)
        gone = {note.prefix for note in session.query(PendingDeletion)}
        assert {prefix for prefix in gone if not prefix.startswith("tenants/")} == {report.prefix}


def test_a_worker_that_dies_again_and_again_in_a_retry_costs_no_result(
    either_database: Database,
) -> None:
    database = either_database
    job = finished(database)
    before = results(database, job)
    retry(database, job, ("second", "third"))
    for round_ in range(CAPS["lost"]):
        claim(database, job, "second", at=(round_ + 1) * 1e4)
        with database.session_scope() as session:
            reap_expired(session, when=seconds((round_ + 1) * 1e4 + 100))
    assert look(database, job) == {**DONE, "second": "failed", "job": "failed"}
    assert results(database, job) == before

    retry(database, job, ("second", "third"))
    claim(database, job, "second", at=1e6)
    cancel(database, job)
    with database.session_scope() as session:
        reap_expired(session, when=seconds(1e6 + 100))
    assert look(database, job) == {**DONE, "job": "cancelled"}
    assert results(database, job) == before


def test_what_was_made_of_something_else_is_kept_but_is_no_success(
    either_database: Database,
) -> None:
    """The second stage is made anew, and another: the third's result does not go with it."""
    database = either_database
    job = finished(database)
    before = results(database, job)
    retry(database, job, ("second", "third"))
    anew = publish(database, claim(database, job, "second", at=10), at=11)
    cancel(database, job)
    assert look(database, job) == {**DONE, "third": "cancelled", "job": "cancelled"}
    assert results(database, job)["second"][0] == anew != before["second"][0]
    assert results(database, job)["third"] == before["third"]
    assert options_of(database, job) == OTHERS
    assert offered(database, job) == {"first", "second"}


def test_what_was_made_of_the_same_is_a_success_again(database: Database) -> None:
    """The second stage is made anew, byte for byte as it was."""
    job = finished(database)
    retry(database, job, ("second", "third"))
    publish(database, claim(database, job, "second", at=10), content="second 1", at=11)
    cancel(database, job)
    assert look(database, job) == {**DONE, "job": "cancelled"}


def test_the_sweep_takes_what_was_made_before_once_it_is_made_anew(
    database: Database, tmp_path: Path
) -> None:
    job = finished(database)
    store = LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"")
    source = tmp_path / "source"

    def put(prefix: str) -> str:
        source.write_bytes(b"x")
        store.put_file(f"{prefix}file", source)
        return prefix

    def sweep() -> list[str]:
        with database.read_scope() as session:
            tomorrow = now(session) + timedelta(hours=25)
        return sweep_orphans(database, store, when=tomorrow)

    old = {name: put(found[0]) for name, found in results(database, job).items()}
    assert sweep() == []
    retry(database, job, ("second", "third"))
    assert sweep() == [], "while it waits"
    held = claim(database, job, "second", at=10)
    assert sweep() == [], "while it runs"
    report = FailureReport(put(f"{held.root}second/1-{held.token}/"), [])
    with database.session_scope() as session:
        fail_stage(session, held, ERROR, retryable=False, report=report)
    assert sweep() == [], "neither the result nor the report"
    retry(database, job, ("second", "third"))
    cancel(database, job)
    assert sweep() == [], "the report goes by itself"
    retry(database, job, ("second", "third"))
    put(publish(database, claim(database, job, "second", at=20), at=21))
    assert sweep() == [old["second"]]
    put(publish(database, claim(database, job, "third", at=30), at=31))
    assert sweep() == [old["third"]]


@pytest.mark.parametrize("wait", [True, False])
def test_a_job_takes_what_it_had_made_before_along(database: Database, wait: bool) -> None:
    job = finished(database)
    retry(database, job, ("second", "third"))
    if not wait:
        cancel(database, job)
    with database.session_scope() as session:
        delete_job(session, job)
    with database.read_scope() as session:
        assert {row.prefix for row in session.query(PendingDeletion)} == {root_of(job)}


def test_what_never_succeeded_has_nothing_to_be_put_back(database: Database) -> None:
    """A job that failed, is retried and cancelled: as before, but for what had succeeded."""
    job = new_job(database, options=ASKED)
    publish(database, claim(database, job, "first"))
    held = claim(database, job, "second", at=2)
    with database.session_scope() as session:
        fail_stage(session, held, ERROR, retryable=False)
    failed = {"first": "succeeded", "second": "failed", "third": "cancelled"}
    assert look(database, job) == {**failed, "job": "failed"}
    retry(database, job, ("second", "third"))
    cancel(database, job)
    assert look(database, job) == {**failed, "second": "cancelled", "job": "cancelled"}
    assert options_of(database, job) == OTHERS
    assert offered(database, job) == {"first"}


def test_the_report_of_a_failure_that_an_older_worker_left_is_no_result(
    database: Database,
) -> None:
    """It stands where results do, as a folder with files and no content."""
    job = new_job(database, options=ASKED)
    publish(database, claim(database, job, "first"))
    held = claim(database, job, "second", at=2)
    with database.session_scope() as session:
        fail_stage(session, held, ERROR, retryable=False, when=seconds(3))
        row = session.query(StageRow).filter_by(job_id=job, name="second").one()
        row.output_prefix, row.manifest = f"{held.root}second/failed/", {"files": []}
    with database.read_scope() as session:
        assert {*fitting(get_job(session, job, manifests=True).stages)} == {"first"}
