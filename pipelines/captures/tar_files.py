"""Tar archives, plain or packed by gzip, as a zip looks to `pipelines.captures.archive_rules`: the
rules are the same, and so is their code.

Headers are read here and not by `tarfile`, which takes whole extended headers into memory, however
long they say they are, and follows their numbers anywhere. Understood are files and folders of
ustar with GNU's long names and POSIX's extended headers; all else, as links, devices and sparse
files, is told as what it is. Of a gzipped one a plain copy is made beside it while it is open, in a
file without a name, and no larger than pictures can be. Standard library only.

Source: POSIX.1-2017, "pax", and the GNU tar manual, "Basic Tar Format".
"""

from __future__ import annotations

import io
import stat
import tempfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import IO

BLOCK_BYTES = 512
_GZIP = b"\x1f\x8b\x08"
_CHUNK_BYTES = 1 << 20
_HEAD_BYTES = 256 << 10
"""Of a gzipped file, where its first block must be: before it may come names, an extra field of
64 KiB, and members with nothing in them."""
_FIRST_PIECE_BYTES = 1 << 10
_SHORT_MEMBERS = 1000
"""How many members with less than a block of a tar in them a gzipped file may have in a row; longer
ones make up for one of them a block. Each costs time, and no program packs less than a block."""
_SMALL_BYTES = 4 << 20
_MOST_GZIP_RATIO = 20.0
"""Unpacked to packed size of a gzipped tar: pictures hardly shrink at all, and what is unpacked
takes room on the disk before anything is known of it."""
_KINDS = {b"0": stat.S_IFREG, b"\0": stat.S_IFREG, b"7": stat.S_IFREG, b"5": stat.S_IFDIR}
_LONG_NAME, _LONG_LINK, _EXTENDED, _OF_ALL = b"L", b"K", b"x", b"g"

_OTHERS = 4
"""Headers of headers that an entry may have."""

Bomb = Callable[[str], Exception]
"""Makes the error for what is larger than it may be."""


def is_gzip(head: bytes) -> bool:
    """Whether the bytes open a file that gzip packed."""
    return head.startswith(_GZIP)


def is_header(block: bytes) -> bool:
    """Whether these 512 bytes are a tar's header, by their sum."""
    if len(block) < BLOCK_BYTES or not block[0]:
        return False
    try:
        return _octal(block[148:156]) == _sum_of(block)
    except ValueError:
        return False


def is_tar(path: Path) -> bool:
    """Whether a file is a tar, plain or gzipped."""
    with path.open("rb") as file:
        block = file.read(BLOCK_BYTES)
        if is_gzip(block):
            head, block = io.BytesIO(block + file.read(_HEAD_BYTES)), b""
            try:
                for chunk in _unpacked(head, BLOCK_BYTES, EOFError):
                    block += chunk
                    if len(block) >= BLOCK_BYTES:
                        break
            except (EOFError, zlib.error):
                return False
            block = block[:BLOCK_BYTES]
    return is_header(block)


class TarArchive:
    """A tar, open for reading, as a context; what `zipfile.ZipFile` offers as far as it is used.

    max_entries, max_list_bytes: of the headers, which are held in memory. max_bytes: of the whole.
    Raises what `bomb` makes, and ValueError, OSError, EOFError or zlib.error for a damaged one.
    """

    def __init__(
        self, path: Path, *, max_entries: int, max_list_bytes: int, max_bytes: int, bomb: Bomb
    ) -> None:
        self._file = _plain(path, max_bytes, bomb)
        try:
            self._file.seek(0, io.SEEK_END)
            self.start_dir = self._file.tell()
            self._entries: list[zipfile.ZipInfo] = []
            self._starts: dict[str, int] = {}
            limits = max_entries, max_list_bytes
            for info, start in _listed(self._file, self.start_dir, limits, bomb):
                self._entries.append(info)
                self._starts[info.filename] = start
        except BaseException:
            self._file.close()
            raise

    def __enter__(self) -> TarArchive:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def infolist(self) -> list[zipfile.ZipInfo]:
        """The entries, in the words of a zip. They declare no checksum."""
        return self._entries

    def open(self, info: zipfile.ZipInfo) -> IO[bytes]:
        """An entry's content. Several may be open at once."""
        return io.BufferedReader(_Part(self._file, self._starts[info.filename], info.file_size))


