"""What goes wrong at the named steps of `storage.steps`."""

from __future__ import annotations

import os
import signal
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sqlalchemy.exc import OperationalError

from storage.steps import names, watch


def kill_at(step: str, nth: int = 1) -> Callable[[str], None]:
    """A watcher that kills this process, as `kill -9` does, when a step is reached so often."""
    return _nth(step, nth, lambda: os.kill(os.getpid(), signal.SIGKILL))


def lose_answer() -> None:
    """What a caller sees when the connection breaks in a COMMIT."""
    raise OperationalError("COMMIT", {}, Exception("the connection is gone"))


def _nth(step: str, nth: int, act: Callable[[], object]) -> Callable[[str], None]:
    if step not in names():
        raise ValueError(f"no step {step}")
    lock, left = threading.Lock(), [nth]

    def watcher(name: str) -> None:
        if name != step:
            return
        with lock:
            left[0] -= 1
            due = left[0] == 0
        if due:
            act()

    return watcher


@contextmanager
def at_step(
    step: str, act: Callable[[], object] = lose_answer, nth: int = 1
) -> Iterator[threading.Event]:
    """While the block runs, something happens when this process reaches a step so often.

    act: by default the answer to the COMMIT is lost: at `.commit` it has not happened, at
    `.committed` it has. The event tells whether it came to that.
    """
    happened = threading.Event()

    def doing() -> None:
        happened.set()
        act()

    watch(_nth(step, nth, doing))
    try:
        yield happened
    finally:
        watch(None)
