"""Bytes under keys: the one interface, and what a key is.

`storage.objects_local` is a folder, `storage.objects_s3` a bucket, `storage.open_objects` chooses.
Keys are relative POSIX paths made by `storage.keys`. A put is atomic: a reader sees the old object
or the new one, whole. Errors: ObjectMissingError, ObjectStoreFullError, else ObjectStoreError.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Protocol

CHUNK_BYTES = 1 << 20

OnBytes = Callable[[int], None]
"""Called with the number of bytes just moved. What it raises ends the transfer."""


@dataclass(frozen=True)
class ObjectStat:
    """Size, and an opaque tag that changes with the content."""

    bytes: int
    etag: str


@dataclass(frozen=True)
class ObjectEntry:
    """An object in a list, and when it was written (UTC)."""

    key: str
    modified_at: datetime


class ObjectStore(Protocol):
    """Where captures, stage folders and artifacts live."""

    def put_file(
        self, key: str, path: Path, on_bytes: OnBytes | None = None, *, final: bool = False
    ) -> None:
        """Store a file's content under a key, replacing what was there.

        final: nobody writes to the file any more, so that the store may hold it instead of a copy.
        The caller removes its name all the same.
        """

    def copies_into(self, path: Path) -> Path | None:
        """The folder of this machine into which a final file would be copied; None where storing
        it takes no room here beside its own."""

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

    def list_entries(self, prefix: str) -> Iterator[ObjectEntry]:
        """The same with times; the objects of one folder come one after the other."""

    def drop_unfinished(self, before: datetime) -> int:
        """Drop what transfers that were cut short before then left. Returns how many."""

    def signed_url(
        self, key: str, *, expires_s: int, filename: str, media_type: str, sha256: str = ""
    ) -> str:
        """A URL that lets anyone download this one object for so many seconds.

        sha256: of its content, for an answer's ETag where that is ours to give.
        """

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