class _Part(io.RawIOBase):
    """A stretch of a file."""

    def __init__(self, file: IO[bytes], start: int, size: int) -> None:
        self._file, self._place, self._left = file, start, size

    def readable(self) -> bool:
        """Yes."""
        return True

    def readinto(self, buffer: bytearray | memoryview, /) -> int:  # type: ignore[override]
        """As any file's."""
        self._file.seek(self._place)
        found = self._file.read(min(len(buffer), self._left))
        buffer[: len(found)] = found
        self._place += len(found)
        self._left -= len(found)
        return len(found)


def _plain(path: Path, max_bytes: int, bomb: Bomb) -> IO[bytes]:
    """The tar itself, unpacked where it is gzipped."""
    file = path.open("rb")
    if not is_gzip(file.read(len(_GZIP))):
        return file
    most = min(max_bytes, max(_SMALL_BYTES, int(_MOST_GZIP_RATIO * path.stat().st_size)))
    with file:
        file.seek(0)
        plain = tempfile.TemporaryFile(dir=path.parent)  # noqa: SIM115
        try:
            for chunk in _unpacked(file, _CHUNK_BYTES, bomb):
                if plain.tell() + len(chunk) > most:
                    raise bomb(f"The archive unpacks to more than {most / 2**20:.0f} MiB.")
                plain.write(chunk)
        except BaseException:
            plain.close()
            raise
    return plain


