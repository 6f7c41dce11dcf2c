"""Where compiled kernels lie, and the locks of processes that share the folder.

A file of its own that loads neither torch nor numba: who only asks whether something is compiled
is answered at once.

The folder is below NUMBA_CACHE_DIR, else NERFWORKS_HOME/numba, else ~/.cache/nerfworks/numba, so
that a read-only install compiles once and not in every process. Numba does not notice when a
function called by a cached one changes; the folder therefore carries a digest of all sources that
kernels are made of or freeze constants from.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import importlib.metadata
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

PACKAGE = Path(__file__).resolve().parents[3]
"""The folder of the package pipelines.nerf."""

FROZEN_ROOMS = ("options", "space", "along_ray", "networks", "models", "engines/cpu")
"""Rooms of pipelines/nerf that kernels come from: a global that a kernel reads is a constant of its
compiled code, wherever it was imported from. `tests/test_architecture.py` holds the list."""


def kernel_version(nerf: Path) -> str:
    """What changes with this numba and with every source that kernels may be made of.

    nerf: the folder of the package pipelines.nerf.
    """
    digest = hashlib.sha256(importlib.metadata.version("numba").encode())
    for room in FROZEN_ROOMS:
        for source in sorted((nerf / room).rglob("*.py")):
            digest.update(source.read_bytes())
    return digest.hexdigest()[:16]


def _cache_folder() -> Path:
    """The folder for compiled kernels: the first choice that can be written."""
    name = f"kernels-{kernel_version(PACKAGE)}"
    chosen = os.environ.get("NUMBA_CACHE_DIR")
    home = os.environ.get("NERFWORKS_HOME")
    if chosen:
        base = Path(chosen)
    elif home:
        base = Path(home) / "numba"
    else:
        base = Path("~/.cache/nerfworks/numba").expanduser()
    for candidate in (base / name, Path(tempfile.gettempdir()) / f"nerfworks-{os.getuid()}" / name):
        try:
            candidate.mkdir(parents=True, exist_ok=True)
        except OSError:
            continue
        if os.access(candidate, os.W_OK):
            return candidate
    raise OSError("no writable folder for compiled kernels: set NUMBA_CACHE_DIR to one")


CACHE_FOLDER = _cache_folder()
"""Where compiled kernels of these sources and this numba lie."""


@contextlib.contextmanager
def file_lock(path: Path, operation: int) -> Iterator[None]:
    """Hold a lock between processes, which the kernel drops when its holder dies.

    operation: of `fcntl.flock`. Raises BlockingIOError where LOCK_NB asks for that.
    """
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600)
    try:
        fcntl.flock(descriptor, operation)
        yield
    finally:
        os.close(descriptor)
