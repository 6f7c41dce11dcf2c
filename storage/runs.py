"""The history of a job: a row for each claim and each generation, which no later one overwrites.

Two things are read from the claims. Whether an operation that ends a claim has been recorded
before: after a COMMIT whose answer was lost it is repeated, and must then change nothing. And how
often a stage ended in one way since it last got on: each cause has a cap of its own, and a run that
saved a checkpoint starts the counts anew.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from typing import Any

from sqlalchemy import select, update
from sqlalchemy.orm import Session

from storage.models import Job, JobGeneration, StageRow, StageRun

OUTCOMES = (
    "succeeded",
    "error",  # the stage, or the worker around it, said what is wrong
    "killed",  # its process was killed from outside
    "out_of_memory",
    "crashed",  # its process broke down by a fault
    "stalled",  # alive, but without progress for too long
    "time_limit",
    "lost",  # its worker stopped without a word, or started anew
    "released",  # its worker shut down in order, or found the object store away
    "cancelled",
)


@dataclass(frozen=True)
class RunEnd:
    """How a claim ended. exit_code: of the process, negative for a signal. peak_bytes: the most
    memory that it held; both None where nobody knows. output_prefix, fingerprint: of its result."""

    outcome: str
    error: dict[str, Any] | None = None
    exit_code: int | None = None
    peak_bytes: int | None = None
    output_prefix: str | None = None
    fingerprint: str | None = None


def start_run(
    session: Session,
    job: Job,
    *,
    stage: str,
    token: int,
    attempt: int,
    owner: str,
    when: datetime,
) -> None:
    """Note that a claim was made."""
    session.add(
        StageRun(
            tenant_id=job.tenant_id,
            job_id=job.id,
            stage=stage,
            token=token,
            generation=job.generation,
            attempt=attempt,
            owner=owner,
            started_at=when,
            checkpoints=0,
        )
    )


def start_generation(
    session: Session, job: Job, when: datetime, from_stage: str | None = None
) -> None:
    """Note what the job is asked for from now on."""
    session.add(
        JobGeneration(
            job_id=job.id,
            generation=job.generation,
            tenant_id=job.tenant_id,
            options=job.options,
            from_stage=from_stage,
            created_at=when,
        )
    )


def end_run(session: Session, row: StageRow, end: RunEnd, led_to: str, when: datetime) -> None:
    """Note how the stage's present claim ended, and the state that this led to."""
    if end.outcome not in OUTCOMES:
        raise ValueError(f"a claim cannot end as {end.outcome}")
    session.execute(
        update(StageRun)
        .where(
            StageRun.job_id == row.job_id,
            StageRun.stage == row.name,
            StageRun.token == row.lease_token,
            StageRun.outcome.is_(None),
        )
        .values(
            finished_at=when,
            outcome=end.outcome,
            led_to=led_to,
            error=end.error,
            exit_code=end.exit_code,
            peak_bytes=end.peak_bytes,
            output_prefix=end.output_prefix,
            fingerprint=end.fingerprint,
        )
        .execution_options(synchronize_session=False)
    )


def count_checkpoint(session: Session, row: StageRow) -> None:
    """Note that the stage's present claim saved a checkpoint: it got on."""
    session.execute(
        update(StageRun)
        .where(
            StageRun.job_id == row.job_id,
            StageRun.stage == row.name,
            StageRun.token == row.lease_token,
        )
        .values(checkpoints=StageRun.checkpoints + 1)
        .execution_options(synchronize_session=False)
    )


def run_of(session: Session, job_id: str, stage: str, token: int) -> StageRun | None:
    """The claim of that token, as it is now."""
    query = select(StageRun).where(
        StageRun.job_id == job_id, StageRun.stage == stage, StageRun.token == token
    )
    return session.scalar(query, execution_options={"populate_existing": True})


def maker_of(session: Session, row: StageRow) -> StageRun | None:
    """The claim that published what the stage's row names."""
    query = select(StageRun).where(
        StageRun.job_id == row.job_id,
        StageRun.stage == row.name,
        StageRun.outcome == "succeeded",
        StageRun.output_prefix == row.output_prefix,
    )
    return session.scalar(query.order_by(StageRun.id.desc()).limit(1))


def options_of(session: Session, run: StageRun) -> dict[str, Any] | None:
    """What the stage of a claim was run with; None where nobody knows."""
    made = session.get(JobGeneration, (run.job_id, run.generation))
    return None if made is None else made.options.get(run.stage)


def count_ends(session: Session, row: StageRow, outcome: str) -> int:
    """How often the stage ended so since it last got on, its present claim counted as one more.

    Only this generation of the job counts; so does the end of the claim that saved the last
    checkpoint.
    """
    present = run_of(session, row.job_id, row.name, row.lease_token)
    if present is None or present.checkpoints:
        return 1
    earlier = session.execute(
        select(StageRun.outcome, StageRun.checkpoints)
        .where(
            StageRun.job_id == row.job_id,
            StageRun.stage == row.name,
            StageRun.generation == present.generation,
            StageRun.token < row.lease_token,
        )
        .order_by(StageRun.token.desc())
    )
    count = 1
    for past, checkpoints in earlier:
        count += past == outcome
        if checkpoints:
            break
    return count


def has_ended(session: Session, job_id: str, stage: str, token: int, outcome: str) -> bool:
    """Whether a claim before that of this token ended so, in the same generation of the job."""
    present = run_of(session, job_id, stage, token)
    if present is None:
        return False
    query = select(StageRun.id).where(
        StageRun.job_id == job_id,
        StageRun.stage == stage,
        StageRun.generation == present.generation,
        StageRun.token < token,
        StageRun.outcome == outcome,
    )
    return session.scalar(query.limit(1)) is not None


def list_runs(session: Session, job_id: str) -> list[StageRun]:
    """All claims of a job's stages, oldest first."""
    query = select(StageRun).where(StageRun.job_id == job_id).order_by(StageRun.id)
    return list(session.scalars(query))


def list_generations(session: Session, job_id: str) -> list[JobGeneration]:
    """What a job was asked for, from the first time on."""
    query = select(JobGeneration).where(JobGeneration.job_id == job_id)
    return list(session.scalars(query.order_by(JobGeneration.generation)))
