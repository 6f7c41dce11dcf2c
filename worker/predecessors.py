"""Ends what an earlier claim of a stage still runs on this machine.

A worker that is frozen longer than its lease (SIGSTOP, a debugger, a disk that hangs) loses it, but
its stage process goes on, in the folder that the next claim is to write. The process that runs a
stage holds a lock there, with a note of who it is and under which token it runs. Who comes with a
later token, whose claim the database has therefore given up on the other, ends it.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import signal
import time
from pathlib import Path

from storage.errors import LostLeaseError
from worker.locks import FolderInUseError, read_holder, started_at

STEP_S = 0.1
TIMEOUT_S = 20.0

_log = logging.getLogger("nerfworks.worker")


def run_lock(stage: str) -> str:
    """The name of the lock that is held while a stage runs in a job's folder."""
    return f"run-{stage}"


def holder_note(token: int) -> bytes:
    """What this process leaves at the lock that it holds. It leads a process group."""
    pid = os.getpid()
    return json.dumps({"pid": pid, "started_at": started_at(pid), "token": token}).encode()


def end_predecessor(root: Path, stage: str, token: int, timeout_s: float = TIMEOUT_S) -> None:
    """Kill the process, and what it started, that runs this stage here under an earlier token.

    Raises LostLeaseError where it runs under a later one: then our own claim is void; and
    FolderInUseError where it does not go.
    """
    deadline = time.monotonic() + timeout_s
    while (note := read_holder(root, run_lock(stage))) is not None:
        with contextlib.suppress(ValueError, KeyError, TypeError):  # it is just being written
            found = json.loads(note)
            if found["token"] > token:
                raise LostLeaseError(f"{stage} runs here under a later claim")
            if found["token"] < token and started_at(found["pid"]) == found["started_at"]:
                _log.warning("%s: ending process %s of a lost claim", stage, found["pid"])
                with contextlib.suppress(ProcessLookupError, PermissionError):
                    os.killpg(found["pid"], signal.SIGKILL)
        if time.monotonic() > deadline:
            raise FolderInUseError(f"{run_lock(stage)} is in use by another process")
        time.sleep(STEP_S)
