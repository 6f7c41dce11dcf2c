"""How the numba kernels are compiled, cached and launched. Import this before defining a kernel.

Threads: numba's own pool (`workqueue`) is used, because it needs neither libgomp nor tbb. That pool
ends the process when two threads launch at once, so every launch goes through `launching()`, which
holds a lock and gives the number of threads that torch uses.

Cache: compiled code is kept in NUMBA_CACHE_DIR, else NERFWORKS_HOME/numba, else
~/.cache/nerfworks/numba, so that a read-only install compiles once and not in every process. Numba
does not notice when a function called by a cached one changes; the folder therefore carries a
digest of all kernel sources.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numba
import torch

Function = TypeVar("Function", bound=Callable[..., Any])

# Everything but the promise that there are no NaN: a diverged training must show, not hide.
FAST_MATH = {"contract", "reassoc", "nsz", "arcp", "afn"}

_LOCK = threading.RLock()


def _cache_folder() -> Path:
    """The folder for compiled kernels: the first choice that can be written."""
    digest = hashlib.sha256(numba.__version__.encode())
    for source in sorted(Path(__file__).parent.glob("*.py")):
        digest.update(source.read_bytes())
    name = f"kernels-{digest.hexdigest()[:16]}"
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


numba.config.CACHE_DIR = str(_cache_folder())
numba.config.THREADING_LAYER = "workqueue"


def compiled(function: Function) -> Function:
    """A function for use inside kernels: single-threaded, cached."""
    decorated: Function = numba.njit(
        cache=True, fastmath=FAST_MATH, nogil=True, error_model="numpy", boundscheck=False
    )(function)
    return decorated


def compiled_parallel(function: Function) -> Function:
    """A kernel with `numba.prange` loops. Call it inside `launching()` only."""
    decorated: Function = numba.njit(
        cache=True,
        fastmath=FAST_MATH,
        nogil=True,
        parallel=True,
        error_model="numpy",
        boundscheck=False,
    )(function)
    return decorated


def num_threads() -> int:
    """Threads of a launch: as torch has them, at most one per processor."""
    return max(1, min(int(numba.config.NUMBA_NUM_THREADS), torch.get_num_threads()))


@contextmanager
def launching() -> Iterator[int]:
    """Hold the pool for one launch; gives the number of its threads."""
    with _LOCK:
        threads = num_threads()
        numba.set_num_threads(threads)
        yield threads
