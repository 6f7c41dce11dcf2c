"""Reading a checked archive, one entry at a time, with counters instead of trust.

`extractall` is never used: entries are streamed to paths that we choose, and what comes out is
counted against what the directory declared and against the limit for the whole archive.

The archive also keeps account: who reads an entry uses it, who decides against one says why
(`set_aside`), and `unused` is what is left, for `pipelines.captures.leftovers`.
"""

from __future__ import annotations

import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from types import TracebackType
from typing import IO, Any

from pipelines.captures.archive_rules import (
    ArchiveLimits,
    checked_entries,
    checksum_of,
    damaged,
    head_of,
    open_archive,
    reading,
    shown,
)
from pipelines.captures.magic import image_format
from pipelines.errors import CaptureError

_CHUNK_BYTES = 1 << 20
MAX_JSON_BYTES = 64 << 20
MAX_JSON_PARTS = 10_000_000
"""Lists and objects of a JSON file: empty ones take thirty times their bytes."""


class CaptureArchive:
    """An archive, open for reading, as a context. Names are those of its files, with "/".

    Raises CaptureError as `archive_rules.checked_entries` does, and archive_damaged.
    """

    def __init__(self, path: Path, limits: ArchiveLimits) -> None:
        self._limits = limits
        self._unpacked_bytes = 0
        self._counted: dict[str, int] = {}
        self._used: set[str] = set()
        self._set_aside: dict[str, str] = {}
        self._archive = open_archive(path, limits)
        try:
            self._entries = checked_entries(self._archive, limits)
            self._heads = {
                name: head_of(self._archive, info) for name, info in self._entries.items()
            }
            self._formats = {name: image_format(head) for name, head in self._heads.items()}
        except BaseException:
            self._archive.close()
            raise

    def __enter__(self) -> CaptureArchive:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._archive.close()

    @property
    def names(self) -> frozenset[str]:
        """All files in the archive, without the litter of operating systems."""
        return frozenset(self._entries)

    @property
    def images(self) -> frozenset[str]:
        """Those that are pictures by their first bytes."""
        return frozenset(name for name, kind in self._formats.items() if kind)

    def image_format(self, name: str) -> str:
        """Pillow's name of a picture's format. Raises KeyError for what is no picture."""
        kind = self._formats[name]
        if kind is None:
            raise KeyError(name)
        return kind

    def num_bytes(self, name: str) -> int:
        """How many bytes an entry has, unpacked, as the archive declares it."""
        return self._entries[name].file_size

    def checksum(self, name: str) -> int:
        """The CRC-32 of an entry, as a zip declares it. Raises CaptureError archive_damaged."""
        return checksum_of(self._archive, self._entries[name])

    def head(self, name: str) -> bytes:
        """The first bytes of an entry, `magic.HEAD_BYTES` at most."""
        return self._heads[name]

    def set_aside(self, names: Iterable[str], why: str) -> None:
        """Say why entries are not used: the end of "were not used: ...". The first reason stays."""
        for name in names:
            self._set_aside.setdefault(name, why)

    def told(self, names: Iterable[str]) -> None:
        """Say that a warning of its own tells why entries are not used."""
        self._used.update(names)

    @property
    def unused(self) -> dict[str, str]:
        """Entries that nobody has read or told of so far, and why, "" where nobody said."""
        return {
            name: self._set_aside.get(name, "") for name in self._entries if name not in self._used
        }

    def extract(self, name: str, target: Path) -> None:
        """Write one entry to `target`; it counts as used.

        Raises CaptureError: archive_bomb where it holds more than it declared or than is allowed,
        archive_damaged. `target` may then be incomplete.
        """
        self._used.add(name)
        self.copy(name, target)

    def copy(self, name: str, target: Path) -> None:
        """As `extract`, only to look at: the entry does not count as used."""
        info = self._entries[name]
        written = 0
        with reading():
            source = self._archive.open(info)
        with source, target.open("wb") as sink:
            while chunk := self._chunk(source):
                written += len(chunk)
                self._count(written, info)
                sink.write(chunk)
        if written != info.file_size:
            raise damaged()

    def peek(self, name: str, max_bytes: int) -> bytes:
        """An entry's first bytes, only to look at: it does not count as used. Raises as `read`."""
        info = self._entries[name]
        with reading(), self._archive.open(info) as source:
            data = source.read(max_bytes)
        self._count(len(data), info)
        return data

    def read(self, name: str, max_bytes: int = MAX_JSON_BYTES) -> bytes:
        """One small entry as bytes. Raises CaptureError as `extract`, and too_large."""
        info = self._entries[name]
        if info.file_size > max_bytes:
            raise CaptureError(
                f'"{shown(name)}" in the archive has {info.file_size} bytes; '
                f"{max_bytes} are allowed.",
                code="too_large",
                hint="Export the capture again, with fewer frames.",
            )
        self._used.add(name)
        return self.peek(name, max_bytes + 1)

    def read_json(self, name: str, max_bytes: int = MAX_JSON_BYTES) -> Any:
        """One entry as JSON. Raises CaptureError as `read`; poses_malformed where it is none."""
        data = self.read(name, max_bytes)
        if data.count(b"{") + data.count(b"[") > MAX_JSON_PARTS:
            raise CaptureError(
                f'"{shown(name)}" in the archive has more than {MAX_JSON_PARTS} lists and objects.',
                code="too_large",
                hint="Export the capture again, with fewer frames or points.",
            )
        try:
            return json.loads(data)
        except (ValueError, RecursionError) as error:
            raise CaptureError(
                f'"{shown(name)}" in the archive is not readable JSON.',
                code="poses_malformed",
                hint="Export the capture again from the app.",
            ) from error

    def _chunk(self, source: IO[bytes]) -> bytes:
        with reading():
            return source.read(_CHUNK_BYTES)

    def _count(self, unpacked: int, info: zipfile.ZipInfo) -> None:
        """Add what was unpacked of an entry, from its start, to the sum; twice counts once."""
        name = info.filename
        self._unpacked_bytes += max(0, unpacked - self._counted.get(name, 0))
        self._counted[name] = max(unpacked, self._counted.get(name, 0))
        if unpacked > info.file_size or self._unpacked_bytes > self._limits.max_unpacked_bytes:
            raise CaptureError(
                f'The archive holds more than it declares, or than is allowed, at "{shown(name)}".',
                code="archive_bomb",
                hint="Send an archive of photos, or of an app's export, and nothing else.",
            )
