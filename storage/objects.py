"""Bytes under keys: one interface, and the local folder behind it.

`storage.objects_s3` is the same in a bucket, `storage.open_objects` chooses. Keys are relative
POSIX paths made by `storage.keys`. A put is atomic: a reader sees the old object or the new one,
whole. Errors: ObjectMissingError, ObjectStoreFullError, else ObjectStoreError.
"""

from __future__ import annotations

import base64
import binascii
import errno
import hashlib
import hmac
import json
import os
import secrets
import shutil
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from storage.errors import (
    InvalidUrlError,
    ObjectMissingError,
    ObjectStoreError,
    ObjectStoreFullError,
)

CHUNK_BYTES = 1 << 20
_TEMPORARY = ".nerfworks-tmp"

OnBytes = Callable[[int], None]
"""Called with the number of bytes just moved. What it raises ends the transfer."""


@dataclass(frozen=True)
class ObjectStat:
    """Size, and an opaque tag that changes with the content."""

    bytes: int
    etag: str


@dataclass(frozen=True)
class SignedObject:
    """What a local signed URL allows: reading one object, as a download of this name and type."""

    key: str
    filename: str
    media_type: str
    expires_at: int


class ObjectStore(Protocol):
    """Where captures, stage folders and artifacts live."""

    def put_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
        """Store a file's content under a key, replacing what was there."""

    def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
        """Write an object to a file, which appears whole or not at all."""

    def read(self, key: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """The object's bytes from `start`, at most `length`, in chunks."""

    def stat(self, key: str) -> ObjectStat:
        """Size and tag. Raises ObjectMissingError."""

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""

    def delete(self, key: str) -> None:
        """Remove an object; nothing happens where there is none."""

    def delete_prefix(self, prefix: str) -> None:
        """Remove all objects whose keys start with `prefix`, which ends in "/"."""

    def list(self, prefix: str) -> Iterator[str]:
        """The keys that start with `prefix`, which ends in "/"."""

    def signed_url(self, key: str, *, expires_s: int, filename: str, media_type: str) -> str:
        """A URL that lets anyone download this one object for so many seconds."""

    def ping(self) -> None:
        """Raise ObjectStoreError where the store does not answer."""


def check_key(key: str) -> str:
    """The key, if it is a plain relative path. Raises ValueError."""
    parts = key.split("/")
    plain = "\\" not in key and all(char.isprintable() for char in key)
    if not plain or any(part in ("", ".", "..") for part in parts):
        raise ValueError(f"not an object key: {key!r}")
    return key


def check_prefix(prefix: str) -> str:
    """The prefix, if it names a folder of keys. Raises ValueError."""
    if not prefix.endswith("/"):
        raise ValueError(f"a prefix ends in a slash: {prefix!r}")
    check_key(prefix[:-1])
    return prefix


def make_object_token(signing_key: bytes, signed: SignedObject) -> str:
    """The last part of a local signed URL."""
    payload = json.dumps(
        [signed.key, signed.filename, signed.media_type, signed.expires_at],
        separators=(",", ":"),
    ).encode()
    mac = hmac.digest(signing_key, b"nerfworks object url\0" + payload, hashlib.sha256)
    return ".".join(base64.urlsafe_b64encode(part).decode().rstrip("=") for part in (payload, mac))


def verify_object_token(signing_key: bytes, token: str, now_s: float | None = None) -> SignedObject:
    """What a token allows. Raises InvalidUrlError for one that is forged or has expired."""
    try:
        payload, mac = (
            base64.b64decode(part + "=" * (-len(part) % 4), altchars=b"-_", validate=True)
            for part in token.split(".")
        )
    except (ValueError, binascii.Error) as error:
        raise InvalidUrlError("This download link is damaged.") from error
    expected = hmac.digest(signing_key, b"nerfworks object url\0" + payload, hashlib.sha256)
    if not hmac.compare_digest(mac, expected):
        raise InvalidUrlError("This download link is not valid.")
    signed = SignedObject(*json.loads(payload))
    if (time.time() if now_s is None else now_s) > signed.expires_at:
        raise InvalidUrlError("This download link has expired.")
    return signed


@contextmanager
def _translated(key: str) -> Iterator[None]:
    try:
        yield
    except FileNotFoundError as error:
        raise ObjectMissingError(f"There is no object {key}.") from error
    except OSError as error:
        if error.errno in (errno.ENOSPC, errno.EDQUOT):
            raise ObjectStoreFullError(f"No room left for {key}.") from error
        raise ObjectStoreError(f"{key}: {error.strerror}") from error


def copy_file(source: Path, target: Path, on_bytes: OnBytes | None = None) -> None:
    """Copy so that `target` appears whole, on disk, or not at all."""
    temporary = target.with_name(f"{target.name}.{secrets.token_hex(6)}{_TEMPORARY}")
    try:
        with source.open("rb") as reader, temporary.open("xb") as writer:
            while chunk := reader.read(CHUNK_BYTES):
                writer.write(chunk)
                if on_bytes is not None:
                    on_bytes(len(chunk))
            writer.flush()
            os.fsync(writer.fileno())
        temporary.replace(target)
    finally:
        temporary.unlink(missing_ok=True)


class LocalObjectStore:
    """Objects as files below one folder; signed URLs are served by the API."""

    def __init__(self, root: Path, *, public_url: str, signing_key: bytes) -> None:
        self.root = root
        self._public_url = public_url.rstrip("/")
        self._signing_key = signing_key

    def path_of(self, key: str) -> Path:
        """Where the object lies, or would lie."""
        return self.root / check_key(key)

    def put_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
        """Store a file's content under a key, replacing what was there."""
        target = self.path_of(key)
        if not path.is_file():
            raise FileNotFoundError(path)
        with _translated(key):
            while True:
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    return copy_file(path, target, on_bytes)
                except FileNotFoundError:
                    if target.parent.is_dir():
                        raise  # else a deletion next to us took the folder away: once more

    def get_file(self, key: str, path: Path, on_bytes: OnBytes | None = None) -> None:
        """Write an object to a file, which appears whole or not at all."""
        with _translated(key):
            source = self.path_of(key)
            if not source.is_file():
                raise FileNotFoundError(key)
            path.parent.mkdir(parents=True, exist_ok=True)
            copy_file(source, path, on_bytes)

    def read(self, key: str, start: int = 0, length: int | None = None) -> Iterator[bytes]:
        """The object's bytes from `start`, at most `length`, in chunks."""
        with _translated(key), self.path_of(key).open("rb") as file:
            file.seek(start)
            left = length
            while left is None or left > 0:
                chunk = file.read(CHUNK_BYTES if left is None else min(CHUNK_BYTES, left))
                if not chunk:
                    return
                left = None if left is None else left - len(chunk)
                yield chunk

    def stat(self, key: str) -> ObjectStat:
        """Size and tag. Raises ObjectMissingError."""
        with _translated(key):
            found = self.path_of(key).stat()
        return ObjectStat(found.st_size, f"{found.st_size:x}-{found.st_mtime_ns:x}")

    def exists(self, key: str) -> bool:
        """Whether there is such an object."""
        return self.path_of(key).is_file()

    def delete(self, key: str) -> None:
        """Remove an object; nothing happens where there is none."""
        with _translated(key):
            self.path_of(key).unlink(missing_ok=True)

    def delete_prefix(self, prefix: str) -> None:
        """Remove all objects whose keys start with `prefix`, which ends in "/"."""
        folder = self.root / check_prefix(prefix)
        with _translated(prefix):
            for _ in range(5):  # again where a straggler wrote meanwhile
                shutil.rmtree(folder, ignore_errors=True)
                if not folder.exists():
                    return
            shutil.rmtree(folder)

    def list(self, prefix: str) -> Iterator[str]:
        """The keys that start with `prefix`, which ends in "/"."""
        for path in sorted((self.root / check_prefix(prefix)).rglob("*")):
            if path.is_file() and not path.name.endswith(_TEMPORARY):
                yield path.relative_to(self.root).as_posix()

    def signed_url(self, key: str, *, expires_s: int, filename: str, media_type: str) -> str:
        """A URL of the API that `verify_object_token` accepts for so many seconds."""
        expires_at = int(time.time()) + expires_s
        signed = SignedObject(check_key(key), filename, media_type, expires_at)
        return f"{self._public_url}/v1/objects/{make_object_token(self._signing_key, signed)}"

    def ping(self) -> None:
        """Raise ObjectStoreError where the folder cannot be written."""
        with _translated("the object store"):
            self.root.mkdir(parents=True, exist_ok=True)
            probe = self.root / f"ping.{secrets.token_hex(6)}{_TEMPORARY}"
            try:
                probe.write_bytes(b"ok")
            finally:
                probe.unlink(missing_ok=True)
