"""What must be so of a job's records at any moment, whoever did what at the same time."""

from __future__ import annotations

from collections import Counter

from sqlalchemy import select
from sqlalchemy.orm import Session

from storage.models import Event, StageRow, StageRun
from storage.runs import list_runs
from storage.states import JOB_TERMINAL, JOB_TRANSITIONS, STAGE_DONE, STAGE_TRANSITIONS
from tests.factories import states


def check_history(session: Session, job: str) -> None:
    """Each change went on from where the one before had led, as the tables allow; nothing ended
    twice in a generation; each claim was over before the next was made."""
    check_events(session, job)
    check_claims(session, job)


def check_events(session: Session, job: str) -> None:
    """An unbroken chain for the job and each stage, from its first state to the one it is in."""
    events = session.scalars(select(Event).where(Event.job_id == job).order_by(Event.seq)).all()
    at: dict[str, str] = {}
    ended: Counter[str] = Counter()
    for event in events:
        what, _, new = event.kind.partition(".")
        name = event.stage or "job"
        old = event.data.get("was")
        assert name not in at or old == at[name], f"{name} was {at[name]}, and left {old}"
        if old is not None:
            table = JOB_TRANSITIONS if what == "job" else STAGE_TRANSITIONS
            assert new in table[old], f"{name} went from {old} to {new}"
        at[name] = new
        ended[name] += new in ("succeeded", "failed", "cancelled")
        assert ended[name] <= 1, f"{name} ended twice"
        if new in ("queued", "blocked"):
            ended[name] = 0  # another generation
    found = states(session, job)
    assert {name: found[name] for name in at} == at


def check_claims(session: Session, job: str) -> None:
    """Of all claims of a stage only the last can be open, and is where the stage runs."""
    rows = session.scalars(select(StageRow).where(StageRow.job_id == job)).all()
    claims: dict[str, list[StageRun]] = {row.name: [] for row in rows}
    for run in list_runs(session, job):
        claims[run.stage].append(run)
    for row in rows:
        held = claims[row.name]
        assert [run.token for run in held] == list(range(1, row.lease_token + 1))
        open_ones = [run.token for run in held if run.outcome is None]
        assert open_ones == ([row.lease_token] if row.state == "running" else [])
        holder = held[-1].owner if row.state == "running" else None
        assert row.lease_owner == holder
        assert (row.lease_until is None) == (row.state != "running")
        succeeded = Counter(run.generation for run in held if run.outcome == "succeeded")
        assert set(succeeded.values()) <= {1}, f"{row.name} succeeded twice"


def check_can_go_on(session: Session, job: str) -> None:
    """A job that is over has nothing that waits; one that is not can still move."""
    found = states(session, job)
    stages = [state for name, state in found.items() if name != "job"]
    if found["job"] in JOB_TERMINAL:
        assert not {"ready", "blocked"} & set(stages)
    if found["job"] == "succeeded":
        assert set(stages) <= STAGE_DONE
    if found["job"] in ("queued", "running"):
        assert {"ready", "running"} & set(stages), "a job that nobody will ever take"
    if found["job"] == "cancelling":
        assert "running" in stages
