"""What the operations of storage.jobs and storage.leases do to states."""

from __future__ import annotations

import pytest

from storage.claims import claim_stage
from storage.db import Database
from storage.errors import ConflictError, LostLeaseError, NotFoundError
from storage.jobs import (
    StageSeed,
    create_job,
    delete_job,
    request_cancel,
    stage_id,
)
from storage.leases import (
    CAPS,
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
from storage.models import Event, Job, PendingDeletion, StageRow
from storage.queries import get_job, is_cancel_requested, list_events, ready_unclaimed, stage_work
from storage.runs import RunEnd, list_runs
from tests.factories import DIAMOND, LINE, make_capture, make_job, root_of
from tests.unit.storage.committed import (
    ERROR,
    KILLED,
    T0,
    claim,
    end_badly,
    look,
    new_job,
    seconds,
    succeed,
)


def test_a_new_job_is_queued_with_its_first_stage_ready(database: Database) -> None:
    job = new_job(database)
    assert look(database, job) == {
        "first": "ready",
        "second": "blocked",
        "third": "blocked",
        "job": "queued",
    }


def test_a_skipped_stage_passes_through_but_does_not_overtake(database: Database) -> None:
    stages = (
        StageSeed("first", ()),
        StageSeed("second", ("first",), skipped=True),
        StageSeed("third", ("second",)),
    )
    job = new_job(database, stages)
    assert look(database, job)["third"] == "blocked"
    assert succeed(database, claim(database, job, "first")) == [stage_id(job, "third")]
    assert look(database, job) == {
        "first": "succeeded",
        "second": "skipped",
        "third": "ready",
        "job": "running",
    }


def test_a_skipped_first_stage_lets_the_second_start(database: Database) -> None:
    job = new_job(database, (StageSeed("first", (), skipped=True), StageSeed("second", ("first",))))
    assert look(database, job)["second"] == "ready"


def test_a_job_without_anything_to_start_is_refused(database: Database) -> None:
    with pytest.raises(ValueError, match="can start"):
        new_job(database, (StageSeed("first", (), skipped=True),))


def test_a_job_on_an_unknown_capture_is_refused(database: Database) -> None:
    with pytest.raises(NotFoundError), database.session_scope() as session:
        create_job(
            session,
            capture_id="nowhere",
            preset="p",
            preset_reason="",
            options={},
            stages=LINE,
        )


def test_only_one_of_two_claims_wins(database: Database) -> None:
    job = new_job(database)
    claim(database, job, "first")
    with database.session_scope() as session:
        assert claim_stage(session, stage_id(job, "first"), "w2", 60.0) is None
    assert look(database, job)["job"] == "running"


def test_a_blocked_stage_and_an_unknown_one_cannot_be_claimed(database: Database) -> None:
    job = new_job(database)
    with database.session_scope() as session:
        assert claim_stage(session, stage_id(job, "third"), "w", 60.0) is None
        assert claim_stage(session, "nonsense", "w", 60.0) is None


def test_a_diamond_waits_for_both_sides_and_then_succeeds(database: Database) -> None:
    job = new_job(database, DIAMOND)
    ready = succeed(database, claim(database, job, "first"))
    assert set(ready) == {stage_id(job, "left"), stage_id(job, "right")}
    left, right = claim(database, job, "left"), claim(database, job, "right")
    assert succeed(database, left) == []
    assert succeed(database, right) == [stage_id(job, "last")]
    assert succeed(database, claim(database, job, "last"), at=9.0) == []
    assert set(look(database, job).values()) == {"succeeded"}
    with database.read_scope() as session:
        assert get_job(session, job).finished_at == seconds(9.0)


def test_succeeding_twice_under_one_claim_changes_nothing(database: Database) -> None:
    job = new_job(database)
    held = claim(database, job, "first")
    assert succeed(database, held) == succeed(database, held) == [stage_id(job, "second")]
    with database.read_scope() as session:
        kinds = [event.kind for event in list_events(session, job)]
    assert kinds.count("stage.succeeded") == 1


def test_a_stale_token_can_write_nothing(database: Database) -> None:
    job = new_job(database)
    stale = claim(database, job, "first")
    with database.session_scope() as session:
        assert reap_expired(session, when=seconds(61)) == [stage_id(job, "first")]
    fresh = claim(database, job, "first", at=62, owner="w2")
    assert fresh.token == stale.token + 1
    with database.session_scope() as session:
        assert heartbeat(session, stale, 60.0).lost
        assert is_cancel_requested(session, stale)
        assert not is_cancel_requested(session, fresh)
    for write in (
        lambda session: succeed_stage(session, stale, manifest={}, output_prefix="p/"),
        lambda session: fail_stage(session, stale, ERROR, retryable=False),
        lambda session: crash_stage(session, stale, KILLED),
        lambda session: release_stage(session, stale),
        lambda session: cancel_stage(session, stale),
        lambda session: save_checkpoint(session, stale, "c/"),
    ):
        with pytest.raises(LostLeaseError), database.session_scope() as session:
            write(session)
    succeed(database, fresh)


def test_a_heartbeat_extends_the_lease_and_records_progress(database: Database) -> None:
    job = new_job(database)
    held = claim(database, job, "first")
    with database.session_scope() as session:
        reply = heartbeat(
            session, held, 60.0, progress=0.5, message="half", eta_s=7.0, when=seconds(50)
        )
        assert not reply.lost
        assert not reply.cancel_requested
        assert reap_expired(session, when=seconds(100)) == []
        row = session.get_one(StageRow, held.stage_id)
        assert (row.progress, row.message, row.eta_s) == (0.5, "half", 7.0)
        assert reap_expired(session, when=seconds(111)) == [held.stage_id]


def test_a_retryable_error_backs_off_and_ends_when_attempts_are_spent(database: Database) -> None:
    job = new_job(database)
    at = 0.0
    for attempt in (1, 2, 3):
        held = claim(database, job, "first", at=at)
        assert held.attempt == attempt
        with database.session_scope() as session:
            state = fail_stage(session, held, ERROR, retryable=True, when=seconds(at))
            assert state == ("ready" if attempt < 3 else "failed")
        with database.session_scope() as session:
            assert claim_stage(session, held.stage_id, "w", 60.0, when=seconds(at + 1)) is None
        at += 1000.0
    assert look(database, job) == {
        "first": "failed",
        "second": "cancelled",
        "third": "cancelled",
        "job": "failed",
    }
    with database.read_scope() as session:
        assert get_job(session, job).error == {**ERROR, "stage": "first"}


def test_a_permanent_error_fails_at_once_and_stops_the_siblings(database: Database) -> None:
    job = new_job(database, DIAMOND)
    succeed(database, claim(database, job, "first"))
    left, right = claim(database, job, "left"), claim(database, job, "right")
    with database.session_scope() as session:
        assert fail_stage(session, left, ERROR, retryable=False) == "failed"
        assert heartbeat(session, right, 60.0).cancel_requested
    with pytest.raises(ConflictError), database.session_scope() as session:
        delete_job(session, job)  # right has not stopped yet
    with database.session_scope() as session:
        cancel_stage(session, right)
    assert look(database, job) == {
        "first": "succeeded",
        "left": "failed",
        "right": "cancelled",
        "last": "cancelled",
        "job": "failed",
    }


@pytest.mark.parametrize(("outcome", "cap"), [*CAPS.items(), ("error", 3)])
def test_each_cause_has_a_cap_of_its_own(database: Database, outcome: str, cap: int) -> None:
    """Also after other causes came up to one before theirs."""
    job = new_job(database)
    at = 0.0
    for other, most in {**CAPS, "error": 3}.items():
        for _ in range(0 if other == outcome else most - 1):
            assert end_badly(database, job, other, at) == "ready"
            at += 1000.0
    for count in range(1, cap + 1):
        assert end_badly(database, job, outcome, at) == ("ready" if count < cap else "failed")
        at += 1000.0
    assert look(database, job)["job"] == "failed"


def test_a_run_that_got_on_starts_the_counts_anew(database: Database) -> None:
    job = new_job(database)
    for number in range(12):
        assert end_badly(database, job, "killed", number * 1000.0, saves=number % 2 == 1) == "ready"
    assert end_badly(database, job, "killed", 12_000.0) == "ready"
    assert end_badly(database, job, "killed", 13_000.0) == "failed"


def test_what_is_released_neither_counts_nor_starts_counts_anew(database: Database) -> None:
    job = new_job(database)
    ends = ["killed", "released", "killed", "released", "killed"]
    states_ = [end_badly(database, job, end, at * 1000.0) for at, end in enumerate(ends)]
    assert states_ == ["ready"] * 4 + ["failed"]


def test_the_retry_after_a_first_crash_is_at_once(database: Database) -> None:
    job = new_job(database)
    held = claim(database, job, "first")
    with database.session_scope() as session:
        crash_stage(session, held, KILLED, when=seconds(1))
    assert claim(database, job, "first", at=1).attempt == 2


def test_released_stages_do_not_count_an_attempt(database: Database) -> None:
    job = new_job(database)
    for token in (1, 2, 3, 4, 5):
        held = claim(database, job, "first")
        assert (held.attempt, held.token) == (1, token)
        with database.session_scope() as session:
            assert release_stage(session, held, when=T0) == "ready"


def test_a_worker_that_starts_again_frees_only_its_own(database: Database) -> None:
    mine, other = new_job(database), new_job(database)
    claim(database, mine, "first", owner="w1")
    claim(database, other, "first", owner="w2")
    with database.session_scope() as session:
        assert release_worker(session, "w1", when=T0) == [stage_id(mine, "first")]
    assert look(database, other)["first"] == "running"


def test_cancel_of_a_queued_job_is_at_once_and_can_be_repeated(database: Database) -> None:
    job = new_job(database)
    for _ in range(2):
        with database.session_scope() as session:
            assert request_cancel(session, job).id == job
        assert set(look(database, job).values()) == {"cancelled"}
    with database.session_scope() as session:
        assert claim_stage(session, stage_id(job, "first"), "w", 60.0) is None


def test_cancel_of_a_running_job_waits_for_its_stage(database: Database) -> None:
    job = new_job(database)
    held = claim(database, job, "first")
    with database.session_scope() as session:
        request_cancel(session, job)
    assert look(database, job) == {
        "first": "running",
        "second": "cancelled",
        "third": "cancelled",
        "job": "cancelling",
    }
    with database.session_scope() as session:
        assert heartbeat(session, held, 60.0).cancel_requested
        cancel_stage(session, held)
    assert look(database, job)["job"] == "cancelled"


def test_cancel_between_two_stages_is_at_once(database: Database) -> None:
    job = new_job(database)
    succeed(database, claim(database, job, "first"))
    with database.session_scope() as session:
        request_cancel(session, job)
    assert look(database, job) == {
        "first": "succeeded",
        "second": "cancelled",
        "third": "cancelled",
        "job": "cancelled",
    }


@pytest.mark.parametrize("end", ["succeed", "fail", "crash", "release", "reap"])
def test_a_cancelling_job_ends_cancelled_however_its_stage_ends(
    database: Database, end: str
) -> None:
    job = new_job(database)
    held = claim(database, job, "first")
    with database.session_scope() as session:
        request_cancel(session, job)
    with database.session_scope() as session:
        if end == "succeed":
            succeed_stage(session, held, manifest={}, output_prefix="p/")
        elif end == "fail":
            fail_stage(session, held, ERROR, retryable=True)
        elif end == "crash":
            crash_stage(session, held, KILLED)
        elif end == "release":
            assert release_stage(session, held) == "cancelled"
        else:
            assert reap_expired(session, when=seconds(1000)) == []
    assert look(database, job)["job"] == "cancelled"


def test_cancel_of_a_finished_job_changes_nothing(database: Database) -> None:
    job = new_job(database, (StageSeed("only", ()),))
    succeed(database, claim(database, job, "only"))
    with database.session_scope() as session:
        assert request_cancel(session, job).state == "succeeded"


def test_a_running_job_cannot_be_deleted_and_a_finished_one_leaves_nothing(
    database: Database,
) -> None:
    job = new_job(database, (StageSeed("only", ()),))
    held = claim(database, job, "only")
    with pytest.raises(ConflictError), database.session_scope() as session:
        delete_job(session, job)
    succeed(database, held)
    with database.session_scope() as session:
        delete_job(session, job)
    with database.read_scope() as session:
        assert session.query(Job).count() == 0
        assert session.query(StageRow).count() == 0
        assert session.query(Event).count() == 0
        assert [row.prefix for row in session.query(PendingDeletion)] == [root_of(job)]
    with pytest.raises(NotFoundError), database.session_scope() as session:
        delete_job(session, job)


def test_a_worker_whose_job_was_deleted_has_lost_its_lease(database: Database) -> None:
    job = new_job(database, (StageSeed("only", ()),))
    held = claim(database, job, "only")
    with database.session_scope() as session:
        reap_expired(session, when=seconds(100))
        request_cancel(session, job)
        delete_job(session, job)
    with pytest.raises(LostLeaseError):
        succeed(database, held)


def test_each_change_leaves_an_event(database: Database) -> None:
    job = new_job(database, (StageSeed("only", ()),))
    succeed(database, claim(database, job, "only"))
    with database.read_scope() as session:
        kinds = [event.kind for event in list_events(session, job)]
    assert kinds == [
        "job.queued",
        "stage.ready",
        "stage.running",
        "job.running",
        "stage.succeeded",
        "job.succeeded",
    ]


def test_ready_stages_wait_in_the_order_of_their_jobs(database: Database) -> None:
    with database.session_scope() as session:
        capture = make_capture(session, when=T0)
        late = make_job(session, capture=capture, when=seconds(10)).id
        early = make_job(session, DIAMOND, capture=capture, when=seconds(5)).id
    with database.read_scope() as session:
        waiting = [item.id for item in ready_unclaimed(session, when=seconds(20))]
        assert waiting == [stage_id(early, "first"), stage_id(late, "first")]
        old = ready_unclaimed(session, older_than_s=12.0, when=seconds(20))
        assert [item.id for item in old] == [stage_id(early, "first")]


def test_a_claimed_stage_is_told_its_inputs_and_its_checkpoint(database: Database) -> None:
    job = new_job(database, options={"first": {}, "second": {"depth": 3}, "third": {}})
    succeed(database, claim(database, job, "first"))
    held = claim(database, job, "second")
    with database.session_scope() as session:
        assert save_checkpoint(session, held, "c1/") is None
        assert save_checkpoint(session, held, "c2/") == "c1/"
    with database.read_scope() as session:
        work = stage_work(session, held)
    assert work.options == {"depth": 3}
    assert work.checkpoint_prefix == "c2/"
    assert work.inputs["first"].prefix == "p/"
    assert work.inputs["first"].manifest == {"summary": {"n": 1}}


ENDS = {
    "succeed": lambda s, c: succeed_stage(s, c, manifest={}, output_prefix="p/", when=seconds(2)),
    "fail": lambda s, c: fail_stage(s, c, ERROR, retryable=False, when=seconds(2)),
    "try again": lambda s, c: fail_stage(s, c, ERROR, retryable=True, when=seconds(2)),
    "crash": lambda s, c: crash_stage(s, c, KILLED, when=seconds(2)),
    "release": lambda s, c: release_stage(s, c, when=seconds(2)),
    "cancel": lambda s, c: cancel_stage(s, c, when=seconds(2)),
}


@pytest.mark.parametrize("end", ENDS)
def test_an_end_that_is_recorded_twice_says_the_same_and_changes_nothing(
    database: Database, end: str
) -> None:
    """A worker repeats it where the answer to its COMMIT was lost."""
    job = new_job(database)
    held = claim(database, job, "first")
    if end == "cancel":
        with database.session_scope() as session:
            request_cancel(session, job)
    with database.session_scope() as session:
        first = ENDS[end](session, held)
    before = look(database, job)
    with database.session_scope() as session:
        events = len(list_events(session, job))
        assert ENDS[end](session, held) == first
        assert len(list_events(session, job)) == events
    assert look(database, job) == before


def test_a_stage_of_a_job_that_goes_on_is_not_cancelled(database: Database) -> None:
    """Nothing would be left that could bring the job to its end."""
    job = new_job(database)
    held = claim(database, job, "first")
    with pytest.raises(ConflictError), database.session_scope() as session:
        cancel_stage(session, held)
    assert look(database, job)["first"] == "running"


def test_an_end_recorded_by_another_is_no_end_of_ours(database: Database) -> None:
    job = new_job(database)
    held = claim(database, job, "first")
    with database.session_scope() as session:
        reap_expired(session, when=seconds(61))
    for end in ENDS.values():
        with pytest.raises(LostLeaseError), database.session_scope() as session:
            end(session, held)


def test_history_keeps_what_a_later_claim_overwrites(database: Database) -> None:
    job = new_job(database)
    held = claim(database, job, "first", owner="w1")
    with database.session_scope() as session:
        crash_stage(session, held, RunEnd("out_of_memory", ERROR, -9, 2**33), when=seconds(3))
    succeed(database, claim(database, job, "first", at=4, owner="w2"), at=5)
    with database.read_scope() as session:
        runs = list_runs(session, job)
        events = list_events(session, job)
    assert [(run.owner, run.outcome, run.led_to) for run in runs] == [
        ("w1", "out_of_memory", "ready"),
        ("w2", "succeeded", "succeeded"),
    ]
    assert (runs[0].error, runs[0].exit_code, runs[0].peak_bytes) == (ERROR, -9, 2**33)
    assert (runs[0].started_at, runs[0].finished_at) == (seconds(0), seconds(3))
    told = [(event.kind, event.actor, event.reason) for event in events if event.stage == "first"]
    assert told == [
        ("stage.ready", "service", ""),
        ("stage.running", "worker:w1", ""),
        ("stage.ready", "worker:w1", "less_memory"),
        ("stage.running", "worker:w2", ""),
        ("stage.succeeded", "worker:w2", ""),
    ]
