"""The named steps of a job's way through database and object store: where a process may die, and
where an answer may be lost.

Product code says `reached(name)` at each of them; that does nothing unless a test watches. Around a
transaction two are said by `storage.db.Database.session_scope`: `.commit` when all is done but the
COMMIT, `.committed` after it, before anybody was told. While files go to the object store three
are: `.bytes` within one file, `.put` after each, `.stored` after the last, before any record names
them. `tests/integration/test_steps*.py` kill a process at every one, and lose the answer of every
COMMIT.
"""

from __future__ import annotations

from collections.abc import Callable
from types import MappingProxyType

_COMMIT = (".commit", ".committed")
_STORE = (".bytes", ".put", ".stored")

STEPS: MappingProxyType[str, tuple[str, ...]] = MappingProxyType(
    {
        # the API
        "hold": _COMMIT,  # an Idempotency-Key is held
        "capture": (".bytes", ".put"),  # uploaded bytes go to the store; no record names them yet
        "create": _COMMIT,  # a capture, a job, or a job's next generation
        "cancel": _COMMIT,
        "delete": _COMMIT,  # the records of a job or a capture
        # a worker with a claim
        "claim": _COMMIT,
        "run": (".fetched", ".begun", ".done"),  # inputs are here; the stage runs; it has ended
        "beat": _COMMIT,  # lease and progress
        "checkpoint": (*_STORE, *_COMMIT, ".replaced"),  # and the one before is deleted
        "publish": _STORE,  # what the stage has made
        "report": _STORE,  # what is told of a failure
        "finish": (*_COMMIT, ".tidied"),  # however it ended; what other attempts left is deleted
        # housekeeping
        "reap": _COMMIT,
        "sweep": _COMMIT,  # orphans are put up for deletion
        "erase": (".deleted", *_COMMIT),  # bytes are gone; so is the note that they should go
    }
)
"""By operation, in the order in which they are reached."""

_watcher: Callable[[str], None] | None = None


def reached(step: str) -> None:
    """Say that this process is at a step."""
    if _watcher is not None:
        _watcher(step)


def watch(watcher: Callable[[str], None] | None) -> None:
    """Have a function told of each step in this process, for tests. What it raises, the step does.

    None ends it.
    """
    global _watcher
    _watcher = watcher


def names() -> list[str]:
    """All steps, such as "claim.commit"."""
    return [operation + step for operation, steps in STEPS.items() for step in steps]
