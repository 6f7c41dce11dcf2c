"""Records for tests."""

from __future__ import annotations

import secrets
from collections.abc import Sequence
from datetime import datetime
from pathlib import Path

from sqlalchemy.orm import Session

from storage.db import Database
from storage.jobs import StageSeed, create_job
from storage.keys import blob_content, job_root
from storage.models import Base, Capture, Job, StageRow, new_id
from storage.records import create_capture
from storage.schema import upgrade
from storage.tenants import DEFAULT_TENANT

LINE = (StageSeed("first", ()), StageSeed("second", ("first",)), StageSeed("third", ("second",)))
DIAMOND = (
    StageSeed("first", ()),
    StageSeed("left", ("first",), needs_gpu=True),
    StageSeed("right", ("first",)),
    StageSeed("last", ("left", "right")),
)


def root_of(job_id: str) -> str:
    """Below which a job's bytes lie."""
    return job_root(DEFAULT_TENANT, job_id)


def make_database(folder: Path) -> Database:
    """A migrated SQLite database in a folder."""
    url = f"sqlite:///{folder / 'test.db'}"
    upgrade(url)
    return Database(url)


def empty(database: Database) -> None:
    """Delete every record of a PostgreSQL database."""
    tables = ", ".join(Base.metadata.tables)
    with database.engine.begin() as connection:
        connection.exec_driver_sql(f"TRUNCATE {tables} CASCADE")


def make_capture(
    session: Session,
    *,
    when: datetime | None = None,
    num_bytes: int = 3,
    sha256: str = "",
    tenant_id: str = DEFAULT_TENANT,
) -> Capture:
    """A capture of bytes of its own, or of those with this hash; they are not in any store."""
    capture_id = new_id()
    sha256 = sha256 or secrets.token_hex(32)
    return create_capture(
        session,
        capture_id=capture_id,
        filename="walk.mp4",
        kind="video",
        num_bytes=num_bytes,
        sha256=sha256,
        brought=blob_content(tenant_id, sha256, capture_id),
        details={},
        tenant_id=tenant_id,
        when=when,
    )


def make_job(
    session: Session,
    stages: Sequence[StageSeed] = LINE,
    *,
    capture: Capture | None = None,
    when: datetime | None = None,
    labels: dict[str, str] | None = None,
    max_attempts: int = 3,
    options: dict[str, dict[str, object]] | None = None,
) -> Job:
    """A queued job on a capture of its own."""
    return create_job(
        session,
        capture_id=(capture or make_capture(session, when=when)).id,
        preset="preview",
        preset_reason="a test",
        options=options or {stage.name: {} for stage in stages},
        stages=stages,
        labels=labels,
        max_attempts=max_attempts,
        when=when,
    )


def states(session: Session, job_id: str) -> dict[str, str]:
    """The states of a job's stages by name, and its own under "job"."""
    job = session.get_one(Job, job_id, populate_existing=True)
    rows = session.query(StageRow).filter(StageRow.job_id == job_id).populate_existing()
    return {row.name: row.state for row in rows} | {"job": job.state}
