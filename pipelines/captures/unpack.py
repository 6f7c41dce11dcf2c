"""Reading a checked archive, one entry at a time, with counters instead of trust.

`extractall` is never used: entries are streamed to paths that we choose, and what comes out is
counted against what the directory declared and against the limit for the whole archive.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path
from types import TracebackType
from typing import Any

from pipelines.captures.archive_rules import (
    READ_ERRORS,
    ArchiveLimits,
    checked_entries,
    damaged,
    head_of,
    open_archive,
    shown,
)
from pipelines.captures.magic import image_format
from pipelines.errors import CaptureError

_CHUNK_BYTES = 1 << 20
MAX_JSON_BYTES = 64 << 20


class CaptureArchive:
    """A zip archive, open for reading, as a context. Names are those of its files, with "/".

    Raises CaptureError as `archive_rules.checked_entries` does, and archive_damaged.
    """

    def __init__(self, path: Path, limits: ArchiveLimits) -> None:
        self._limits = limits
        self._unpacked_bytes = 0
        self._zip = open_archive(path)
        try:
            self._entries = checked_entries(self._zip, limits)
            self._formats = {
                name: image_format(head_of(self._zip, info)) for name, info in self._entries.items()
            }
        except BaseException:
            self._zip.close()
            raise

    def __enter__(self) -> CaptureArchive:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self._zip.close()

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

    def extract(self, name: str, target: Path) -> None:
        """Write one entry to `target`.

        Raises CaptureError: archive_bomb where it holds more than it declared or than is allowed,
        archive_damaged. `target` may then be incomplete.
        """
        info = self._entries[name]
        written = 0
        try:
            with self._zip.open(info) as source, target.open("wb") as sink:
                while chunk := source.read(_CHUNK_BYTES):
                    written += len(chunk)
                    self._count(len(chunk), written, info)
                    sink.write(chunk)
        except READ_ERRORS as error:
            raise damaged() from error
        if written != info.file_size:
            raise damaged()

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
        try:
            with self._zip.open(info) as source:
                data = source.read(max_bytes + 1)
        except READ_ERRORS as error:
            raise damaged() from error
        self._count(len(data), len(data), info)
        return data

    def read_json(self, name: str) -> Any:
        """One entry as JSON. Raises CaptureError poses_malformed where it is none."""
        try:
            return json.loads(self.read(name))
        except (ValueError, RecursionError) as error:
            raise CaptureError(
                f'"{shown(name)}" in the archive is not readable JSON.',
                code="poses_malformed",
                hint="Export the capture again from the app.",
            ) from error

    def _count(self, fresh: int, written: int, info: zipfile.ZipInfo) -> None:
        self._unpacked_bytes += fresh
        if written > info.file_size or self._unpacked_bytes > self._limits.max_unpacked_bytes:
            raise CaptureError(
                f"The archive holds more than it declares, or than is allowed, at "
                f'"{shown(info.filename)}".',
                code="archive_bomb",
                hint="Send an archive of photos, or of an app's export, and nothing else.",
            )
