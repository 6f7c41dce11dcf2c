"""Stops asking what does not answer, for pauses that double; then one asks again."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable


class Breaker:
    """Closed while calls succeed; open for a while after one failed. Safe between threads."""

    def __init__(
        self,
        first_s: float = 1.0,
        most_s: float = 15.0,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        """first_s, most_s: the first and the longest pause, in seconds."""
        self._first_s = first_s
        self._most_s = most_s
        self._clock = clock
        self._lock = threading.Lock()
        self._pause_s = 0.0
        self._until = 0.0

    @property
    def is_open(self) -> bool:
        """Whether calls should not even be tried now."""
        with self._lock:
            return self._pause_s > 0.0 and self._clock() < self._until

    def failed(self) -> float:
        """A call failed. Returns the pause that starts now, in seconds."""
        with self._lock:
            self._pause_s = min(max(2.0 * self._pause_s, self._first_s), self._most_s)
            self._until = self._clock() + self._pause_s
            return self._pause_s

    def succeeded(self) -> None:
        """A call succeeded: the next failure pauses for the shortest time again."""
        with self._lock:
            self._pause_s = 0.0
