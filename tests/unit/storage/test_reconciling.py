"""What no record names is swept after a day; everything else stays."""

from __future__ import annotations

import secrets
from collections.abc import Iterator
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy.event import listen

from storage.claims import claim_stage
from storage.db import Database, now
from storage.deletions import drain_deletions
from storage.jobs import delete_job, stage_id
from storage.keys import attempt_prefix, blob_content, checkpoint_prefix, folder_of
from storage.leases import succeed_stage
from storage.models import Blob, Capture, PendingDeletion, StageRow, new_id
from storage.objects import ObjectStore
from storage.objects_local import LocalObjectStore
from storage.open_objects import open_object_store
from storage.reconciling import sweep_orphans
from storage.records import append_logs, delete_capture, read_logs
from storage.settings import StorageSettings
from tests.factories import make_capture, make_job, root_of
from tests.services import S3Endpoint


@pytest.fixture(params=["folder", pytest.param("s3", marks=pytest.mark.services)])
def store(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[ObjectStore]:
    """Either kind of store."""
    if request.param == "folder":
        yield LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"")
        return
    endpoint: S3Endpoint = request.getfixturevalue("s3_endpoint")
    yield open_object_store(
        StorageSettings(
            home=tmp_path,
            objects_url=f"s3://{endpoint.bucket}/some/prefix",
            s3_endpoint_url=endpoint.url,
            s3_access_key_id=endpoint.access_key_id,
            s3_secret_access_key=endpoint.secret_access_key,
        )
    )


def put(store: ObjectStore, tmp_path: Path, *keys: str) -> None:
    source = tmp_path / "source"
    source.write_bytes(b"x")
    for key in keys:
        store.put_file(key, source)


def sweep(database: Database, store: ObjectStore, after: timedelta) -> set[str]:
    with database.read_scope() as session:
        when = now(session) + after
    return set(sweep_orphans(database, store, when=when))


def test_what_nobody_names_goes_after_a_day_and_all_else_stays(
    database: Database, store: ObjectStore, tmp_path: Path
) -> None:
    with database.session_scope() as session:
        job = make_job(session)
        capture = session.get_one(Capture, job.capture_id)
        done = claim_stage(session, stage_id(job.id, "first"), "w", 1e6)
        assert done is not None
        kept = attempt_prefix(job.object_root, "first", done.attempt, done.token)
        succeed_stage(session, done, manifest={"files": []}, output_prefix=kept)
        runs = claim_stage(session, stage_id(job.id, "second"), "w", 1e6)
        assert runs is not None
        row = session.get_one(StageRow, runs.stage_id)
        row.checkpoint_prefix = checkpoint_prefix(job.object_root, "second", runs.token, 2)
        dropped = make_job(session)
        delete_capture_later = dropped.capture_id
        gone = session.get_one(Capture, delete_capture_later).object_key
        shared = make_capture(session)
        delete_shared_later = make_capture(session, sha256=shared.sha256).id
        before = make_job(session)  # as the migration leaves one from before there were tenants
        before.object_root = f"jobs/{before.id}/"
        capture_before = session.get_one(Capture, before.capture_id)
        assert capture_before.blob_id is not None
        blob = session.get_one(Blob, capture_before.blob_id)
        blob.object_key = capture_before.object_key = f"captures/{capture_before.id}/content"
        runs_before = claim_stage(session, stage_id(before.id, "first"), "w", 1e6)
        assert runs_before is not None
    named = [
        capture.object_key,
        kept + "a/b",
        checkpoint_prefix(job.object_root, "second", runs.token, 2) + "state",
        attempt_prefix(job.object_root, "second", runs.attempt, runs.token) + "just now",
        shared.object_key,
        capture_before.object_key,
        attempt_prefix(runs_before.root, "first", 1, runs_before.token) + "just now",
        "jobs/not-ours",
        "jobs/x/y/z",
        "other/thing",
        "tenants/thing",
        "tenants/t/other/thing/a/b/c",
    ]
    nobody = new_id()
    orphans = [
        blob_content("default", "0" * 64, nobody),  # the API was killed between put and row
        gone,
        f"captures/{nobody}/content",
        attempt_prefix(f"jobs/{before.id}/", "first", 1, runs_before.token + 1) + "a",
        attempt_prefix(root_of(before.id), "first", 1, runs_before.token) + "a",
        attempt_prefix(job.object_root, "first", done.attempt, done.token + 7) + "a",
        attempt_prefix(job.object_root, "second", 1, runs.token + 1) + "a",
        checkpoint_prefix(job.object_root, "first", done.token, 1) + "state",
        attempt_prefix(root_of(nobody), "first", 1, 1) + "manifest.json",
        attempt_prefix(dropped.object_root, "first", 1, 1) + "manifest.json",
    ]
    put(store, tmp_path, *named, *orphans)
    with database.session_scope() as session:
        delete_job(session, dropped.id)
        delete_capture(session, delete_capture_later)
        delete_capture(session, delete_shared_later)
        for row_to_go in session.query(PendingDeletion):  # as if these had been lost
            session.delete(row_to_go)
    assert sweep(database, store, timedelta(hours=23)) == set()
    assert sweep(database, store, timedelta(hours=25)) == {folder_of(key) for key in orphans}
    assert sweep(database, store, timedelta(hours=25)) == set(), "swept twice"
    while drain_deletions(database, store):
        pass
    assert all(store.exists(key) for key in named)
    assert not any(store.exists(key) for key in orphans)


def test_a_batch_costs_the_same_statements_however_many_folders_it_has(
    database: Database, tmp_path: Path
) -> None:
    """They run under the lock of all writers."""
    store = LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"")
    statements: list[str] = []
    listen(database.engine, "before_cursor_execute", lambda *call: statements.append(call[2]))

    def looks(num_folders: int) -> int:
        folders = [attempt_prefix(root_of(new_id()), "first", 1, 1) for _ in range(num_folders)]
        put(store, tmp_path, *(folder + "manifest.json" for folder in folders))
        statements.clear()
        assert sweep(database, store, timedelta(hours=25)) == set(folders)
        num_looks = sum(text.startswith("SELECT") for text in statements)
        while drain_deletions(database, store):
            pass
        return num_looks

    assert 0 < looks(1) == looks(30)


def test_transfers_that_were_cut_short_are_dropped(database: Database, tmp_path: Path) -> None:
    store = LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"")
    put(store, tmp_path, blob_content("default", "0" * 64, new_id()))
    left = store.root / "tenants" / f"content.{secrets.token_hex(6)}.nerfworks-tmp"
    left.write_bytes(b"half")
    sweep(database, store, timedelta(hours=23))
    assert left.exists()
    sweep(database, store, timedelta(hours=25))
    assert not left.exists()


def test_lines_of_a_claim_that_was_replaced_are_not_kept(either_database: Database) -> None:
    with either_database.session_scope() as session:
        job = make_job(session)
        wanted = stage_id(job.id, "first")
        before = claim_stage(session, wanted, "a", 60.0)
        assert before is not None
        assert append_logs(session, before, ["mine"]) == 1
        session.get_one(StageRow, wanted).lease_token += 1
        session.flush()
        assert append_logs(session, before, ["of a zombie"]) == 0
        assert read_logs(session, job.id).lines == ["mine"]
