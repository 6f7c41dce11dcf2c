"""The S3 object store against a real server."""

from __future__ import annotations

import urllib.error
import urllib.request
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from storage.errors import ObjectMissingError, ObjectStoreError
from storage.keys import blob_content
from storage.objects import ObjectStore
from storage.objects_s3 import S3ObjectStore
from storage.open_objects import open_object_store
from storage.settings import StorageSettings
from tests.services import S3Endpoint

pytestmark = pytest.mark.services


@pytest.fixture
def store(s3_endpoint: S3Endpoint, monkeypatch: pytest.MonkeyPatch) -> ObjectStore:
    for name, value in s3_endpoint.environment().items():
        monkeypatch.setenv(name, value)
    return open_object_store(StorageSettings())


def put(store: ObjectStore, tmp_path: Path, key: str, content: bytes) -> None:
    (tmp_path / "source").write_bytes(content)
    store.put_file(key, tmp_path / "source")


def test_what_was_put_comes_back_whole_and_in_ranges(store: ObjectStore, tmp_path: Path) -> None:
    put(store, tmp_path, "jobs/a/ä b.txt", b"0123456789")
    store.get_file("jobs/a/ä b.txt", tmp_path / "new" / "copy")
    assert (tmp_path / "new" / "copy").read_bytes() == b"0123456789"
    assert b"".join(store.read("jobs/a/ä b.txt", 3, 4)) == b"3456"
    assert b"".join(store.read("jobs/a/ä b.txt", 8)) == b"89"
    assert b"".join(store.read("jobs/a/ä b.txt", 0, 0)) == b""
    assert store.stat("jobs/a/ä b.txt").bytes == 10


def test_large_files_go_in_parts(store: ObjectStore, tmp_path: Path) -> None:
    content = bytes(range(256)) * (40 << 12)  # 40 MiB: three parts
    moved: list[int] = []
    (tmp_path / "source").write_bytes(content)
    store.put_file("large", tmp_path / "source", moved.append)
    store.get_file("large", tmp_path / "copy")
    assert (tmp_path / "copy").read_bytes() == content
    assert sum(moved) >= len(content)


def test_a_prefix_is_listed_below_the_service_s_own_and_deleted(
    store: ObjectStore, tmp_path: Path, s3_endpoint: S3Endpoint
) -> None:
    for key in ("jobs/a/x", "jobs/a/deep/y", "jobs/ab/z"):
        put(store, tmp_path, key, b"1")
    assert (s3_endpoint.folder / "objects" / "jobs" / "a" / "x").exists()
    assert sorted(store.list("jobs/a/")) == ["jobs/a/deep/y", "jobs/a/x"]
    store.delete_prefix("jobs/a/")
    assert list(store.list("jobs/")) == ["jobs/ab/z"]
    store.delete("jobs/ab/z")
    assert not store.exists("jobs/ab/z")


def test_a_missing_object_is_said_to_be_missing(store: ObjectStore, tmp_path: Path) -> None:
    with pytest.raises(ObjectMissingError):
        store.stat("nothing")
    with pytest.raises(ObjectMissingError):
        store.get_file("nothing", tmp_path / "copy")
    with pytest.raises(ObjectMissingError):
        list(store.read("nothing"))
    assert not (tmp_path / "copy").exists()


def test_a_presigned_url_downloads_without_keys_and_a_changed_one_does_not(
    store: ObjectStore, tmp_path: Path
) -> None:
    put(store, tmp_path, "jobs/a/mesh.glb", b"glTF")
    url = store.signed_url(
        "jobs/a/mesh.glb", expires_s=60, filename="mesh.glb", media_type="model/gltf-binary"
    )
    with urllib.request.urlopen(url) as answer:
        assert answer.read() == b"glTF"
    with pytest.raises(urllib.error.HTTPError):
        urllib.request.urlopen(url.replace("mesh.glb?", "mesh.glx?", 1))


def test_a_transfer_ends_with_what_its_watcher_raises(store: ObjectStore, tmp_path: Path) -> None:
    class CancelledError(Exception):
        pass

    def stop(count: int) -> None:
        raise CancelledError

    (tmp_path / "source").write_bytes(b"0" * 1000)
    with pytest.raises(CancelledError):
        store.put_file("k", tmp_path / "source", stop)


def test_a_transfer_has_the_time_of_silence_for_its_body_and_short_calls_do_not(
    store: ObjectStore,
) -> None:
    """urllib3 sends a body under the time-out for connecting."""
    assert isinstance(store, S3ObjectStore)
    transfers, quick = store._client.meta.config, store._quick.meta.config
    assert transfers.connect_timeout == transfers.read_timeout == StorageSettings().s3_timeout_s
    assert quick.connect_timeout <= quick.read_timeout < transfers.read_timeout


@pytest.mark.parametrize("prefix", ["", "objects"])
def test_only_our_own_half_done_uploads_are_dropped(
    s3_endpoint: S3Endpoint, monkeypatch: pytest.MonkeyPatch, prefix: str
) -> None:
    """A bucket without a prefix is shared with whoever else writes there."""
    for name, value in s3_endpoint.environment(prefix).items():
        monkeypatch.setenv(name, value)
    store = open_object_store(StorageSettings())
    assert isinstance(store, S3ObjectStore)
    below = f"{prefix}/" if prefix else ""
    keys = (blob_content("t", "c", "n"), "captures/c/content", "jobs/j/train/1-2/model.zip")
    ours = {below + key for key in keys}
    theirs = {below + key for key in ("backups/db.tar", "jobs/notes.txt", "jobs/a/b/c/d")}
    for key in ours | theirs:
        store._client.create_multipart_upload(Bucket=s3_endpoint.bucket, Key=key)

    def begun() -> set[str]:
        answer = store._client.list_multipart_uploads(Bucket=s3_endpoint.bucket)
        return {item["Key"] for item in answer.get("Uploads", [])}

    assert begun() == ours | theirs
    assert store.drop_unfinished(datetime.now(UTC) - timedelta(hours=1)) == 0
    assert store.drop_unfinished(datetime.now(UTC) + timedelta(hours=1)) == len(ours)
    assert begun() == theirs


def test_ping_tells_a_bucket_that_is_not_there(
    store: ObjectStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    store.ping()
    monkeypatch.setenv("NERFWORKS_OBJECTS_URL", "s3://not-there")
    with pytest.raises(ObjectStoreError, match="not-there"):
        open_object_store(StorageSettings()).ping()
