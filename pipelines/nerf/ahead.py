"""Work on many things of which one after another is wanted, some of them begun ahead."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterable
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeVar

import torch

_Item = TypeVar("_Item")
_Result = TypeVar("_Result")


def each_ahead(
    work: Callable[[_Item], _Result], items: Iterable[_Item], most_threads: int = 8
) -> Generator[_Result, None, None]:
    """`ahead`, on as many threads as torch has, or so many: each holds what its item takes."""
    return ahead(work, items, min(torch.get_num_threads(), most_threads))


def ahead(
    work: Callable[[_Item], _Result], items: Iterable[_Item], threads: int
) -> Generator[_Result, None, None]:
    """`work` of each item, in their order, on so many threads; on the caller's own for one.

    What lets go of the interpreter's lock, as large arrays, files and rays do, is done side by
    side. So much is held at a time: a result for each thread, and the one that is asked for. What
    `work` raises is raised in its turn; whoever stops asking waits for what was begun.
    """
    if threads == 1:
        yield from map(work, items)
        return
    begun: deque[Future[_Result]] = deque()
    with ThreadPoolExecutor(threads) as pool:
        try:
            for item in items:
                begun.append(pool.submit(work, item))
                if len(begun) > threads:
                    yield begun.popleft().result()
            while begun:
                yield begun.popleft().result()
        finally:
            for future in begun:
                future.cancel()
