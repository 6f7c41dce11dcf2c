"""What an archive must be like before anything in it is used: a zip, or a tar, which is looked at
as if it were one (`pipelines.captures.tar_files`). Standard library only.

An entry's name is only ever looked up, never made into a path of ours; yet an archive with a
hostile name is refused as a whole, since nobody sends one by accident. Headers can lie about
sizes: `pipelines.captures.unpack` counts again while it reads. An archive within is a file as any
other: nothing opens it, so it needs no rules.
"""

from __future__ import annotations

import contextlib
import errno
import io
import re
import stat
import struct
import zipfile
import zlib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

from pipelines.captures.magic import HEAD_BYTES, is_zip
from pipelines.captures.tar_files import TarArchive, is_tar
from pipelines.errors import CaptureError

_READ_ERRORS = (
    zipfile.BadZipFile,
    zlib.error,
    struct.error,
    EOFError,
    IndexError,
    NotImplementedError,
    OverflowError,
    ValueError,
)
"""What `zipfile` raises for an archive that is damaged or lies about itself."""

_LOCAL_HEADER_BYTES = 30
_ENTRY_SIGNATURE = b"PK\x01\x02"
_ENCRYPTED_BITS = 0x1 | 0x40 | 0x2000
_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_SMALL_BYTES = 4 << 20
_COPY_BYTES = 1 << 20
_JUNK_NAMES = frozenset({".DS_Store", "Thumbs.db", "desktop.ini"})


Archive = zipfile.ZipFile | TarArchive


@dataclass(frozen=True)
class ArchiveLimits:
    """How large an archive may be.

    max_ratio: unpacked to packed size, for entries and the whole; pictures hardly shrink at all.
    max_directory_bytes: of the list of entries at its end, which is held in memory.
    """

    max_entries: int = 50_000
    max_directory_bytes: int = 16 * 2**20
    max_unpacked_bytes: int = 20 * 2**30
    max_ratio: float = 100.0


def _unsafe(message: str) -> CaptureError:
    return CaptureError(
        message,
        code="archive_unsafe",
        hint="Make the archive again from the plain folder, with an ordinary zip program.",
    )


def _too_large(message: str) -> CaptureError:
    return _bomb(message, "Send an archive of fewer pictures, and of nothing else.")


def _bomb(message: str, hint: str) -> CaptureError:
    return CaptureError(message, code="archive_bomb", hint=hint)


def shown(name: str) -> str:
    """An entry's name as it may appear in a message: printable, short."""
    clean = "".join(letter if letter.isprintable() else "?" for letter in name)
    return clean if len(clean) <= 80 else clean[:77] + "..."


def is_junk(name: str) -> bool:
    """Whether an entry is an operating system's litter: `__MACOSX/`, `._*`, `.DS_Store`."""
    parts = PurePosixPath(name).parts
    return (
        not parts or "__MACOSX" in parts or parts[-1].startswith("._") or parts[-1] in _JUNK_NAMES
    )


def _name_folders(archive: Archive) -> None:
    """Write the separators of a zip that some Windows programs make, "\\", as all others do.

    The names are checked afterwards, as if they had come so. A tar's stay: none is made that way.
    """
    if isinstance(archive, zipfile.ZipFile):
        for info in archive.infolist():
            info.filename = info.filename.replace("\\", "/")


def _check_name(info: zipfile.ZipInfo) -> None:
    # ZipInfo.filename ends at the first NUL; the name as stored is in orig_filename.
    name = info.filename
    bad = (
        not name
        or "\0" in info.orig_filename
        or "\\" in name
        or name.startswith("/")
        or re.match(r"[A-Za-z]:", name)
        or ".." in name.split("/")
    )
    if bad:
        raise _unsafe(f'The archive has an entry with an unsafe name: "{shown(name)}".')


def _check_type(info: zipfile.ZipInfo) -> None:
    kind = stat.S_IFMT(info.external_attr >> 16)
    if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
        raise _unsafe(f'The archive has a link or a device: "{shown(info.filename)}".')
    if info.flag_bits & _ENCRYPTED_BITS:
        raise CaptureError(
            "The archive is encrypted.",
            code="archive_encrypted",
            hint="Send an archive without a password.",
        )
    if info.compress_type not in _METHODS:
        raise _unsafe(
            f'The archive has an entry packed in an unusual way: "{shown(info.filename)}".'
        )


def _check_sizes(entries: Sequence[zipfile.ZipInfo], limits: ArchiveLimits) -> None:
    total = packed = 0
    for info in entries:
        total += info.file_size
        packed += info.compress_size
        ratio = info.file_size / max(info.compress_size, 1)
        if info.file_size > _SMALL_BYTES and ratio > limits.max_ratio:
            raise _bomb(
                f"The archive has an entry that unpacks to {ratio:.0f} times its size: "
                f'"{shown(info.filename)}".',
                "Send an archive of photos, or of an app's export, and nothing else.",
            )
    if total > limits.max_unpacked_bytes:
        raise _bomb(
            f"The archive unpacks to {total / 2**30:.1f} GiB; "
            f"{limits.max_unpacked_bytes / 2**30:.1f} GiB are allowed.",
            "Send fewer or smaller pictures.",
        )
    if total > _SMALL_BYTES and total / max(packed, 1) > limits.max_ratio:
        raise _bomb(
            f"The archive unpacks to {total / max(packed, 1):.0f} times its size.",
            "Send an archive of photos, or of an app's export, and nothing else.",
        )


