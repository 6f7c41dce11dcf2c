"""What goes wrong at the named steps of `storage.steps`."""

from __future__ import annotations

import os
import signal
import threading
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from sqlalchemy.exc import OperationalError

from storage.steps import names, watch


def kill_at(step: str, nth: int = 1, claims: int = 0) -> Callable[[str], None]:
    """A watcher that kills this process, as `kill -9` does, when a step is reached so often.

    claims: what comes before the claim of that number does not count.
    """
    return _nth(step, nth, lambda: os.kill(os.getpid(), signal.SIGKILL), claims)


def lose_answer() -> None:
    """What a caller sees when the connection breaks in a COMMIT."""
    raise OperationalError("COMMIT", {}, Exception("the connection is gone"))


def _nth(step: str, nth: int, act: Callable[[], object], claims: int = 0) -> Callable[[str], None]:
    if step not in names():
        raise ValueError(f"no step {step}")
    lock = threading.Lock()
    seen: Counter[str] = Counter()

    def watcher(name: str) -> None:
        with lock:
            seen["claims"] += name == "claim.commit"
            seen["due"] += name == step and seen["claims"] >= claims
            due = name == step and seen["claims"] >= claims and seen["due"] == nth
        if due:
            act()

    return watcher


@contextmanager
def at_step(
    step: str, act: Callable[[], object] = lose_answer, nth: int = 1, claims: int = 0
) -> Iterator[threading.Event]:
    """While the block runs, something happens when this process reaches a step so often.

    claims: as of `kill_at`.

    act: by default the answer to the COMMIT is lost: at `.commit` it has not happened, at
    `.committed` it has. The event tells whether it came to that.
    """
    happened = threading.Event()

    def doing() -> None:
        happened.set()
        act()

    watch(_nth(step, nth, doing, claims))
    try:
        yield happened
    finally:
        watch(None)
