"""Moving files over HTTP in flat memory: a multipart body out, a resumable download in."""

from __future__ import annotations

import contextlib
import hashlib
import secrets
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import BinaryIO

import httpx

from api.client.models import Artifact, ChecksumMismatch, FilesInTheWay, NerfworksError

CHUNK_BYTES = 1 << 18
_MOST_NAMED = 5
OnProgress = Callable[[int, int], None]
"""Called with (bytes so far, bytes in all)."""


class MultipartFile:
    """A multipart/form-data body with one file as the part `file`."""

    def __init__(self, file: BinaryIO, filename: str, size: int) -> None:
        self._file = file
        self._size = size
        boundary = secrets.token_hex(16)
        quoted = filename.replace("\\", "_").replace('"', "%22").replace("\r", "").replace("\n", "")
        self._head = (
            f"--{boundary}\r\n"
            f'Content-Disposition: form-data; name="file"; filename="{quoted}"\r\n'
            "Content-Type: application/octet-stream\r\n\r\n"
        ).encode()
        self._tail = f"\r\n--{boundary}--\r\n".encode()
        self.headers = {
            "Content-Type": f"multipart/form-data; boundary={boundary}",
            "Content-Length": str(len(self._head) + size + len(self._tail)),
        }

    def chunks(self, progress: OnProgress | None) -> Iterator[bytes]:
        """The body from its start; exactly as long as Content-Length says."""
        yield self._head
        self._file.seek(0)
        sent = 0
        while sent < self._size:
            chunk = self._file.read(min(CHUNK_BYTES, self._size - sent))
            if not chunk:
                raise NerfworksError("The file became shorter while it was sent.", "Send it again.")
            yield chunk
            sent += len(chunk)
            if progress is not None:
                progress(sent, self._size)
        yield self._tail


def safe_target(folder: Path, name: str) -> Path:
    """Where an artifact goes. Raises NerfworksError for a name that would leave the folder."""
    if not name or name in (".", "..") or set(name) & set("/\\\0"):
        raise NerfworksError(f"The service offers an artifact with an unsafe name: {name!r}.")
    return folder / name


def sha256_of(path: Path) -> str:
    """The digest of a file, in hex."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def refuse_to_overwrite(downloads: Sequence[Download]) -> None:
    """Raise FilesInTheWay where a download would take the place of another file.

    The files of all jobs and exports have the same names: two of them in one folder would be mixed.
    """
    taken = [download for download in downloads if download.target.exists()]
    if not taken:
        return
    names = ", ".join(download.artifact.name for download in taken[:_MOST_NAMED])
    more = f" and {len(taken) - _MOST_NAMED} more" if len(taken) > _MOST_NAMED else ""
    raise FilesInTheWay(
        f"{taken[0].target.parent} has other files of these names already: {names}{more}. Nothing "
        "was downloaded.",
        "They are another job's or export's, or what this one had before: name another folder, or "
        "have them overwritten (overwrite=True, --overwrite).",
    )


class Download:
    """One artifact on its way to a file.

    Bytes gather beside the target in `.NAME.DIGEST.part`; `attempt` goes on from what is there,
    also after a restart of this program, and the target appears whole, verified, or not at all.
    """

    def __init__(self, artifact: Artifact, folder: Path, progress: OnProgress | None) -> None:
        self.artifact = artifact
        self.target = safe_target(folder, artifact.name)
        self.part = folder / f".{artifact.name}.{artifact.sha256[:16]}.part"
        self._progress = progress

    @property
    def bytes_here(self) -> int:
        """Bytes that are here already."""
        return self.part.stat().st_size if self.part.exists() else 0

    def is_done(self) -> bool:
        """Whether the target holds the very bytes already."""
        return (
            self.target.is_file()
            and self.target.stat().st_size == self.artifact.bytes
            and sha256_of(self.target) == self.artifact.sha256
        )

    def attempt(self, http: httpx.Client, url: str) -> None:
        """Fetch what is missing, verify, and put it in place.

        Raises httpx.TransportError (try again: it goes on from there), httpx.HTTPStatusError,
        ChecksumMismatch (what was here is dropped).
        """
        if self.bytes_here > self.artifact.bytes:
            self.part.unlink()
        if self.bytes_here < self.artifact.bytes or self.artifact.bytes == 0:
            self._fetch(http, url)
        if self.bytes_here != self.artifact.bytes:
            if self.bytes_here < self.artifact.bytes:
                raise httpx.RemoteProtocolError(f"{self.artifact.name} ended early")
            self._refuse("more bytes came than were promised")
        if sha256_of(self.part) != self.artifact.sha256:
            self._refuse("its SHA-256 is not the promised one")
        self.part.replace(self.target)

    def _refuse(self, why: str) -> None:
        self.part.unlink(missing_ok=True)
        raise ChecksumMismatch(
            f"{self.artifact.name} arrived damaged: {why}.", "Download it again."
        )

    def _fetch(self, http: httpx.Client, url: str) -> None:
        start, size = self.bytes_here, self.artifact.bytes
        headers = {"Accept-Encoding": "identity"}
        if start:
            headers["Range"] = f"bytes={start}-"
        with http.stream("GET", url, headers=headers, follow_redirects=True) as answer:
            if answer.is_error:
                answer.read()
            answer.raise_for_status()
            if start and not _continues(answer, start, size):
                start = 0
            with self.part.open("ab" if start else "wb") as file:
                done = start
                for chunk in answer.iter_raw():
                    file.write(chunk)
                    done += len(chunk)
                    if self._progress is not None:
                        self._progress(min(done, size), size)
                    if done > size:
                        return


def _continues(answer: httpx.Response, start: int, size: int) -> bool:
    """Whether the answer holds the bytes from `start` on.

    Some S3 servers answer a range with 200 and the right bytes: the length gives them away.
    """
    if answer.status_code == 206:
        return str(answer.headers.get("Content-Range", "")).startswith(f"bytes {start}-")
    with contextlib.suppress(ValueError):
        return int(answer.headers.get("Content-Length", "-1")) == size - start
    return False
