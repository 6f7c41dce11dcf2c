"""Objects as files below one folder; signed URLs are served by the API."""

from __future__ import annotations

import contextlib
import errno
import os
import secrets
import shutil
import stat
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from storage.errors import ObjectMissingError, ObjectStoreError, ObjectStoreFullError
from storage.objects import CHUNK_BYTES, ObjectEntry, ObjectStat, OnBytes, check_key, check_prefix
from storage.signed_urls import SignedObject, make_object_token

_TEMPORARY = ".nerfworks-tmp"
_NO_LINK = (errno.EXDEV, errno.EPERM, errno.EACCES, errno.EMLINK, errno.ENOSYS, errno.EOPNOTSUPP)


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


def _link_file(source: Path, target: Path, on_bytes: OnBytes | None = None) -> bool:
    """Give the file a second name, as `copy_file` would: on disk, and at once.

    False, and nothing is done, on another disk or where a file has one name only.
    """
    temporary = target.with_name(f"{target.name}.{secrets.token_hex(6)}{_TEMPORARY}")
    try:
        with source.open("rb") as file:
            try:
                os.link(source, temporary)
            except OSError as error:
                if error.errno not in _NO_LINK:
                    raise
                return False
            os.fsync(file.fileno())
            if on_bytes is not None:
                on_bytes(os.fstat(file.fileno()).st_size)
        temporary.replace(target)
        return True
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

    def put_file(
        self, key: str, path: Path, on_bytes: OnBytes | None = None, *, final: bool = False
    ) -> None:
        """Store a file's content under a key, replacing what was there.

        A final file becomes the object where both lie on one disk.
        """
        target = self.path_of(key)
        if not path.is_file():
            raise FileNotFoundError(path)
        with _translated(key):
            while True:
                target.parent.mkdir(parents=True, exist_ok=True)
                try:
                    if not (final and _link_file(path, target, on_bytes)):
                        copy_file(path, target, on_bytes)
                    return
                except FileNotFoundError:
                    if target.parent.is_dir():
                        raise  # else a deletion next to us took the folder away: once more

    def copies_into(self, path: Path) -> Path | None:
        """The store's folder, where a final file cannot become an object. It is tried."""
        with _translated("the object store"):
            self.root.mkdir(parents=True, exist_ok=True)
            probe = self.root / f"probe.{secrets.token_hex(6)}{_TEMPORARY}"
            try:
                return None if _link_file(path, probe) else self.root
            finally:
                probe.unlink(missing_ok=True)

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
        return (entry.key for entry in self.list_entries(prefix))

    def list_entries(self, prefix: str) -> Iterator[ObjectEntry]:
        """The same with times; the objects of one folder come one after the other."""
        for path in sorted((self.root / check_prefix(prefix)).rglob("*")):
            try:
                found = path.stat()
            except FileNotFoundError:
                continue  # deleted meanwhile
            if stat.S_ISREG(found.st_mode) and not path.name.endswith(_TEMPORARY):
                key = path.relative_to(self.root).as_posix()
                yield ObjectEntry(key, datetime.fromtimestamp(found.st_mtime, UTC))

    def drop_unfinished(self, before: datetime) -> int:
        """Drop what transfers that were cut short before then left. Returns how many."""
        dropped = 0
        for path in self.root.rglob(f"*{_TEMPORARY}"):
            with contextlib.suppress(FileNotFoundError):
                if path.stat().st_mtime < before.timestamp():
                    path.unlink()
                    dropped += 1
        return dropped

    def signed_url(
        self, key: str, *, expires_s: int, filename: str, media_type: str, sha256: str = ""
    ) -> str:
        """A URL of the API that `verify_object_token` accepts for so many seconds."""
        expires_at = int(time.time()) + expires_s
        signed = SignedObject(check_key(key), filename, media_type, expires_at, sha256)
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