def _unpacked(file: IO[bytes], chunk_bytes: int, bomb: Bomb) -> Iterator[bytes]:
    """What gzip packed, in pieces. Not by `gzip`, which looks for the end of a name in a header one
    byte at a time, however far away that is. Raises EOFError, zlib.error, and what `bomb` makes.

    A member is fed in pieces that begin small: what it leaves of the last one is copied.
    """
    packed, place, spare = file.read(_CHUNK_BYTES), 0, _SHORT_MEMBERS
    while True:
        stream = zlib.decompressobj(wbits=31)
        piece_bytes, num_bytes = _FIRST_PIECE_BYTES, 0
        while not stream.eof:
            if place == len(packed):
                packed, place = file.read(_CHUNK_BYTES), 0
            piece = packed[place : place + piece_bytes]
            if not piece:
                raise EOFError("cut off")
            if chunk := stream.decompress(piece, chunk_bytes):
                num_bytes += len(chunk)
                yield chunk
            # A member that ends as it is drained leaves its last tail in both.
            left = stream.unused_data if stream.eof else stream.unconsumed_tail
            place += len(piece) - len(left)
            piece_bytes = min(2 * piece_bytes, _CHUNK_BYTES)
        spare = min(spare + num_bytes // BLOCK_BYTES, _SHORT_MEMBERS) - 1
        if spare < 0:
            raise bomb("The archive is packed in many pieces with next to nothing in them.")
        if len(packed) - place < len(_GZIP):
            packed, place = packed[place:] + file.read(_CHUNK_BYTES), 0
        if not packed.startswith(_GZIP, place):  # the end, or what some programs fill up with
            return


def _listed(
    file: IO[bytes], end: int, limits: tuple[int, int], bomb: Bomb
) -> Iterator[tuple[zipfile.ZipInfo, int]]:
    """Each entry, and where its content starts. limits: entries, bytes of headers of headers."""
    max_entries, max_list_bytes = limits
    place, list_bytes, num_entries, num_others = 0, 0, 0, 0
    name, size = None, None
    while True:
        if num_entries > max_entries or num_others > _OTHERS * max_entries:
            raise bomb(f"The archive has more than {max_entries} entries.")
        file.seek(place)
        block = file.read(BLOCK_BYTES)
        if not block.strip(b"\0"):  # the end, also where it is missing
            return
        if not is_header(block):
            raise ValueError("no header where one should be")
        kind, start = block[156:157], place + BLOCK_BYTES
        declared = _number(block[124:136])
        if kind in (_LONG_NAME, _LONG_LINK, _EXTENDED, _OF_ALL):
            list_bytes += declared
            num_others += 1
            if list_bytes > max_list_bytes:
                most = max_list_bytes / 2**20
                raise bomb(f"The archive's list of entries is larger than {most:.0f} MiB.")
            data = file.read(declared)
            if len(data) < declared:
                raise ValueError("cut off in a header")
            place = start + _blocks(declared)
            if kind == _LONG_NAME:
                name = data.rstrip(b"\0").decode("utf-8", "replace")
            elif kind == _EXTENDED:
                told = _extended(data)
                name = told.get("path", name)
                size = _count(told["size"]) if "size" in told else size
                if any(key.startswith("GNU.sparse") for key in told):
                    block = block[:156] + b"S" + block[157:]
                    yield _entry(block, name or _name(block), 0, start), start
            continue
        size = declared if size is None else size
        size = size if kind in _KINDS and kind != b"5" else 0
        if start + size > end:
            raise ValueError("cut off in an entry")
        num_entries += 1
        info = _entry(block, _name(block) if name is None else name, size, start)
        if info.filename not in ("", "/"):
            yield info, start
        place = start + _blocks(size)
        name, size = None, None


def _entry(block: bytes, name: str, size: int, start: int) -> zipfile.ZipInfo:
    """What a zip would say of it. A zip's own header is shorter than a tar's."""
    kind = _KINDS.get(block[156:157], stat.S_IFLNK)
    while name.startswith("./"):
        name = name[2:]
    if name == ".":
        name = ""
    if kind == stat.S_IFDIR and not name.endswith("/"):
        name += "/"
    info = zipfile.ZipInfo(name)
    info.external_attr = kind << 16
    info.file_size = info.compress_size = size
    info.header_offset = start - BLOCK_BYTES
    return info


def _name(block: bytes) -> str:
    """The name in a header; ustar's has a first part elsewhere."""
    name = block[:100].split(b"\0")[0]
    if block[257:263] == b"ustar\0" and block[345]:
        name = block[345:500].split(b"\0")[0] + b"/" + name
    return name.decode("utf-8", "replace")


def _extended(data: bytes) -> dict[str, str]:
    """What lines of an extended header say: "<length of the line> <key>=<value>"."""
    found, place = {}, 0
    while place < len(data) and data[place]:
        space = data.index(b" ", place, place + 20)
        length = _count(data[place:space].decode("ascii"))
        line = data[space + 1 : place + length]
        if place + length > len(data) or not line.endswith(b"\n"):
            raise ValueError("an extended header of another length than it says")
        key, _, value = line[:-1].partition(b"=")
        found[key.decode("utf-8", "replace")] = value.decode("utf-8", "replace")
        place += length
    return found


def _number(field: bytes) -> int:
    """A size: octal, or in base 256 where the first bit is set."""
    if field[0] == 0x80:
        return int.from_bytes(field[1:], "big")
    return _octal(field)


def _octal(field: bytes) -> int:
    digits = field.strip(b" \0")
    if digits.strip(b"01234567"):
        raise ValueError("no octal number")
    return int(digits, 8) if digits else 0


def _count(text: str) -> int:
    if not (text.isascii() and text.isdigit()) or len(text) > 20:
        raise ValueError("no number")
    return int(text)


def _sum_of(block: bytes) -> int:
    """A header's sum, its own field taken for blanks."""
    return sum(block) - sum(block[148:156]) + 8 * 0x20


def _blocks(size: int) -> int:
    return -(-size // BLOCK_BYTES) * BLOCK_BYTES
