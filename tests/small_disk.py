"""A disk of a few megabytes, to be filled for real and freed again."""

from __future__ import annotations

import errno
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

FILLER = "filler"


@contextmanager
def small_disk(num_bytes: int) -> Iterator[Path]:
    """A folder on a disk of this size, below which it lies until the block ends.

    A process of its own mounts it, where only that process sees it; others reach it through /proc,
    by a path that must not be resolved. Skips where the system lets nobody do so.
    """
    mount = f"mount -t tmpfs -o size={num_bytes} none /mnt && echo ready && exec sleep 3600"
    try:
        holder = subprocess.Popen(
            ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", mount],
            stdout=subprocess.PIPE,
        )
    except FileNotFoundError:
        pytest.skip("what a full disk does is NOT tested: there is no unshare to mount one with")
    try:
        assert holder.stdout is not None
        if holder.stdout.readline() != b"ready\n":
            pytest.skip("what a full disk does is NOT tested: this system lets nobody mount one")
        yield Path(f"/proc/{holder.pid}/root/mnt")
    finally:
        holder.kill()
        holder.wait()


def fill(folder: Path) -> None:
    """Leave no byte free on the disk of a folder."""
    with (folder / FILLER).open("ab", buffering=0) as file:
        for size in (1 << 16, 1 << 12, 1):
            try:
                while True:
                    file.write(b"x" * size)
            except OSError as error:
                if error.errno != errno.ENOSPC:
                    raise


def free(folder: Path) -> None:
    """Give back what `fill` took."""
    (folder / FILLER).unlink()
