"""Workers, reapers and people at the very same moment, on both databases: whatever they do
together, no change is illegal, no job is lost, no claim has two holders."""

from __future__ import annotations

import tempfile
import threading
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    rule,
    run_state_machine_as_test,
)
from sqlalchemy import select
from sqlalchemy.orm import Session

from storage.claims import Claim, claim_next, claim_stage
from storage.db import Database
from storage.errors import ConflictError, LostLeaseError, NotFoundError
from storage.exports import create_export, open_for_export
from storage.jobs import delete_job, open_for_retry, request_cancel, retry_job, stage_id
from storage.leases import (
    cancel_stage,
    crash_stage,
    fail_stage,
    heartbeat,
    reap_expired,
    release_stage,
    release_worker,
    save_checkpoint,
    succeed_stage,
)
from storage.models import (
    Event,
    Job,
    JobGeneration,
    LogLine,
    PendingDeletion,
    StageRow,
    StageRun,
)
from storage.queue import RESOURCES
from storage.records import append_logs
from storage.runs import RunEnd
from storage.states import JOB_TERMINAL
from storage.transitions import lock_job
from tests.factories import DIAMOND, LINE, empty, make_database, make_job, root_of
from tests.histories import check_can_go_on, check_history

T0 = datetime(2026, 1, 1, tzinfo=UTC)
ERROR = {"code": "e", "message": "m", "hint": "h"}
WORKERS = ("w1", "w2", "w3")
LEASE_S = 60.0
AT_ONCE = 4
REFUSED = (LostLeaseError, ConflictError, NotFoundError)
Deed = tuple[str, int, int]
"""What is done, and which of the claims or jobs, newest first, and which worker or stage."""

WORK = ("take", "take", "want", "succeed", "succeed", "retry", "crash", "release", "beat", "save")
PEOPLE = ("submit", "cancel", "again", "export", "export", "delete")
deeds = st.tuples(
    st.sampled_from([*WORK, *WORK, *PEOPLE, "fail", "stop", "reap", "restart", "log"]),
    st.integers(0, 3),
    st.integers(0, 3),
)


