"""Locks between processes of one machine, which the kernel drops when their holder dies."""

from __future__ import annotations

import fcntl
import os
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

_STEP_S = 0.1


class FolderInUseError(TimeoutError):
    """Another process held a lock for too long."""


def _open(root: Path, name: str) -> int:
    path = root / ".locks" / name
    path.parent.mkdir(parents=True, exist_ok=True)
    return os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)


def _try_lock(descriptor: int) -> bool:
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


@contextmanager
def folder_lock(
    root: Path,
    name: str,
    timeout_s: float,
    note: bytes = b"",
    guard: Callable[[], None] | None = None,
) -> Iterator[None]:
    """Hold `root/.locks/name`. Raises FolderInUseError where another holds it for too long.

    note: what others find there while the lock is held, see `read_holder`. guard: called again and
    again while it waits; what it raises ends that.
    """
    descriptor = _open(root, name)
    try:
        deadline = time.monotonic() + timeout_s
        while not _try_lock(descriptor):
            if guard is not None:
                guard()
            if time.monotonic() > deadline:
                raise FolderInUseError(f"{name} is in use by another process")
            time.sleep(_STEP_S)
        os.ftruncate(descriptor, 0)
        os.pwrite(descriptor, note, 0)
        yield
        os.ftruncate(descriptor, 0)
    finally:
        os.close(descriptor)


def read_holder(root: Path, name: str) -> bytes | None:
    """The note of who holds a lock; None where it is free."""
    descriptor = _open(root, name)
    try:
        return None if _try_lock(descriptor) else os.pread(descriptor, 4096, 0)
    finally:
        os.close(descriptor)


def started_at(pid: int) -> str | None:
    """When a process started, in the kernel's ticks; None where there is none, or none can tell."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def is_process(pid: int) -> bool:
    """Whether a process of this number runs; one that is dead and not yet buried does not."""
    try:
        stat = Path(f"/proc/{pid}/stat").read_text()
        return stat.rpartition(")")[2].split()[0] not in ("Z", "X")
    except (OSError, IndexError):
        pass
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    except PermissionError:
        return True
    return True
