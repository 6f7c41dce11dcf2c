"""What must hold in the end, read from records, store, folders and processes, not from the service.

Each function returns what is wrong, one line each, and nothing where all is right.
"""

from __future__ import annotations

import hashlib
from collections import Counter, defaultdict
from collections.abc import Iterable
from pathlib import Path

from sqlalchemy import func, select
from sqlalchemy.orm import Session, undefer

from pipelines.workspace import MANIFEST
from storage.db import Database
from storage.keys import ROOTS, attempt_prefix
from storage.models import (
    Blob,
    Capture,
    Event,
    Job,
    JobGeneration,
    LogLine,
    PendingDeletion,
    StageRow,
    StageRun,
)
from storage.objects import ObjectStore
from storage.states import JOB_TERMINAL
from tests.chaos.load import Accepted
from tests.chaos.plans import chains
from tests.chaos.stages import CHAIN


def wrong_states(session: Session, accepted: Iterable[Accepted]) -> list[str]:
    """Accepted jobs that did not end as they must; jobs that nobody asked for, or twice."""
    wrong = []
    jobs = {job.id: job for job in session.scalars(select(Job))}
    known = set()
    for one in accepted:
        known.add(one.job_id)
        job = jobs.get(one.job_id)
        if job is None or not one.wanted:
            if (job is None) != (not one.wanted):
                how = "lost" if one.wanted else "back"
                wrong.append(f"job {one.job_id} ({one.plan.fate}) is {how}")
            continue
        if (job.state, job.generation) != (one.wanted, one.generation):
            wrong.append(
                f"job {job.id} ({one.plan.fate}) is {job.state} in generation {job.generation}, "
                f"not {one.wanted} in {one.generation}: {job.error}"
            )
    wrong += [f"job {name} was made, and nobody was told" for name in jobs if name not in known]
    plans = Counter(str(job.labels.get("plan")) for job in jobs.values())
    wrong += [f"{number} jobs of plan {name}" for name, number in plans.items() if number > 1]
    live = [job.id for job in jobs.values() if job.state not in JOB_TERMINAL]
    running = session.scalars(select(StageRow).where(StageRow.state == "running"))
    wrong += [f"stage {row.id} of a job that is over still runs" for row in running]
    return wrong + [f"job {name} is not over" for name in live]


def broken_histories(session: Session) -> list[str]:
    """Events that do not follow on each other, and rows that are not as their last event says."""
    wrong = []
    states: dict[tuple[str, str | None], str] = {}
    for event in session.scalars(select(Event).order_by(Event.seq)):
        key, state = (event.job_id, event.stage), event.kind.partition(".")[2]
        before = states.get(key, "blocked" if event.stage else None)
        if event.data.get("was") != before:
            wrong.append(f"{key}: {event.kind} from {event.data.get('was')}, which was {before}")
        states[key] = state
    rows: list[tuple[tuple[str, str | None], str]] = [
        ((row.job_id, row.name), row.state) for row in session.scalars(select(StageRow))
    ]
    rows += [((job.id, None), job.state) for job in session.scalars(select(Job))]
    for key, state in rows:
        if state != "skipped" and states.get(key, "blocked") != state:
            wrong.append(f"{key} is {state}, and its last event says {states.get(key)}")
    return wrong


def repeated_work(session: Session) -> list[str]:
    """Stages that succeeded twice, or were begun again after they had; claims that never ended."""
    wrong = []
    runs = defaultdict(list)
    for run in session.scalars(select(StageRun).order_by(StageRun.token)):
        runs[run.job_id, run.stage].append(run)
        if run.outcome is None:
            wrong.append(f"claim {run.token} of {run.job_id} {run.stage} has no end")
    rows = {(row.job_id, row.name): row for row in session.scalars(select(StageRow))}
    for key, claims in runs.items():
        good = [run for run in claims if run.outcome == "succeeded"]
        if len(good) > 1:
            wrong.append(f"{key} succeeded {len(good)} times")
        if good and claims[-1] is not good[-1]:
            wrong.append(f"{key} was begun again after it had succeeded")
        state = rows[key].state if key in rows else "gone"
        if bool(good) != (state == "succeeded"):
            wrong.append(f"{key} is {state} after {[run.outcome for run in claims]}")
    kind = Event.kind == "stage.succeeded"
    counted = select(Event.job_id, Event.stage, func.count()).where(kind)
    for job_id, stage, number in session.execute(counted.group_by(Event.job_id, Event.stage)):
        if number > 1:
            wrong.append(f"{job_id} {stage} was published {number} times")
    return wrong


