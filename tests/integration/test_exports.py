"""Exports through a real worker on a machine that never saw the job, nor its capture."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from pathlib import Path

import pytest

from storage.deletions import drain_deletions
from storage.exports import create_export, open_for_export
from storage.jobs import delete_job, ready_stage_ids
from storage.models import Capture, Job
from storage.records import delete_capture
from tests.integration.engine import Engine
from tests.services import RedisServer, S3Endpoint

pytestmark = pytest.mark.services


@pytest.fixture
def engine(
    tmp_path: Path, redis_server: RedisServer, postgres_url: str, s3_endpoint: S3Endpoint
) -> Iterator[Engine]:
    """On PostgreSQL and S3, which two machines can share."""
    parts = {**s3_endpoint.environment(), "NERFWORKS_DATABASE_URL": postgres_url}
    made = Engine(tmp_path, redis_server.url, **parts)
    yield made
    made.close()


def export(engine: Engine, job_id: str, kind: str) -> str:
    with engine.database.session_scope() as session:
        made = create_export(session, open_for_export(session, job_id), kind, {})
        ready = ready_stage_ids(made)
    engine.bell.ring(ready)
    return made.id


def ended(engine: Engine, job_id: str) -> Job:
    return engine.wait_for(job_id, "succeeded", "failed", timeout_s=120)


def move_to_another_machine(engine: Engine) -> None:
    """End the worker; the next one has a home of its own: it shares database and store alone."""
    for worker in engine.workers:
        worker.send_signal(signal.SIGTERM)
    for worker in engine.workers:
        worker.wait(40)
    engine.environment |= {
        "NERFWORKS_DATABASE_URL": engine.settings.resolved_database_url,
        "NERFWORKS_OBJECTS_URL": engine.settings.resolved_objects_url,
        "NERFWORKS_HOME": str(engine.folder / "another home"),
        # Stages are contained in their home; the witness of this test lies in the first one.
        "NERFWORKS_WORKER_STAGE_WRITABLE": str(engine.witness.parent),
    }


def content_of(engine: Engine, job_id: str, stage: str) -> tuple[str, dict[str, bytes]]:
    """What a stage published: its fingerprint, and its files."""
    row = engine.stage(job_id, stage)
    assert row.manifest is not None
    files = {
        item["path"]: b"".join(engine.store.read(f"{row.output_prefix}{item['path']}"))
        for item in row.manifest["files"]
    }
    return row.manifest["fingerprint"], files


def test_another_machine_exports_what_is_in_the_store_without_the_capture(engine: Engine) -> None:
    engine.start_worker()
    job_id = engine.submit({})
    job = ended(engine, job_id)
    assert job.state == "succeeded", job.error
    with engine.database.session_scope() as session:
        source = session.get_one(Capture, job.capture_id).object_key
        assert engine.store.exists(source)
        delete_capture(session, job.capture_id)
    drain_deletions(engine.database, engine.store)
    assert not engine.store.exists(source)
    move_to_another_machine(engine)

    made = [export(engine, job_id, kind) for kind in ("mesh", "video", "video")]
    engine.start_worker("w2", "--slots", "2")
    for kind, one in zip(("mesh", "video", "video"), made, strict=True):
        over = ended(engine, one)
        assert over.state == "succeeded", over.error
        assert content_of(engine, one, kind) == content_of(engine, job_id, kind)
        assert engine.stage(one, kind).summary == engine.stage(job_id, kind).summary
        assert engine.log(one, kind)
    assert len(engine.notes("train start")) == len(engine.notes("ingest start")) == 1
    assert len(engine.notes("video start")) == 3
    engine.wait(lambda: not list((engine.folder / "another home" / "work").iterdir()), 45)

    roots = [engine.job(one).object_root for one in (job_id, *made)]
    with engine.database.session_scope() as session:
        delete_job(session, job_id)
    drain_deletions(engine.database, engine.store)
    assert [key for root in roots for key in engine.store.list(root)] == []


def test_an_export_that_fails_says_why_and_leaves_no_file(engine: Engine) -> None:
    """Its job is as it was, and no half-written file is ever listed."""
    engine.start_worker()
    job_id = engine.submit({"mesh": {"fault": True}})
    assert ended(engine, job_id).state == "failed"
    made = export(engine, job_id, "mesh")  # training has succeeded
    over = ended(engine, made)
    assert over.state == "failed"
    assert over.error is not None
    assert (over.error["code"], over.error["stage"]) == ("internal_error", "mesh")
    assert engine.stage(made, "mesh").output_prefix is None
    assert list(engine.store.list(over.object_root)) == []
    assert ended(engine, export(engine, job_id, "video")).state == "succeeded"
