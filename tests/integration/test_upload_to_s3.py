"""`kill -9` of the API while a capture goes to S3 in parts. The client goes on by itself."""

from __future__ import annotations

import hashlib
import random
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from api.client.client import Client
from storage.db import Database
from storage.objects_s3 import S3ObjectStore
from storage.open_objects import open_object_store
from storage.reconciling import sweep_orphans
from tests.integration.victims import api_that_dies, wait_for_death
from tests.services import S3Endpoint, free_port
from tests.unit.api.conftest import KEY, settings_for

pytestmark = pytest.mark.services
PART_BYTES = 16 << 20


def half_done(store: S3ObjectStore, endpoint: S3Endpoint) -> int:
    """Transfers in parts that were begun and not ended."""
    return len(store._client.list_multipart_uploads(Bucket=endpoint.bucket).get("Uploads", []))


def test_an_upload_is_there_once_though_the_api_dies_between_its_parts(
    s3_endpoint: S3Endpoint, tmp_path: Path
) -> None:
    settings = settings_for(
        tmp_path / "home",
        objects_url=f"s3://{s3_endpoint.bucket}/objects",
        s3_endpoint_url=s3_endpoint.url,
        s3_access_key_id=s3_endpoint.access_key_id,
        s3_secret_access_key=s3_endpoint.secret_access_key,
    )
    film = tmp_path / "film.mp4"
    noise = random.Random(3).randbytes(PART_BYTES)
    film.write_bytes(b"\0\0\0\x18ftypisom\0\0\2\0isomiso2" + 2 * noise)  # three parts
    store, log, port = open_object_store(settings), tmp_path / "api.log", free_port()
    assert isinstance(store, S3ObjectStore)
    # It is called for every few KiB that are sent: the third part, the last few bytes, is long
    # sent then, and the others are under way.
    victim = api_that_dies(settings, log, port, "capture.bytes", nth=100)
    with ThreadPoolExecutor(1) as pool, Client(f"http://127.0.0.1:{port}", KEY) as client:
        sent = pool.submit(client.upload, film)
        wait_for_death(victim, log)
        assert half_done(store, s3_endpoint) == 1
        assert list(settings.staging_dir.iterdir()), "what the dead one had received"
        second = api_that_dies(settings, log, port, "delete.commit")  # which never comes
        try:
            capture = sent.result(120)
            assert [one.id for one in client.captures()] == [capture.id]
        finally:
            second.kill()
            second.join()
    assert list(settings.staging_dir.iterdir()) == []
    assert half_done(store, s3_endpoint) == 1, "of the dead one; ours is whole"
    database = Database(settings.resolved_database_url)
    assert sweep_orphans(database, store, when=datetime.now(UTC) + timedelta(hours=25)) == []
    database.dispose()
    assert half_done(store, s3_endpoint) == 0
    (kept,) = (path for path in s3_endpoint.folder.rglob("*") if path.is_file())
    assert hashlib.sha256(kept.read_bytes()).digest() == hashlib.sha256(film.read_bytes()).digest()
