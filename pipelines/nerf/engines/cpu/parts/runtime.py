"""How the numba kernels are compiled, cached and spread over threads.

Threads: kernels are single-threaded functions that release the interpreter's lock and take
`(share, shares, ...)`; `run_threads` hands the shares to several Python threads.
This needs no threading layer of numba's (no libgomp, no tbb), compiles in a third of the time, and
several callers may run at once.

Cache: compiled code is kept in the folder that `kernel_cache` names. Processes that share it take
turns (`_SharedCache`). `pipelines.nerf.compiling` fills it before anybody waits.
"""

from __future__ import annotations

import fcntl
import inspect
import os
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import numba
import torch
from numba.core import event
from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    UserProvidedCacheLocator,
)

from pipelines.nerf.engines.cpu.parts.kernel_cache import (
    CACHE_FOLDER,
    PACKAGE,
    file_lock,
    kernel_version,
)

SHARES_PER_THREAD = 8

# Everything but the promise that there are no NaN: a diverged training must show, not hide.
FAST_MATH = {"contract", "reassoc", "nsz", "arcp", "afn"}
_OPTIONS: dict[str, Any] = {
    "fastmath": FAST_MATH,
    "nogil": True,
    "error_model": "numpy",
    "boundscheck": False,
}


numba.config.CACHE_DIR = str(CACHE_FOLDER)  # type: ignore[attr-defined]


class _Locator(UserProvidedCacheLocator):
    """Names a module's place in the cache by where it lies in the package, not on the disk.

    The cache folder's digest says that the sources are the same: so what was compiled serves every
    copy of them. By numba's own names a second copy would find none of it, though the marks say
    that all is compiled (`pipelines.nerf.compiling`).
    """

    @classmethod
    def from_function(cls, py_func: Any, py_file: str) -> Any:
        """As numba has it, though its setting may be empty: numba reads its settings anew where a
        variable NUMBA_... has changed."""
        numba.config.CACHE_DIR = str(CACHE_FOLDER)  # type: ignore[attr-defined]
        return super().from_function(py_func, py_file)  # type: ignore[no-untyped-call]

    def get_cache_path(self) -> str:
        source = Path(self._py_file).resolve()
        if not source.is_relative_to(PACKAGE):
            return str(super().get_cache_path())  # type: ignore[no-untyped-call]
        return str(CACHE_FOLDER / ".".join(source.relative_to(PACKAGE).parts[:-1]))


class _CacheImpl(CompileResultCacheImpl):
    _locator_classes: list[type[object]] = [_Locator]  # noqa: RUF012 as numba declares it


class _SharedCache(FunctionCache):
    """Numba's cache of one function, safe for several processes at once.

    Numba numbers a new data file by the index that it has just read: two processes that save
    different signatures of one function together may take the same number, and whoever loads one
    later would run the other's code.
    """

    _impl_class = _CacheImpl

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        with file_lock(CACHE_FOLDER / "lock", fcntl.LOCK_SH):
            return super().load_overload(sig, target_context)  # type: ignore[no-untyped-call]

    def save_overload(self, sig: Any, data: Any) -> None:
        if CACHE_FOLDER.name != f"kernels-{kernel_version(PACKAGE)}":
            return  # the sources have changed since this process began: of which is this?
        with file_lock(CACHE_FOLDER / "lock", fcntl.LOCK_EX):
            super().save_overload(sig, data)  # type: ignore[no-untyped-call]


class _CompileWatch(event.Listener):
    """Counts what numba compiles in this process; it holds its global lock meanwhile.

    A kernel's compilation holds those of the functions that it calls: only the outermost count.
    """

    def __init__(self) -> None:
        self.seconds = 0.0
        self.kernels = 0
        self._depth = 0
        self._begun = 0.0

    def on_start(self, event: Any) -> None:
        if self._depth == 0:
            self._begun = time.monotonic()
        self._depth += 1

    def on_end(self, event: Any) -> None:
        self._depth -= 1
        if self._depth == 0:
            self.seconds += time.monotonic() - self._begun
            self.kernels += event.data["dispatcher"] in _launched


_launched: list[Any] = []
_watch = _CompileWatch()
event.register("numba:compile", _watch)  # type: ignore[no-untyped-call]


def compile_seconds() -> float:
    """Seconds that this process spent on compiling so far, or waited for others that compiled for
    it; 0 where all came from the cache."""
    return _watch.seconds


def count_as_compiling(seconds: float) -> None:
    """Add time in which this process waited for kernels that another one compiled."""
    _watch.seconds += seconds


def kernels_compiled() -> int:
    """Kernels that this process compiled so far, without the functions that they call."""
    return _watch.kernels


def kernels_known() -> int:
    """Kernels of all modules imported so far: what `run_threads` can launch."""
    return len(_launched)


def _jit(function: Callable[..., Any], **changes: Any) -> Any:
    made = numba.njit(**(_OPTIONS | changes))(function)
    # What `cache=True` does, with a class of our own.
    made._cache = _SharedCache(function)  # type: ignore[no-untyped-call]
    if list(inspect.signature(function).parameters)[:2] == ["share", "shares"]:
        _launched.append(made)
    return made


def compiled(function: Callable[..., Any]) -> Any:
    """A kernel, or a function for use inside kernels: cached, without the interpreter's lock."""
    return _jit(function)


def exact(function: Callable[..., Any]) -> Any:
    """As `compiled`, with rounding as written: for code that a reordering would break."""
    return _jit(function, fastmath=False)


def merged(function: Callable[..., Any]) -> Any:
    """A step of a long kernel, compiled as a part of it.

    `compiled` functions are optimised once by themselves and again in every caller, which makes
    the first start of a kernel that is three calls deep take three times as long.
    """
    return _jit(function, inline="always")


def inlined(function: Callable[..., Any]) -> Any:
    """A small function for the innermost loops, where a call would cost more than its body."""
    return _jit(function, forceinline=True)


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
