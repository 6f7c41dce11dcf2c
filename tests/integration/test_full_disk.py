"""A disk that is really full, at each write that the service makes; and then has room again.

Whoever asks is told what is wrong, nothing half-written is listed, and no work is lost for it.
"""

from __future__ import annotations

import errno
import os
import secrets
import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import pytest
from sqlalchemy import event

from deploy.embedded import free_port
from storage.claims import claim_stage
from storage.errors import ObjectStoreFullError
from storage.jobs import stage_id
from storage.objects_local import LocalObjectStore
from tests.integration.engine import Engine
from tests.small_disk import FILLER, fill, free, small_disk
from tests.unit.api.conftest import problem, serving, settings_for
from worker.checkpoints import CheckpointUploader, Snapshot
from worker.outcomes import failure_of
from worker.transfer import publish_folder

pytestmark = pytest.mark.services
DISK_BYTES = 12 << 20
FILE_BYTES = 1 << 20


@pytest.fixture
def disk() -> Iterator[Path]:
    with small_disk(DISK_BYTES) as folder:
        yield folder


@pytest.mark.parametrize("has_links", [True, False])
def test_an_upload_to_a_full_disk_is_told_so_and_leaves_nothing(
    disk: Path, tmp_path: Path, has_links: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Where it comes in and where it is stored are on it: with links it takes its size once."""
    home = tmp_path / "home"
    home.mkdir()
    (disk / "staging").mkdir()
    (home / "staging").symlink_to(disk / "staging")

    def files() -> set[Path]:
        folders = (disk / "staging", disk / "objects")
        return {path for one in folders for path in one.rglob("*") if path.is_file()}

    with serving(settings_for(home, objects_url=(disk / "objects").as_uri())) as service:
        if not has_links:
            forbid_links(monkeypatch)
        service.upload()
        film = b"\0\0\0\x18ftypisom\0\0\2\0isomiso2" + secrets.token_bytes(FILE_BYTES)
        once = {"Idempotency-Key": "one-film"}

        def send(content: bytes) -> httpx.Response:
            files = {"file": ("film.mp4", content)}
            return service.http.post("/v1/captures", files=files, headers=once)

        before = files()
        fill(disk)
        assert problem(send(film), 507, "disk_full")["hint"]
        (disk / FILLER).open("rb+").truncate(DISK_BYTES - FILE_BYTES - FILE_BYTES // 2)
        if has_links:
            made = send(film)
            assert made.status_code == 201, made.text
            (stored,) = files() - before
            assert (stored.read_bytes(), stored.stat().st_nlink) == (film, 1)
            return
        problem(send(film), 507, "disk_full")  # it would come in, and not fit into the store
        assert files() == before
        assert len(service.http.get("/v1/captures").json()["items"]) == 1
        free(disk)
        assert send(film).status_code == 201


def test_an_upload_leaves_free_what_it_must_where_it_is_stored(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It comes in on another disk, and is copied."""
    objects, film = disk / "objects", b"\0\0\0\x18ftypisom" + secrets.token_bytes(FILE_BYTES)
    settings = settings_for(
        tmp_path / "home", objects_url=objects.as_uri(), min_free_bytes=DISK_BYTES - FILE_BYTES
    )
    with serving(settings) as service:
        monkeypatch.setattr(LocalObjectStore, "put_file", None)  # it does not come so far
        answer = service.http.post("/v1/captures", files={"file": ("film.mp4", film)})
        problem(answer, 507, "disk_full")


def forbid_links(monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a file system that has none."""

    def refuse(source: Path, target: Path) -> None:
        raise OSError(errno.EPERM, "Operation not permitted")

    monkeypatch.setattr(os, "link", refuse)


def test_a_database_on_a_full_disk_is_told_so_and_still_read(tmp_path: Path) -> None:
    """SQLite itself says so when it may not grow any more."""
    with serving(settings_for(tmp_path / "home")) as service:
        job = service.job()
        body = {"capture_id": job["capture_id"]}
        engine = service.services.database.engine
        with engine.connect() as connection:
            pages = int(connection.exec_driver_sql("PRAGMA page_count").scalar_one())

        def limit(connection: Any, record: Any) -> None:
            connection.execute(f"PRAGMA max_page_count = {pages + 8}")

        event.listen(engine, "connect", limit)
        engine.dispose()
        made = 1
        while (answer := service.http.post("/v1/jobs", json=body)).status_code == 202:
            made += 1
            assert made < 100, "the database still grows"
        assert problem(answer, 507, "disk_full")["hint"]
        assert service.http.get(f"/v1/jobs/{job['id']}").status_code == 200
        assert len(service.http.get("/v1/jobs").json()["items"]) == made
        event.remove(engine, "connect", limit)
        engine.dispose()
        assert service.http.post("/v1/jobs", json=body).status_code == 202


def folder_of_results(folder: Path) -> Path:
    folder.mkdir()
    (folder / "manifest.json").write_text("{}")
    (folder / "model").write_bytes(secrets.token_bytes(FILE_BYTES))
    return folder


def test_what_a_stage_made_waits_for_room_in_the_store(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("worker.transfer.ROOM_STEP_S", 0.1)
    store = LocalObjectStore(disk / "objects", public_url="", signing_key=b"")
    store.ping()
    made, full = folder_of_results(tmp_path / "made"), threading.Event()
    fill(disk)
    with ThreadPoolExecutor(1) as pool:
        done = pool.submit(
            publish_folder, store, made, "p/", lambda: None, full.set, workers=2, expected=()
        )
        try:
            assert full.wait(60)
            assert not list(store.list("p/")), "half a result"
        finally:
            free(disk)
        done.result(60)
    for path in made.iterdir():
        assert b"".join(store.read(f"p/{path.name}")) == path.read_bytes()


def test_a_store_that_stays_full_ends_the_attempt_and_a_cancel_ends_the_wait(
    disk: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    store = LocalObjectStore(disk / "objects", public_url="", signing_key=b"")
    store.ping()
    made = folder_of_results(tmp_path / "made")
    fill(disk)
    monkeypatch.setattr("worker.transfer.ROOM_WAIT_S", 0.0)
    with pytest.raises(ObjectStoreFullError) as raised:
        publish_folder(store, made, "p/", lambda: None, lambda: None, workers=1, expected=())
    monkeypatch.undo()
    told = failure_of("train", raised.value)
    assert (told["code"], told["retryable"]) == ("disk_full", True)
    assert told["hint"]
    waits = threading.Event()

    def guard() -> None:
        if waits.is_set():
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        publish_folder(store, made, "p/", guard, waits.set, workers=1, expected=())


def test_a_checkpoint_that_finds_no_room_leaves_the_one_before(disk: Path, tmp_path: Path) -> None:
    redis_url = f"redis://127.0.0.1:{free_port()}/0"
    engine = Engine(tmp_path, redis_url, NERFWORKS_OBJECTS_URL=(disk / "objects").as_uri())
    try:
        job = engine.submit({}, ring=False)
        with engine.database.session_scope() as session:
            claim = claim_stage(session, stage_id(job, "ingest"), "w", 600.0)
        assert claim is not None
        contents = [secrets.token_bytes(FILE_BYTES) for _ in range(3)]
        kept = (0, 0, 2)
        for number, content in enumerate(contents):
            folder = tmp_path / f"saved-{number}"
            folder.mkdir()
            (folder / "state").write_bytes(content)
            found = (folder / "state").stat()
            uploader = CheckpointUploader(
                engine.database, engine.store, claim, lambda: None, workers=1
            )
            uploader._number = number  # as if it were one uploader over time
            if number == 1:
                fill(disk)
            uploader.offer(Snapshot(folder, {"state": [found.st_size, found.st_mtime_ns]}))
            uploader.close(finish=True, timeout_s=60)
            if number == 1:
                free(disk)
            prefix = engine.stage(job, "ingest").checkpoint_prefix
            assert prefix is not None
            assert b"".join(engine.store.read(f"{prefix}state")) == contents[kept[number]]
    finally:
        engine.close()