def orphan_rows(session: Session) -> list[str]:
    """Records of jobs that are gone, wrong counts of blobs, deletions that were not carried out."""
    jobs = select(Job.id)
    wrong = [
        f"{model.__tablename__} of job {name}, which is gone"
        for model in (StageRow, Event, LogLine, StageRun, JobGeneration)
        for name in session.scalars(select(model.job_id).where(model.job_id.not_in(jobs)))
    ]
    used = Counter(session.scalars(select(Capture.blob_id)))
    for blob in session.scalars(select(Blob)):
        if blob.refs != used[blob.id] or not blob.refs:
            wrong.append(f"{blob.object_key} is held by {used[blob.id]}, and counts {blob.refs}")
    waiting = session.scalars(select(PendingDeletion.prefix))
    return wrong + [f"{prefix} waits to be deleted" for prefix in waiting]


def wrong_objects(
    session: Session, store: ObjectStore, accepted: Iterable[Accepted], *, swept: bool
) -> list[str]:
    """Objects that are missing, damaged or of another making than what their records say.

    swept: whether there must be nothing that no record names.
    """
    wrong, named, kept = [], set(), set()
    digests = {entry.id: entry for entry in session.scalars(select(Capture))}
    for capture in digests.values():
        if capture.deleted_at is None:
            named.add(capture.object_key)
            wrong += _differs(store, capture.object_key, capture.sha256)
    plans = {one.job_id: one.plan for one in accepted}
    rows = session.scalars(select(StageRow).options(undefer(StageRow.manifest)))
    jobs = {job.id: job for job in session.scalars(select(Job))}
    for row in rows:
        job = jobs.get(row.job_id)
        if job is not None and row.checkpoint_prefix:
            kept.add(row.checkpoint_prefix)  # of a stage that was cut short: a retry goes on there
        if job is None:
            continue
        for entry in row.report_files or []:
            key = f"{row.report_prefix}{entry['path']}"
            named.add(key)
            wrong += _differs(store, key, entry["sha256"])
        if not row.output_prefix or not row.manifest:
            continue
        files = {entry["path"]: entry["sha256"] for entry in row.manifest["files"]}
        for path, sha256 in files.items():
            named.add(row.output_prefix + path)
            wrong += _differs(store, row.output_prefix + path, sha256)
        named.add(row.output_prefix + MANIFEST)
        if row.state != "succeeded":
            continue  # a retry was to make it anew, and did not
        place = attempt_prefix(job.object_root, row.name, row.attempt, row.lease_token)
        if row.output_prefix != place:
            wrong.append(f"{row.id} was published as {row.output_prefix}")
        plan = plans.get(row.job_id)
        if plan is not None:
            sha256 = digests[job.capture_id].sha256
            must = hashlib.sha256(chains(plan.stages(), sha256)[row.name].encode()).hexdigest()
            if files.get(CHAIN) != must:
                wrong.append(f"{row.id} was made from something else")
    held = {key for root in ROOTS for key in store.list(root)}
    there = {prefix: {key for key in held if key.startswith(prefix)} for prefix in kept}
    wrong += [f"{prefix} is missing" for prefix, keys in there.items() if not keys]
    named |= set().union(*there.values())
    wrong += [f"{key} is missing" for key in sorted(named - held)]
    if swept:
        wrong += [f"{key} belongs to no record" for key in sorted(held - named)]
    return wrong


def _differs(store: ObjectStore, key: str, sha256: str) -> list[str]:
    digest = hashlib.sha256()
    try:
        for chunk in store.read(key):
            digest.update(chunk)
    except Exception as error:  # noqa: BLE001 whatever it is, the object is of no use
        return [f"{key} cannot be read: {error!r}"]
    return [] if digest.hexdigest() == sha256 else [f"{key} is not what its manifest says"]


def orphan_files(homes: Iterable[Path]) -> list[str]:
    """What workers and APIs left on their disks: job folders, uploads that became no captures."""
    return [
        f"{path} is left behind"
        for home in homes
        for place in ("work", "staging")
        for path in sorted((home / place).glob("*"))
    ]


def broken_answers(logs: Iterable[Path]) -> list[str]:
    """Answers of 500 that the APIs' own logs tell of."""
    return [
        f"{log.name}: {line}"
        for log in logs
        for line in log.read_text("utf-8", "replace").splitlines()
        if "nerfworks.access" in line and line.split()[-2:-1] == ["500"]
    ]


def of_records(
    database: Database, store: ObjectStore, accepted: list[Accepted], *, swept: bool = True
) -> dict[str, list[str]]:
    """All that records and store have to say."""
    with database.read_scope() as session:
        return {
            "jobs in a wrong state": wrong_states(session, accepted),
            "histories that do not hold": broken_histories(session),
            "finished work repeated": repeated_work(session),
            "rows left behind": orphan_rows(session),
            "objects wrong or left behind": wrong_objects(session, store, accepted, swept=swept),
        }