def _check_overlap(archive: Archive, entries: Sequence[zipfile.ZipInfo]) -> None:
    """No two entries share bytes: a bomb can otherwise pack one payload under many names."""
    ordered = sorted(entries, key=lambda info: info.header_offset)
    starts = [*(info.header_offset for info in ordered), archive.start_dir][1:]
    for info, next_start in zip(ordered, starts, strict=True):
        end = info.header_offset + _LOCAL_HEADER_BYTES + info.compress_size
        if end > next_start:
            raise _bomb(
                "The archive has entries that share the same bytes.",
                "Make the archive again with an ordinary zip program.",
            )


def _check_duplicates(entries: Sequence[zipfile.ZipInfo]) -> None:
    seen: set[str] = set()
    for info in entries:
        if info.filename in seen:
            raise _unsafe(f'The archive has two entries of one name: "{shown(info.filename)}".')
        seen.add(info.filename)


@contextlib.contextmanager
def reading() -> Iterator[None]:
    """Turns what reading a damaged archive raises into CaptureError archive_damaged.

    Offsets before the file's start end in an OSError: EINVAL from the kernel, or one without a
    number. Any other is the disk's own, and passes.
    """
    try:
        yield
    except _READ_ERRORS as error:
        raise damaged() from error
    except OSError as error:
        if error.errno not in (None, errno.EINVAL):
            raise
        raise damaged() from error


class _CheckedReads(io.BufferedReader):
    """A file whose reads are checked while `zipfile` looks for the list of entries.

    It reads that list whole, in one piece, and makes an object of each entry: 50 times the list's
    size in memory. So what it asks for, and how many entries came, is looked at in between.
    """

    limits: ArchiveLimits | None = None

    def read(self, size: int | None = -1, /) -> bytes:
        """As any file's. Raises CaptureError archive_bomb."""
        if self.limits is None:
            return super().read(size)
        most = self.limits.max_directory_bytes
        found = super().read(most + 1 if size is None or size < 0 else min(size, most + 1))
        if len(found) > most:
            raise _bomb(
                f"The archive's list of entries is larger than {most / 2**20:.0f} MiB.",
                "Send fewer pictures.",
            )
        if found.count(_ENTRY_SIGNATURE) > self.limits.max_entries:
            raise _bomb(
                f"The archive has more than {self.limits.max_entries} entries.",
                "Send fewer pictures.",
            )
        return found


class _Archive(zipfile.ZipFile):
    """A zip that was opened through checked reads; closing it closes the file."""

    def __init__(self, path: Path, limits: ArchiveLimits) -> None:
        self._reads = _CheckedReads(io.FileIO(path))
        self._reads.limits = limits
        try:
            super().__init__(self._reads)
        except BaseException:
            self._reads.close()
            raise
        self._reads.limits = None

    def close(self) -> None:
        """Close the archive and its file."""
        super().close()
        self._reads.close()


def open_archive(path: Path, limits: ArchiveLimits | None = None) -> Archive:
    """Open an archive for reading; of what is in it only the length of its list was checked.

    Raises CaptureError: archive_damaged, archive_bomb.
    """
    limits = limits or ArchiveLimits()
    with reading():
        if not is_tar(path):
            return _Archive(path, limits)
        return TarArchive(
            path,
            max_entries=limits.max_entries,
            max_list_bytes=limits.max_directory_bytes,
            max_bytes=limits.max_unpacked_bytes,
            bomb=_too_large,
        )


def is_archive(path: Path, head: bytes) -> bool:
    """Whether a file that begins like that is an archive that `open_archive` opens."""
    return is_zip(head) or is_tar(path)


def checksum_of(archive: Archive, info: zipfile.ZipInfo) -> int:
    """The CRC-32 of an entry: what a zip declares; in a tar it is counted.

    Raises CaptureError archive_damaged.
    """
    if isinstance(archive, zipfile.ZipFile):
        return info.CRC
    found = 0
    with reading(), archive.open(info) as source:
        while chunk := source.read(_COPY_BYTES):
            found = zlib.crc32(chunk, found)
    return found


def checked_entries(archive: Archive, limits: ArchiveLimits) -> dict[str, zipfile.ZipInfo]:
    """The archive's files by name, litter and folders left out, once all of it was checked.

    Raises CaptureError: archive_unsafe, archive_bomb, archive_encrypted.
    """
    entries = archive.infolist()
    if len(entries) > limits.max_entries:
        raise _bomb(
            f"The archive has {len(entries)} entries; {limits.max_entries} are allowed.",
            "Send fewer pictures.",
        )
    _name_folders(archive)
    for info in entries:
        _check_name(info)
        _check_type(info)
    _check_duplicates(entries)
    _check_sizes(entries, limits)
    _check_overlap(archive, entries)
    return {
        info.filename: info for info in entries if not info.is_dir() and not is_junk(info.filename)
    }


def head_of(archive: Archive, info: zipfile.ZipInfo) -> bytes:
    """The first bytes of an entry. Raises CaptureError where it is damaged."""
    with reading(), archive.open(info) as file:
        return file.read(HEAD_BYTES)


def copy_entry(archive: Archive, info: zipfile.ZipInfo, target: Path) -> None:
    """Write one entry to `target`. Raises CaptureError: archive_damaged, also where it holds more
    or less than it declares."""
    with reading(), archive.open(info) as source, target.open("wb") as sink:
        left = info.file_size
        while chunk := source.read(min(_COPY_BYTES, left + 1)):
            left -= len(chunk)
            if left < 0:
                raise damaged()
            sink.write(chunk)
    if left:
        raise damaged()


def damaged() -> CaptureError:
    """The error for an archive that cannot be read."""
    return CaptureError(
        "The archive is damaged or cut off.",
        code="archive_damaged",
        hint="Make the archive again, or upload it again.",
    )
