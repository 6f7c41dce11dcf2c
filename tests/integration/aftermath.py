"""What must be so when all is over, whatever went wrong on the way."""

from __future__ import annotations

import hashlib
from collections import Counter
from datetime import timedelta

from sqlalchemy import func, select

from pipelines.workspace import MANIFEST
from storage.db import Database, now
from storage.deletions import drain_deletions
from storage.models import Blob, Capture, PendingDeletion, StageRow, StageRun
from storage.objects_local import LocalObjectStore
from storage.reconciling import sweep_orphans
from storage.runs import list_runs

UNFINISHED = ".nerfworks-tmp"


def check_published(database: Database, store: LocalObjectStore, job: str) -> None:
    """What the stages of a job made is in the store as their manifests have it, and nothing else
    lies beside it; each stage succeeded once, in one claim."""
    with database.read_scope() as session:
        rows = session.scalars(select(StageRow).where(StageRow.job_id == job)).all()
        made = {
            row.name: (row.output_prefix, row.manifest["files"], row.state)
            for row in rows
            if row.output_prefix and row.manifest
        } | {
            row.name: (row.report_prefix, row.report_files, row.state)
            for row in rows
            if row.report_prefix
        }
        runs = list_runs(session, job)
    for prefix, files, state in made.values():
        assert prefix is not None
        assert files is not None
        wanted = {item["path"]: item["sha256"] for item in files}
        there = {
            key.removeprefix(prefix): hashlib.sha256(b"".join(store.read(key))).hexdigest()
            for key in store.list(prefix)
        }
        if state == "succeeded":
            assert there.pop(MANIFEST, None) is not None
        assert there == wanted
    succeeded = Counter(run.stage for run in runs if run.outcome == "succeeded")
    assert succeeded == Counter(name for name, found in made.items() if found[2] == "succeeded")


def check_only_what_is_named(database: Database, store: LocalObjectStore) -> None:
    """After the sweep of tomorrow the store holds what records name, and no claim is open."""
    with database.read_scope() as session:
        tomorrow = now(session) + timedelta(hours=25)
    sweep_orphans(database, store, when=tomorrow)
    while drain_deletions(database, store):
        pass
    with database.read_scope() as session:
        rows = session.scalars(select(StageRow)).all()
        kept = select(Capture.object_key).where(Capture.deleted_at.is_(None))
        captures = Counter(session.scalars(kept))
        blobs = session.execute(select(Blob.object_key, Blob.refs)).all()
        assert captures == {row.object_key: row.refs for row in blobs}
        named = {*captures}
        prefixes = {
            prefix
            for row in rows
            for prefix in (row.output_prefix, row.checkpoint_prefix, row.report_prefix)
        }
        notes = session.scalar(select(func.count()).select_from(PendingDeletion))
        open_claims = session.scalars(
            select(StageRun.stage).where(StageRun.outcome.is_(None))
        ).all()
        running = [row.name for row in rows if row.state == "running"]
    for prefix in prefixes - {None}:
        there = set(store.list(str(prefix)))
        assert there, f"{prefix} is named, and nothing is there"
        named |= there
    files = {path for path in store.root.rglob("*") if path.is_file()}
    assert {path.relative_to(store.root).as_posix() for path in files} == named
    assert notes == 0
    assert sorted(open_claims) == sorted(running)