class AtOnce(RuleBasedStateMachine):
    """Each step is a handful of deeds, begun together."""

    def __init__(self) -> None:
        super().__init__()
        self.database = self.open_database()
        self.when = T0
        self.jobs: list[str] = []
        self.claims: list[Claim] = []
        self.deleted: set[str] = set()
        self.pool = ThreadPoolExecutor(AT_ONCE)
        for _ in range(2):
            self.note(("submit", 0, 0), self.do(("submit", 0, 0), lambda: None))

    def teardown(self) -> None:
        """However it went, every job can be brought to its end."""
        self.pool.shutdown()
        for _ in range(80):
            if not self.live():
                break
            self.when += timedelta(hours=1)
            with self.database.session_scope() as session:
                reap_expired(session, when=self.when)
            self.when += timedelta(hours=1)
            while (claim := self.do(("take", 0, 0), lambda: None)) is not None:
                self.claims.append(claim)
                self.do(("succeed", 0, 0), lambda: None)
        assert not self.live()
        self.check()
        self.close_database()

    def open_database(self) -> Database:
        self.folder = tempfile.TemporaryDirectory()
        return make_database(Path(self.folder.name))

    def close_database(self) -> None:
        self.database.dispose()
        self.folder.cleanup()

    def live(self) -> list[str]:
        with self.database.read_scope() as session:
            return list(session.scalars(select(Job.id).where(Job.state.not_in(JOB_TERMINAL))))

    @rule(
        together=st.lists(deeds, min_size=2, max_size=AT_ONCE),
        seconds=st.sampled_from([1, 30, 400]),
    )
    def do_at_once(self, together: list[Deed], seconds: int) -> None:
        self.when += timedelta(seconds=seconds)
        gate = threading.Barrier(len(together))
        waiting = [self.pool.submit(self.do, deed, gate.wait) for deed in together]
        for deed, done in zip(together, waiting, strict=True):
            self.note(deed, done.result(60))

    def note(self, deed: Deed, result: Any) -> None:
        """Keep in mind what came of it."""
        what = deed[0]
        if isinstance(result, Claim):
            others = [(one.stage_id, one.token) for one in self.claims]
            assert (result.stage_id, result.token) not in others, "two holders of one claim"
            self.claims.append(result)
        elif what in ("submit", "export") and result is not None:
            self.jobs.append(result)
        elif what == "delete" and result is not None:
            self.deleted |= result

    def do(self, deed: Deed, begin: Callable[[], object]) -> Any:
        """One deed in a transaction of its own; None where it was refused, or there is nothing."""
        what, which, who = deed
        claims, jobs = self.claims[::-1], self.jobs[::-1]
        claim = claims[which % len(claims)] if claims else None
        job = jobs[which % len(jobs)] if jobs else ""
        begin()
        try:
            with self.database.session_scope() as session:
                if what in HELD:
                    return None if claim is None else HELD[what](session, claim, self.when)
                return self.at_large(session, what, job, who)
        except REFUSED:
            return None

    def at_large(self, session: Session, what: str, job: str, who: int) -> Any:
        worker = WORKERS[who % len(WORKERS)]
        if what == "submit":
            stages = DIAMOND if who % 2 else LINE
            return make_job(session, stages, when=self.when, max_attempts=2).id
        if what == "take":
            return claim_next(session, [list(RESOURCES)], worker, LEASE_S, when=self.when)
        if what == "want":
            name = ("first", "second", "left", "right")[who]
            return claim_stage(session, stage_id(job, name), worker, LEASE_S, when=self.when)
        if what == "reap":
            return reap_expired(session, when=self.when)
        if what == "restart":
            return release_worker(session, worker, when=self.when)
        if what == "cancel":
            return request_cancel(session, job, when=self.when).id
        if what == "delete":
            lock_job(session, job)
            exports = session.scalars(select(Job.id).where(Job.parent_id == job)).all()
            delete_job(session, job, when=self.when)
            return {job, *exports}
        if what == "export":
            parent = open_for_export(session, job)
            if parent.parent_id is not None:
                return None  # the API refuses exports of exports
            return create_export(session, parent, "first", {}, when=self.when).id
        assert what == "again"
        found = open_for_retry(session, job)
        redo = {row.name for row in found.stages}
        return retry_job(session, found, redo, found.options, changes={}, when=self.when)

    @invariant()
    def check(self) -> None:
        """All of it, after every step."""
        with self.database.read_scope() as session:
            there = set(session.scalars(select(Job.id)))
            assert there == set(self.jobs) - self.deleted, "a job is lost"
            for job in there:
                check_history(session, job)
                check_can_go_on(session, job)
            for record in (StageRow, StageRun, JobGeneration, Event, LogLine):
                assert set(session.scalars(select(record.job_id))) <= there
            notes = set(session.scalars(select(PendingDeletion.prefix)))
            assert {root_of(job) for job in self.deleted} <= notes
            runs = select(StageRun.job_id, StageRun.stage, StageRun.token, StageRun.owner)
            owners = {
                (job, stage, token): owner for job, stage, token, owner in session.execute(runs)
            }
            for claim in self.claims:
                if claim.job_id in there:
                    assert owners[claim.job_id, claim.name, claim.token] == claim.owner


HELD: dict[str, Callable[[Session, Claim, datetime], Any]] = {
    "succeed": lambda s, c, when: succeed_stage(
        s, c, manifest={}, output_prefix=f"{c.stage_id}/{c.token}/", when=when
    ),
    "fail": lambda s, c, when: fail_stage(s, c, ERROR, retryable=False, when=when),
    "retry": lambda s, c, when: fail_stage(s, c, ERROR, retryable=True, when=when),
    "crash": lambda s, c, when: crash_stage(s, c, RunEnd("killed", ERROR), when=when),
    "release": lambda s, c, when: release_stage(s, c, when=when),
    "stop": lambda s, c, when: cancel_stage(s, c, when=when),
    "beat": lambda s, c, when: heartbeat(s, c, LEASE_S, progress=0.5, when=when),
    "save": lambda s, c, when: save_checkpoint(s, c, f"{c.stage_id}/c{c.token}/"),
    "log": lambda s, c, when: append_logs(s, c, ["a line"], when=when),
}

AtOnce.TestCase.settings = settings(max_examples=8, stateful_step_count=12, deadline=None)
TestAtOnce = AtOnce.TestCase


@pytest.mark.services
def test_at_once_on_postgresql(postgres_store: Database) -> None:
    class OnPostgres(AtOnce):
        def open_database(self) -> Database:
            return postgres_store

        def close_database(self) -> None:
            empty(postgres_store)

    few = settings(max_examples=8, stateful_step_count=12, deadline=None)
    run_state_machine_as_test(OnPostgres, settings=few)
