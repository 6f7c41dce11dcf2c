"""Jobs and claims at times that a test chooses, each operation committed."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta

from storage.claims import Claim, claim_stage
from storage.db import Database
from storage.jobs import StageSeed, stage_id
from storage.leases import (
    crash_stage,
    fail_stage,
    release_stage,
    release_worker,
    save_checkpoint,
    succeed_stage,
)
from storage.runs import RunEnd
from tests.factories import LINE, make_job, states

T0 = datetime(2026, 1, 1, tzinfo=UTC)
ERROR = {"code": "tool_failed", "message": "It broke.", "hint": "Mend it."}
KILLED = RunEnd("killed", ERROR, -9)


def seconds(count: float) -> datetime:
    return T0 + timedelta(seconds=count)


def new_job(database: Database, stages: tuple[StageSeed, ...] = LINE, **more: object) -> str:
    with database.session_scope() as session:
        return make_job(session, stages, when=T0, **more).id  # type: ignore[arg-type]


def claim(database: Database, job: str, name: str, at: float = 0.0, owner: str = "w1") -> Claim:
    with database.session_scope() as session:
        made = claim_stage(session, stage_id(job, name), owner, 60.0, when=seconds(at))
    assert made is not None
    return made


def succeed(database: Database, held: Claim, at: float = 1.0) -> list[str]:
    with database.session_scope() as session:
        return succeed_stage(
            session, held, manifest={"summary": {"n": 1}}, output_prefix="p/", when=seconds(at)
        )


def look(database: Database, job: str) -> dict[str, str]:
    with database.read_scope() as session:
        return states(session, job)


def end_badly(database: Database, job: str, outcome: str, at: float, saves: bool = False) -> str:
    """A claim that ends so, after it saved a checkpoint or not. The stage's new state."""
    held = claim(database, job, "first", at=at)
    with database.session_scope() as session:
        if saves:
            save_checkpoint(session, held, f"c{held.token}/")
    with database.session_scope() as session:
        if outcome == "error":
            return fail_stage(session, held, ERROR, retryable=True, when=seconds(at))
        if outcome == "released":
            return release_stage(session, held, when=seconds(at))
        if outcome == "lost":
            released = release_worker(session, "w1", when=seconds(at))
            return "ready" if released == [held.stage_id] else "failed"
        return crash_stage(session, held, RunEnd(outcome, ERROR), when=seconds(at))
