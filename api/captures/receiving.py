"""A multipart upload, from the socket to one file on disk, in flat memory.

The stream is parsed as it arrives; the bytes of the part named `file` go to a staging file, counted
and hashed on the way. A staging file is locked while its upload lasts, so that what a killed
process left can be told from what is still coming in, and is removed at the next start.
"""

from __future__ import annotations

import asyncio
import contextlib
import fcntl
import hashlib
import re
import secrets
import shutil
import time
from collections.abc import AsyncIterator, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import BinaryIO

from python_multipart import MultipartParser
from python_multipart.exceptions import FormParserError
from python_multipart.multipart import parse_options_header
from starlette.requests import ClientDisconnect
from starlette.types import Receive

from api.problems import (
    ApiError,
    InvalidRequestError,
    NoSpaceError,
    TooLargeError,
    UnsupportedTypeError,
)

WRITE_BYTES = 1 << 20
CHECK_DISK_BYTES = 64 << 20
MAX_PARTS = 16
MAX_OTHER_BYTES = 64 << 10
FRAMING_BYTES = 1 << 20
IDLE_S = 60.0
SLOW_START_S = 60.0
LINGER_BYTES = 32 << 20
LINGER_S = 5.0
SUFFIX = ".upload"


@dataclass(frozen=True)
class Limits:
    """What an upload may take. min_free_bytes: what must stay free on the staging disk, and where
    what has come is copied into another folder, on that folder's disk.
    """

    max_bytes: int
    min_free_bytes: int
    copied_into: Path | None = None

    def check_length(self, content_length: str | None) -> int:
        """The announced length, 0 if none. Raises TooLargeError for one that cannot fit."""
        if content_length is None or not re.fullmatch(r"[0-9]{1,18}", content_length):
            return 0
        length = int(content_length)
        if length > self.max_bytes + FRAMING_BYTES:
            raise self.too_large()
        return length

    def check_disk(self, folder: Path, coming: int, came: int = 0) -> None:
        """Raises NoSpaceError where `coming` more bytes, and the copy of them and of those that
        came before, would leave too little room. Waits for the disks; a folder for copies that is
        gone is told when the upload is stored."""
        needed = {folder.stat().st_dev: (folder, coming)}
        if self.copied_into is not None:
            with contextlib.suppress(OSError):
                disk = self.copied_into.stat().st_dev
                _, here = needed.get(disk, (self.copied_into, 0))
                needed[disk] = (self.copied_into, here + came + coming)
        for place, num_bytes in needed.values():
            if shutil.disk_usage(place).free - num_bytes < self.min_free_bytes:
                raise NoSpaceError("The service has too little disk left for this upload.")

    def too_large(self) -> TooLargeError:
        """The error of an upload that is too large."""
        return TooLargeError(f"The upload is larger than {self.max_bytes:,} bytes.")


@dataclass(frozen=True)
class Received:
    """A complete upload. path: the staging file."""

    path: Path
    filename: str
    bytes: int
    sha256: str


@contextmanager
def staging_file(folder: Path) -> Iterator[tuple[Path, BinaryIO]]:
    """A locked file that is gone when the block ends, unless it was moved away."""
    folder.mkdir(parents=True, exist_ok=True)
    while True:
        path = folder / f"{secrets.token_hex(16)}{SUFFIX}"
        try:
            with path.open("xb", buffering=0) as file:
                fcntl.flock(file, fcntl.LOCK_EX)
                if not path.exists():
                    continue  # a `sweep` came before the lock: once more
                yield path, file
                return
        finally:
            path.unlink(missing_ok=True)


def sweep(folder: Path) -> int:
    """Remove the staging files that no upload holds, whoever made them, and when. How many."""
    removed = 0
    for path in folder.glob(f"*{SUFFIX}"):
        try:
            with path.open("rb") as file:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                path.unlink()
                removed += 1
        except (BlockingIOError, FileNotFoundError):
            continue
    return removed


def clean_filename(raw: bytes) -> str:
    """The last part of the name a client gave, printable and at most 255 characters."""
    name = raw.decode("utf-8", "replace").replace("%22", '"').replace("\\", "/").rsplit("/", 1)[-1]
    name = "".join(character for character in name if character.isprintable()).strip()
    return name[-255:] or "capture"


class _FilePart:
    """Parser callbacks: finds the part named `file` and keeps its bytes until they are written."""

    def __init__(self, limits: Limits) -> None:
        self.limits = limits
        self.filename: str | None = None
        self.size = 0
        self.pending: list[bytes] = []
        self.pending_bytes = 0
        self.complete = False
        self._parts = 0
        self._other_bytes = 0
        self._in_file = False
        self._name = b""
        self._value = b""
        self._disposition = b""

    def on_part_begin(self) -> None:
        self._parts += 1
        self._in_file = False
        self._disposition = b""
        if self._parts > MAX_PARTS:
            raise InvalidRequestError("The form has too many parts.", code="multipart_malformed")

    def on_header_field(self, data: bytes, start: int, end: int) -> None:
        self._name += data[start:end]

    def on_header_value(self, data: bytes, start: int, end: int) -> None:
        self._value += data[start:end]

    def on_header_end(self) -> None:
        if self._name.lower() == b"content-disposition":
            self._disposition = self._value
        self._name = self._value = b""

    def on_headers_finished(self) -> None:
        _, options = parse_options_header(self._disposition)
        if options.get(b"name") != b"file":
            return
        if self.filename is not None:
            raise InvalidRequestError(
                "The form has more than one part named 'file'.",
                code="file_repeated",
                hint="Send one capture per call; put photos into one .zip.",
            )
        self._in_file = True
        self.filename = clean_filename(options.get(b"filename", b""))

    def on_part_data(self, data: bytes, start: int, end: int) -> None:
        if not self._in_file:
            self._other_bytes += end - start
            if self._other_bytes > MAX_OTHER_BYTES:
                raise InvalidRequestError(
                    "The form has too much besides the file.", code="multipart_malformed"
                )
            return
        self.size += end - start
        if self.size > self.limits.max_bytes:
            raise self.limits.too_large()
        self.pending.append(data[start:end])
        self.pending_bytes += end - start

    def on_end(self) -> None:
        self.complete = True

    def take(self) -> bytes:
        """The bytes not yet written."""
        taken = b"".join(self.pending)
        self.pending.clear()
        self.pending_bytes = 0
        return taken


