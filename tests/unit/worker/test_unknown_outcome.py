"""COMMITs whose outcome nobody knows: what was uploaded stays unless the database refused it.

A real runner with a real stage process; the database's answer is lost where a test says so.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from deploy.embedded import free_port
from storage import keys
from storage.claims import Claim, claim_stage
from storage.jobs import stage_id
from storage.leases import reap_expired
from tests.factories import root_of
from tests.faults import at_step, lose_answer
from tests.integration.engine import Engine
from worker.checkpoints import CheckpointUploader, Snapshot
from worker.containment.planning import make_plan
from worker.runner import Runner
from worker.settings import WorkerSettings

TOYS = "tests.integration.toy_stages"


@pytest.fixture(scope="module")
def engine(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Engine]:
    folder = tmp_path_factory.mktemp("doubt")
    made = Engine(folder, f"redis://127.0.0.1:{free_port()}/0")
    yield made
    made.close()


@pytest.fixture(scope="module")
def slot(engine: Engine) -> Iterator[Runner]:
    """One warm process for all tests; each gives the runner its database and its shutdown."""
    settings = WorkerSettings(prepare=False, lease_s=60.0, cancel_poll_s=60.0)
    made = Runner(
        engine.database,
        engine.store,
        settings,
        work_dir=engine.settings.work_dir,
        registry=TOYS,
        plan=make_plan(engine.settings, settings, os.environ, has_gpu=False),
        threads=lambda: 1,
        shutdown=threading.Event(),
    )
    yield made
    made.close()


def claimed(engine: Engine, job: str, lease_s: float = 60.0) -> Claim:
    with engine.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job, "ingest"), "w", lease_s)
    assert claim is not None
    return claim


@pytest.mark.parametrize("ends_after", [True, False], ids=["worker ends", "answers later"])
@pytest.mark.parametrize("applied", [True, False], ids=["applied", "not applied"])
@pytest.mark.parametrize("what", ["succeed_stage", "fail_stage"])
def test_what_a_row_names_is_there_whatever_became_of_the_commit(
    engine: Engine,
    slot: Runner,
    monkeypatch: pytest.MonkeyPatch,
    what: str,
    applied: bool,
    ends_after: bool,
) -> None:
    shutdown = threading.Event()
    monkeypatch.setattr(slot, "_shutdown", shutdown)
    monkeypatch.setattr("worker.runner.RECORD_STEP_S", 0.01)
    job = engine.submit({"ingest": {"fail": what == "fail_stage"}}, ring=False)
    claim = claimed(engine, job)

    def lose() -> None:
        if ends_after:
            shutdown.set()
        lose_answer()

    with at_step("finish.committed" if applied else "finish.commit", lose):
        ready = slot.run(claim)
    row = engine.stage(job, "ingest")
    uploaded = list(engine.store.list(keys.attempt_prefix(root_of(job), "ingest", 1, 1)))
    assert uploaded, "what the row may name must not be deleted"
    if ends_after and not applied:
        assert row.state == "running"
        with engine.database.session_scope() as session:
            later = datetime.now(UTC) + timedelta(seconds=61)
            assert reap_expired(session, later) == [claim.stage_id]
        return
    assert row.state == ("succeeded" if what == "succeed_stage" else "failed")
    prefix, files = row.report_prefix, row.report_files
    if what == "succeed_stage":
        assert row.manifest is not None
        prefix, files = row.output_prefix, row.manifest["files"]
    assert files
    for item in files:
        assert engine.store.stat(f"{prefix}{item['path']}").bytes == item["bytes"]
    if what == "succeed_stage" and not ends_after:
        assert ready == [stage_id(job, "frames")]


def test_what_the_database_refuses_is_deleted(
    engine: Engine, slot: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The lease was lost while the stage ran; another claim's files stay."""
    job = engine.submit({}, ring=False)
    claim = claimed(engine, job)
    with engine.database.session_scope() as session:
        reap_expired(session, datetime.now(UTC) + timedelta(seconds=61))
    later = claimed(engine, job)
    other = keys.attempt_prefix(root_of(job), "ingest", later.attempt, later.token)
    engine.store.put_file(f"{other}plan.json", engine.folder / "capture.json")
    assert slot.run(claim) == []
    assert list(engine.store.list(keys.stage_prefix(root_of(job), "ingest"))) == [
        f"{other}plan.json"
    ]


def test_a_worker_that_slept_deletes_nothing_of_a_later_claim(
    engine: Engine, slot: Runner, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It succeeded, was frozen, and meanwhile the job was retried from this stage."""
    job = engine.submit({}, ring=False)
    claim = claimed(engine, job)
    later = keys.attempt_prefix(root_of(job), "ingest", 1, claim.token + 1)
    older = keys.checkpoint_prefix(root_of(job), "ingest", claim.token, 1)
    for prefix in (later, older):
        engine.store.put_file(f"{prefix}file", engine.folder / "capture.json")
    assert slot.run(claim) == [stage_id(job, "frames")]
    kept = list(engine.store.list(keys.stage_prefix(root_of(job), "ingest")))
    assert f"{later}file" in kept
    assert f"{older}file" not in kept


@pytest.mark.parametrize("applied", [True, False])
def test_the_checkpoint_that_a_row_names_outlives_a_commit_in_doubt(
    engine: Engine, tmp_path: Path, applied: bool
) -> None:
    job = engine.submit({}, ring=False)
    claim = claimed(engine, job)

    def save(number: int) -> None:
        folder = tmp_path / f"saved-{number}"
        folder.mkdir()
        (folder / "state").write_text(f"state {number}")
        found = (folder / "state").stat()
        uploader.offer(Snapshot(folder, {"state": [found.st_size, found.st_mtime_ns]}))
        uploader.close(finish=True, timeout_s=10)

    for number in (1, 2, 3):
        uploader = CheckpointUploader(engine.database, engine.store, claim, lambda: None, workers=1)
        uploader._number = number  # as if it were one uploader over time
        if number == 2:
            with at_step("checkpoint.committed" if applied else "checkpoint.commit"):
                save(number)
        else:
            save(number)
        prefix = engine.stage(job, "ingest").checkpoint_prefix
        assert prefix is not None
        named = b"".join(engine.store.read(f"{prefix}state"))
        assert named == (b"state 1" if number == 2 and not applied else b"state %d" % number)
