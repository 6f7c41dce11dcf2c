"""The local object store, its keys and its signed URLs."""

from __future__ import annotations

import base64
import errno
import hmac
import json
import os
from pathlib import Path

import pytest

from storage.errors import (
    InvalidUrlError,
    ObjectMissingError,
    ObjectStoreError,
    ObjectStoreFullError,
)
from storage.objects import check_key
from storage.objects_local import LocalObjectStore
from storage.open_objects import open_object_store
from storage.settings import StorageSettings
from storage.signed_urls import SignedObject, make_object_token, verify_object_token

KEY = b"signing key"


@pytest.fixture
def store(tmp_path: Path) -> LocalObjectStore:
    return LocalObjectStore(tmp_path / "objects", public_url="http://host:1/", signing_key=KEY)


def put(store: LocalObjectStore, tmp_path: Path, key: str, content: bytes) -> None:
    source = tmp_path / "source"
    source.write_bytes(content)
    store.put_file(key, source)


def test_what_was_put_comes_back_whole_and_in_ranges(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    put(store, tmp_path, "jobs/a/ä b.txt", b"0123456789")
    store.get_file("jobs/a/ä b.txt", tmp_path / "new" / "copy")
    assert (tmp_path / "new" / "copy").read_bytes() == b"0123456789"
    assert b"".join(store.read("jobs/a/ä b.txt", 3, 4)) == b"3456"
    assert b"".join(store.read("jobs/a/ä b.txt", 8)) == b"89"
    assert store.stat("jobs/a/ä b.txt").bytes == 10


def test_a_new_content_has_a_new_tag(store: LocalObjectStore, tmp_path: Path) -> None:
    put(store, tmp_path, "k", b"one")
    before = store.stat("k").etag
    put(store, tmp_path, "k", b"three")
    assert store.stat("k").etag != before


def test_listing_and_deleting_a_prefix_leave_its_neighbours(
    store: LocalObjectStore, tmp_path: Path
) -> None:
    for key in ("jobs/a/x", "jobs/a/deep/y", "jobs/ab/z"):
        put(store, tmp_path, key, b"1")
    assert list(store.list("jobs/a/")) == ["jobs/a/deep/y", "jobs/a/x"]
    store.delete_prefix("jobs/a/")
    store.delete_prefix("jobs/a/")
    assert list(store.list("jobs/")) == ["jobs/ab/z"]
    store.delete("jobs/ab/z")
    store.delete("jobs/ab/z")
    assert not store.exists("jobs/ab/z")


def test_a_missing_object_is_said_to_be_missing(store: LocalObjectStore, tmp_path: Path) -> None:
    with pytest.raises(ObjectMissingError):
        store.stat("nothing")
    with pytest.raises(ObjectMissingError):
        store.get_file("nothing", tmp_path / "copy")
    with pytest.raises(ObjectMissingError):
        list(store.read("nothing"))
    assert not (tmp_path / "copy").exists()


@pytest.mark.parametrize(
    "key", ["", "/etc/passwd", "../up", "a/../b", "a//b", "a/./b", "a\\b", "a\nb", "a/"]
)
def test_keys_that_could_leave_the_folder_are_refused(key: str) -> None:
    with pytest.raises(ValueError, match="not an object key"):
        check_key(key)


@pytest.mark.parametrize(
    ("number", "expected"),
    [(errno.ENOSPC, ObjectStoreFullError), (errno.EIO, ObjectStoreError)],
)
@pytest.mark.parametrize("final", [False, True])
def test_a_failed_put_leaves_the_old_object_and_no_scraps(
    store: LocalObjectStore, tmp_path: Path, number: int, expected: type[Exception], final: bool
) -> None:
    put(store, tmp_path, "a/k", b"old")

    def fail(count: int) -> None:
        raise OSError(number, "as the disk would say")

    (tmp_path / "source").write_bytes(b"new")
    with pytest.raises(expected):
        store.put_file("a/k", tmp_path / "source", fail, final=final)
    assert b"".join(store.read("a/k")) == b"old"
    assert [path.name for path in (store.root / "a").iterdir()] == ["k"]


def test_a_final_file_takes_no_room_of_its_own(store: LocalObjectStore, tmp_path: Path) -> None:
    put(store, tmp_path, "a/copy", b"x")
    put(store, tmp_path, "a/k", b"old")
    source, moved = tmp_path / "source", list[int]()
    source.write_bytes(b"new")
    assert store.copies_into(source) is None
    for _ in range(2):  # the same file once more, too
        store.put_file("a/k", source, moved.append, final=True)
    store.put_file("a/other", source, final=True)
    assert moved == [3, 3]
    assert store.path_of("a/k").samefile(source)
    assert not store.path_of("a/copy").samefile(source)
    source.unlink()
    store.delete("a/other")
    assert b"".join(store.read("a/k")) == b"new"
    assert sorted(path.name for path in store.root.rglob("*")) == ["a", "copy", "k"]


@pytest.mark.parametrize("number", [errno.EXDEV, errno.EPERM, errno.EOPNOTSUPP])
def test_a_final_file_that_cannot_be_linked_is_copied(
    store: LocalObjectStore, tmp_path: Path, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(source: Path, target: Path) -> None:
        raise OSError(number, "as the disk would say")

    monkeypatch.setattr(os, "link", refuse)
    source = tmp_path / "source"
    source.write_bytes(b"new")
    assert store.copies_into(source) == store.root
    store.put_file("a/k", source, final=True)
    assert not store.path_of("a/k").samefile(source)
    assert b"".join(store.read("a/k")) == b"new"
    assert sorted(path.name for path in store.root.rglob("*")) == ["a", "k"]


def test_a_signed_url_allows_one_object_for_a_time(store: LocalObjectStore) -> None:
    url = store.signed_url("jobs/a/x", expires_s=60, filename="mesh ä.glb", media_type="model/x")
    assert url.startswith("http://host:1/v1/objects/")
    token = url.rpartition("/")[2]
    signed = verify_object_token(KEY, token)
    assert (signed.key, signed.filename, signed.media_type) == ("jobs/a/x", "mesh ä.glb", "model/x")
    with pytest.raises(InvalidUrlError, match="expired"):
        verify_object_token(KEY, token, now_s=signed.expires_at + 1)
    with pytest.raises(InvalidUrlError, match="not valid"):
        verify_object_token(b"another key", token)


def test_a_url_of_a_later_version_that_says_more_is_good() -> None:
    payload = json.dumps(["jobs/a/x", "x", "model/x", 2**40, "0" * 64, "more"]).encode()
    mac = hmac.digest(KEY, b"nerfworks object url\0" + payload, "sha256")
    token = ".".join(base64.urlsafe_b64encode(part).decode().rstrip("=") for part in (payload, mac))
    assert verify_object_token(KEY, token).key == "jobs/a/x"


@pytest.mark.parametrize(
    ("settings", "environment", "region"),
    [
        ({}, {}, "us-east-1"),
        ({}, {"AWS_REGION": "eu-central-1"}, "eu-central-1"),
        ({}, {"AWS_DEFAULT_REGION": "eu-west-3"}, "eu-west-3"),
        ({"s3_region": "ap-south-1"}, {"AWS_REGION": "eu-central-1"}, "ap-south-1"),
        ({"s3_endpoint_url": "http://own:9"}, {"AWS_REGION": "eu-central-1"}, "us-east-1"),
    ],
)
def test_a_bucket_is_where_the_settings_or_amazons_own_say(
    monkeypatch: pytest.MonkeyPatch,
    settings: dict[str, str],
    environment: dict[str, str],
    region: str,
) -> None:
    for name in ("AWS_REGION", "AWS_DEFAULT_REGION", "AWS_PROFILE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_CONFIG_FILE", os.devnull)
    for name, value in environment.items():
        monkeypatch.setenv(name, value)
    keys = {"s3_access_key_id": "id", "s3_secret_access_key": "secret"}
    store = open_object_store(
        StorageSettings.model_validate({"objects_url": "s3://bucket", **keys, **settings})
    )
    url = store.signed_url("a", expires_s=60, filename="a", media_type="model/x")
    assert f"%2F{region}%2Fs3%2F" in url


def test_a_url_of_before_there_were_digests_in_it_is_good_until_it_expires() -> None:
    payload = json.dumps(["jobs/a/x", "x", "model/x", 2**40]).encode()
    mac = hmac.digest(KEY, b"nerfworks object url\0" + payload, "sha256")
    token = ".".join(base64.urlsafe_b64encode(part).decode().rstrip("=") for part in (payload, mac))
    assert verify_object_token(KEY, token) == SignedObject("jobs/a/x", "x", "model/x", 2**40)


def test_a_forged_or_damaged_token_is_refused() -> None:
    token = make_object_token(KEY, SignedObject("a", "b", "c", 2**40))
    other = make_object_token(KEY, SignedObject("z", "b", "c", 2**40))
    mixed = f"{other.partition('.')[0]}.{token.partition('.')[2]}"
    for wrong in ("", ".", "a.b.c", token[:-3], token + "!", mixed, "é.é"):
        with pytest.raises(InvalidUrlError):
            verify_object_token(KEY, wrong)


def test_ping_makes_the_folder_and_fails_where_it_cannot(tmp_path: Path) -> None:
    LocalObjectStore(tmp_path / "new", public_url="", signing_key=KEY).ping()
    (tmp_path / "file").write_text("")
    with pytest.raises(ObjectStoreError):
        LocalObjectStore(tmp_path / "file" / "below", public_url="", signing_key=KEY).ping()


def test_the_embedded_store_and_its_key_live_below_home(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.delenv("NERFWORKS_SECRET_KEY", raising=False)
    monkeypatch.delenv("NERFWORKS_OBJECTS_URL", raising=False)
    settings = StorageSettings(home=tmp_path / "home with ä")
    store = open_object_store(settings)
    assert isinstance(store, LocalObjectStore)
    assert store.root == tmp_path / "home with ä" / "objects"
    assert settings.signing_key() == settings.signing_key()
    assert (settings.home / "signing.key").stat().st_mode & 0o077 == 0
    with pytest.raises(ValueError, match="OBJECTS_URL"):
        open_object_store(StorageSettings(home=tmp_path, objects_url="ftp://x"))
