"""How the numba kernels are compiled, cached and spread over threads.

Threads: kernels are single-threaded functions that release the interpreter's lock and take
`(share, shares, ...)`; `run_threads` hands the shares to several Python threads.
This needs no threading layer of numba's (no libgomp, no tbb), compiles in a third of the time, and
several callers may run at once.

Cache: compiled code is kept in NUMBA_CACHE_DIR, else NERFWORKS_HOME/numba, else
~/.cache/nerfworks/numba, so that a read-only install compiles once and not in every process. Numba
does not notice when a function called by a cached one changes; the folder therefore carries a
digest of all kernel sources.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import torch

SHARES_PER_THREAD = 8

# Everything but the promise that there are no NaN: a diverged training must show, not hide.
FAST_MATH = {"contract", "reassoc", "nsz", "arcp", "afn"}
_OPTIONS: dict[str, Any] = {
    "cache": True,
    "fastmath": FAST_MATH,
    "nogil": True,
    "error_model": "numpy",
    "boundscheck": False,
}


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


numba.config.CACHE_DIR = str(_cache_folder())  # type: ignore[attr-defined]


def compiled(function: Callable[..., Any]) -> Any:
    """A kernel, or a function for use inside kernels: cached, without the interpreter's lock."""
    return numba.njit(**_OPTIONS)(function)


def exact(function: Callable[..., Any]) -> Any:
    """As `compiled`, with rounding as written: for code that a reordering would break."""
    return numba.njit(**(_OPTIONS | {"fastmath": False}))(function)


def merged(function: Callable[..., Any]) -> Any:
    """A step of a long kernel, compiled as a part of it.

    `compiled` functions are optimised once by themselves and again in every caller, which makes
    the first start of a kernel that is three calls deep take three times as long.
    """
    return numba.njit(inline="always", **_OPTIONS)(function)


def inlined(function: Callable[..., Any]) -> Any:
    """A small function for the innermost loops, where a call would cost more than its body."""
    return numba.njit(forceinline=True, **_OPTIONS)(function)


def num_threads() -> int:
    """Threads of a launch: as torch has them, at most one per processor."""
    return max(1, min(os.cpu_count() or 1, torch.get_num_threads()))


def run_threads(kernel: Callable[..., None], *arguments: Any, shares: int | None = None) -> None:
    """Call `kernel(share, shares, *arguments)` for every share; return when all are done.

    There are several shares to a thread, and a thread takes the next one when it is done with one,
    so that a core that is also wanted elsewhere does less instead of keeping the others waiting. A
    share writes what no other share writes, so results repeat whoever does it. Where shares cost
    memory, `shares` says how many there are.
    """
    threads = num_threads()
    if shares is None:
        shares = 1 if threads == 1 else threads * SHARES_PER_THREAD
    if threads == 1 or shares == 1:
        for share in range(shares):
            kernel(share, shares, *arguments)
        return
    waiting = iter(range(shares))  # `next` is atomic under the interpreter's lock

    def work() -> None:
        for share in waiting:
            kernel(share, shares, *arguments)

    with ThreadPoolExecutor(threads - 1) as pool:
        others = [pool.submit(work) for _ in range(threads - 1)]
        work()
    for other in others:
        other.result()
