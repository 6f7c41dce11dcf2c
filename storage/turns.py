"""One at a time, in the order in which they came.

Whoever finds a SQLite file locked asks again after pauses of up to a tenth of a second, and luck
decides who is next: with many writers the unlucky one waits until it gives up. Threads of one
process take turns here instead, so that each waits for those before it alone. A `threading.Lock`
would not do: who has just let go of it is often the next to have it.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager


class Turns:
    """A lock that serves in order."""

    def __init__(self) -> None:
        self._mutex = threading.Lock()
        self._is_taken = False
        self._waiting: deque[threading.Lock] = deque()  # held; let go for who is next

    def _come(self) -> threading.Lock | None:
        with self._mutex:
            if not self._is_taken:
                self._is_taken = True
                return None
            mine = threading.Lock()
            mine.acquire()
            self._waiting.append(mine)
            return mine

    def _leave(self) -> None:
        with self._mutex:
            if self._waiting:
                self._waiting.popleft().release()
            else:
                self._is_taken = False

    @contextmanager
    def one(self, timeout_s: float) -> Iterator[None]:
        """Around what only one may do. Raises TimeoutError where its turn does not come in time."""
        mine = self._come()
        if mine is not None and not mine.acquire(timeout=timeout_s):
            with self._mutex:
                gave_up = mine in self._waiting  # else the turn came just now
                if gave_up:
                    self._waiting.remove(mine)
            if gave_up:
                raise TimeoutError(f"{len(self._waiting)} others wait for the same turn")
        try:
            yield
        finally:
            self._leave()