def _parser(content_type: str | None, part: _FilePart) -> MultipartParser:
    kind, options = parse_options_header(content_type)
    boundary = options.get(b"boundary", b"")
    if kind != b"multipart/form-data" or not boundary:
        raise UnsupportedTypeError("The body is not multipart/form-data.")
    try:
        return MultipartParser(
            boundary,
            {
                "on_part_begin": part.on_part_begin,
                "on_header_field": part.on_header_field,
                "on_header_value": part.on_header_value,
                "on_header_end": part.on_header_end,
                "on_headers_finished": part.on_headers_finished,
                "on_part_data": part.on_part_data,
                "on_end": part.on_end,
            },
        )
    except FormParserError as error:
        raise _malformed(error) from error


def _malformed(error: FormParserError) -> ApiError:
    return InvalidRequestError(
        f"The form is malformed: {error}.",
        code="multipart_malformed",
        hint="Send multipart/form-data as RFC 7578 has it, with one part named 'file'.",
    )


def _stalled(detail: str) -> ApiError:
    return ApiError(
        detail,
        code="upload_stalled",
        hint="Send it again over a better connection; nothing of it was kept.",
        status=408,
    )


class Body:
    """A request's body as it comes in."""

    def __init__(self, receive: Receive, min_bytes_per_s: int = 0) -> None:
        """min_bytes_per_s: what is slower, on the whole, after SLOW_START_S is given up."""
        self._receive = receive
        self._min_bytes_per_s = min_bytes_per_s
        self._began = time.monotonic()
        self._taken = 0
        self._ended = False

    async def chunks(self) -> AsyncIterator[bytes]:
        """The bytes. Raises ClientDisconnect, and ApiError where they come too slowly."""
        while not self._ended:
            try:
                async with asyncio.timeout(IDLE_S):
                    message = await self._receive()
            except TimeoutError as error:
                raise _stalled(f"Nothing came for {IDLE_S:.0f} s.") from error
            self._taken += len(message.get("body", b""))
            seconds = time.monotonic() - self._began - SLOW_START_S
            if seconds > 0 and self._taken < seconds * self._min_bytes_per_s:
                raise _stalled(
                    f"The upload is slower than {self._min_bytes_per_s:,} bytes a second."
                )
            if message["type"] == "http.disconnect":
                self._ended = True
                raise ClientDisconnect
            self._ended = not message.get("more_body", False)
            yield message.get("body", b"")

    async def linger(self) -> None:
        """Read on for a little while after a refusal.

        A connection that is closed on a client which still sends is reset, and the client may lose
        the answer; so what is already under way is taken in and dropped, within bounds.
        """
        dropped = 0
        with contextlib.suppress(TimeoutError, ClientDisconnect, ApiError):
            async with asyncio.timeout(LINGER_S):
                async for chunk in self.chunks():
                    dropped += len(chunk)
                    if dropped > LINGER_BYTES:
                        return


async def receive(
    body: Body,
    content_type: str | None,
    content_length: str | None,
    staging: tuple[Path, BinaryIO],
    limits: Limits,
) -> Received:
    """Read an upload to its end into the staging file.

    Raises ApiError for what the service does not take, ClientDisconnect where the client goes
    away. The caller removes the file (`staging_file` does).
    """
    path, file = staging
    part = _FilePart(limits)
    parser = _parser(content_type, part)
    coming = limits.check_length(content_length)
    await asyncio.to_thread(limits.check_disk, path.parent, coming)
    digest = hashlib.sha256()
    checked_at = 0

    def write_pending() -> None:
        data = part.take()
        digest.update(data)
        view = memoryview(data)
        while view:
            view = view[file.write(view) :]

    async for chunk in body.chunks():
        try:
            parser.write(chunk)
        except FormParserError as error:
            raise _malformed(error) from error
        if part.pending_bytes >= WRITE_BYTES:
            await asyncio.to_thread(write_pending)
        if part.size - checked_at >= CHECK_DISK_BYTES:
            checked_at = part.size
            await asyncio.to_thread(limits.check_disk, path.parent, 0, part.size)
    if part.filename is None:
        raise InvalidRequestError(
            "The form has no part named 'file'.",
            code="file_missing",
            hint="Send the capture as the part named 'file': curl -F file=@walk.mp4 ...",
        )
    if not part.complete:
        raise InvalidRequestError(
            "The upload ends in the middle.",
            code="upload_truncated",
            hint="Send it again; nothing of it was kept.",
        )
    await asyncio.to_thread(write_pending)
    return Received(path, part.filename, part.size, digest.hexdigest())
