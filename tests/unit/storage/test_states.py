"""The tables, and any order of operations: nothing leaves them, and every job can end."""

from __future__ import annotations

import tempfile
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

from storage.claims import Claim, claim_stage
from storage.db import Database
from storage.errors import ConflictError, LostLeaseError
from storage.jobs import open_for_retry, request_cancel, retry_job, stage_id
from storage.leases import (
    cancel_stage,
    crash_stage,
    fail_stage,
    heartbeat,
    reap_expired,
    release_stage,
    release_worker,
    succeed_stage,
)
from storage.models import Event
from storage.runs import RunEnd
from storage.states import (
    JOB_LIVE,
    JOB_TERMINAL,
    JOB_TRANSITIONS,
    STAGE_TRANSITIONS,
)
from tests.factories import DIAMOND, empty, make_database, make_job, states

T0 = datetime(2026, 1, 1, tzinfo=UTC)
ERROR = {"code": "e", "message": "m", "hint": "h"}
WORKERS = ("w1", "w2")


def test_the_tables_name_only_states_that_they_hold() -> None:
    for table in (JOB_TRANSITIONS, STAGE_TRANSITIONS):
        assert set().union(*table.values()) <= set(table)
    assert {"queued", "running", "cancelling"} == JOB_LIVE


class AnyOrder(RuleBasedStateMachine):
    """Workers, messages and people in any order, with stale claims and leaping clocks."""

    def __init__(self) -> None:
        super().__init__()
        self.database = self.open_database()
        self.when = T0
        self.claims: list[Claim] = []
        self.ends: dict[tuple[str, int], str] = {}
        with self.database.session_scope() as session:
            self.job = make_job(session, DIAMOND, when=T0, max_attempts=2).id

    def teardown(self) -> None:
        """However it went, the job can be brought to its end."""
        for _ in range(60):
            if self._states()["job"] in JOB_TERMINAL:
                break
            self.when += timedelta(hours=1)
            with self.database.session_scope() as session:
                reap_expired(session, when=self.when)
            self.when += timedelta(hours=1)
            for stage in DIAMOND:
                self._claim(stage.name, "w1")
            for claim in self.claims[-4:]:
                self._write(claim, "succeed")
        assert self._states()["job"] in JOB_TERMINAL
        assert "running" not in self._states().values()
        self.check_events()
        self.close_database()

    def open_database(self) -> Database:
        self.folder = tempfile.TemporaryDirectory()
        return make_database(Path(self.folder.name))

    def close_database(self) -> None:
        self.database.dispose()
        self.folder.cleanup()

    def _states(self) -> dict[str, str]:
        with self.database.read_scope() as session:
            return states(session, self.job)

    def _num_events(self) -> int:
        with self.database.read_scope() as session:
            return session.query(Event).count()

    def _claim(self, name: str, worker: str) -> None:
        with self.database.session_scope() as session:
            claim = claim_stage(session, stage_id(self.job, name), worker, 60.0, when=self.when)
        if claim is not None:
            assert all(
                claim.token > old.token for old in self.claims if old.stage_id == claim.stage_id
            )
            self.claims.append(claim)

    def _write(self, claim: Claim, what: str) -> None:
        holds = {
            "succeed": lambda s: succeed_stage(
                s, claim, manifest={}, output_prefix="p/", when=self.when
            ),
            "fail": lambda s: fail_stage(s, claim, ERROR, retryable=False, when=self.when),
            "retry": lambda s: fail_stage(s, claim, ERROR, retryable=True, when=self.when),
            "crash": lambda s: crash_stage(s, claim, RunEnd("killed", ERROR), when=self.when),
            "release": lambda s: release_stage(s, claim, when=self.when),
            "cancel": lambda s: cancel_stage(s, claim, when=self.when),
        }
        newest = max(old.token for old in self.claims if old.stage_id == claim.stage_id)
        run, end = (claim.stage_id, claim.token), "error" if what in ("retry", "fail") else what
        before = self._states(), self._num_events()
        try:
            with self.database.session_scope() as session:
                holds[what](session)
        except LostLeaseError:
            assert (self._states(), self._num_events()) == before, "a void claim wrote"
            return
        if run in self.ends:
            # Who says again how it ended, as the answer was lost, is answered; nothing happens.
            assert self.ends[run] == end, "a claim ended twice"
            assert (self._states(), self._num_events()) == before, "an end was written twice"
        else:
            assert claim.token == newest, "a stale claim wrote"
            self.ends[run] = end

    @rule(name=st.sampled_from([stage.name for stage in DIAMOND]), worker=st.sampled_from(WORKERS))
    def deliver(self, name: str, worker: str) -> None:
        self._claim(name, worker)

    @precondition(lambda self: self.claims)
    @rule(data=st.data(), what=st.sampled_from(["succeed", "succeed", "retry", "crash", "release"]))
    def end(self, data: st.DataObject, what: str) -> None:
        self._write(data.draw(st.sampled_from(self.claims)), what)

    @precondition(lambda self: self.claims)
    @rule(data=st.data())
    def fail(self, data: st.DataObject) -> None:
        self._write(data.draw(st.sampled_from(self.claims)), "fail")

    @precondition(lambda self: self.claims)
    @rule(data=st.data())
    def beat(self, data: st.DataObject) -> None:
        claim = data.draw(st.sampled_from(self.claims))
        with self.database.session_scope() as session:
            reply = heartbeat(session, claim, 60.0, progress=0.5, when=self.when)
        if reply.cancel_requested and not reply.lost:
            self._write(claim, "cancel")

    @rule(seconds=st.sampled_from([1, 10, 70, 400]))
    def wait(self, seconds: int) -> None:
        self.when += timedelta(seconds=seconds)
        with self.database.session_scope() as session:
            reap_expired(session, when=self.when)

    @rule(worker=st.sampled_from(WORKERS))
    def restart(self, worker: str) -> None:
        with self.database.session_scope() as session:
            release_worker(session, worker, when=self.when)

    @rule(chance=st.integers(0, 5))
    def cancel(self, chance: int) -> None:
        if chance == 0:
            with self.database.session_scope() as session:
                request_cancel(session, self.job, when=self.when)

    @rule(chance=st.integers(0, 2), first=st.sampled_from([stage.name for stage in DIAMOND]))
    def retry(self, chance: int, first: str) -> None:
        """Somebody runs a stage again, with all behind it and all that did not succeed."""
        behind = {"first": {"left", "right", "last"}, "left": {"last"}, "right": {"last"}}
        try:
            with self.database.session_scope() as session:
                job = open_for_retry(session, self.job)
                if chance:
                    return
                redo = {first, *behind.get(first, set())}
                redo |= {row.name for row in job.stages if row.state != "succeeded"}
                for name in [*redo]:
                    redo |= behind.get(name, set())
                before = job.generation
                ready = retry_job(session, job, redo, job.options, changes={}, when=self.when)
                assert ready
                assert job.generation == before + 1
        except ConflictError:
            assert not {"running", "cancelling", "queued"}.isdisjoint(self._states().values())

    @invariant()
    def check_events(self) -> None:
        """Each change followed the tables, and no stage succeeded twice in a generation."""
        with self.database.read_scope() as session:
            events = session.query(Event).order_by(Event.seq).all()
        for event in events:
            what, _, new = event.kind.partition(".")
            table = JOB_TRANSITIONS if what == "job" else STAGE_TRANSITIONS
            if "was" in event.data:
                assert new in table[event.data["was"]]
        done: set[str | None] = set()
        for event in events:
            if event.kind == "stage.succeeded":
                assert event.stage not in done
                done.add(event.stage)
            elif event.kind == "stage.blocked":
                done.discard(event.stage)

    @invariant()
    def check_job(self) -> None:
        """A finished job has nothing that waits; an unfinished one can still move."""
        found = self._states()
        stages = [state for name, state in found.items() if name != "job"]
        if found["job"] in JOB_TERMINAL:
            assert not {"ready", "blocked"} & set(stages)
        if found["job"] == "succeeded":
            assert set(stages) == {"succeeded"}
        if found["job"] in ("queued", "running"):
            assert {"ready", "running"} & set(stages)
        if found["job"] == "cancelling":
            assert "running" in stages


AnyOrder.TestCase.settings = settings(max_examples=20, stateful_step_count=30, deadline=None)
TestAnyOrder = AnyOrder.TestCase


def test_the_order_in_which_a_stale_claim_says_again_how_it_ended() -> None:
    """Chance found it once in months: that claim is answered, so an answer alone is no harm."""
    state = AnyOrder()
    state.deliver("first", "w1")
    state._write(state.claims[0], "retry")
    state.wait(10)
    state.deliver("first", "w1")
    assert [claim.token for claim in state.claims] == [1, 2]
    for what in ("retry", "fail", "succeed", "crash", "release"):
        state._write(state.claims[0], what)
    assert state._states()["first"] == "running"
    state.teardown()


@pytest.mark.services
def test_any_order_on_postgresql(postgres_store: Database) -> None:
    class OnPostgres(AnyOrder):
        def open_database(self) -> Database:
            return postgres_store

        def close_database(self) -> None:
            empty(postgres_store)

    few = settings(max_examples=4, stateful_step_count=25, deadline=None)
    run_state_machine_as_test(OnPostgres, settings=few)
