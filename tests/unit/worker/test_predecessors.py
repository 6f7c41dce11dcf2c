"""Who still runs a stage here under a lost claim is ended; nobody else is."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest

from storage.errors import LostLeaseError
from tests.integration.engine import is_running
from worker.locks import FolderInUseError, folder_lock, read_holder
from worker.predecessors import end_predecessor, run_lock

HOLD = """
import subprocess, sys, time
from pathlib import Path
from worker.locks import folder_lock
from worker.predecessors import holder_note, run_lock
note = holder_note(int(sys.argv[2]))
if sys.argv[3:]:
    note = note.replace(b'"started_at": "', b'"started_at": "1')
with folder_lock(Path(sys.argv[1]), run_lock("train"), 0.0, note):
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(600)"])
    print(child.pid, flush=True)
    time.sleep(600)
"""


@contextmanager
def holder(root: Path, token: int, *more: str) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """A process that runs the stage under a token, and the id of what it started."""
    made = subprocess.Popen(
        [sys.executable, "-c", HOLD, str(root), str(token), *more],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )
    assert made.stdout is not None
    try:
        yield made, int(made.stdout.readline())
    finally:
        with suppress(ProcessLookupError):
            os.killpg(made.pid, signal.SIGKILL)
        made.wait()
        made.stdout.close()


def test_an_earlier_claim_s_process_goes_with_all_that_it_started(tmp_path: Path) -> None:
    with holder(tmp_path, 3) as (process, child):
        with pytest.raises(LostLeaseError):
            end_predecessor(tmp_path, "train", 2)
        assert is_running(process.pid)
        end_predecessor(tmp_path, "train", 4)
        assert process.wait(5) == -9
        assert not is_running(child)
    end_predecessor(tmp_path, "train", 5)  # the note of who is dead harms nobody


def test_a_process_that_only_has_the_number_of_the_holder_is_left_alone(tmp_path: Path) -> None:
    with holder(tmp_path, 3, "of another start") as (process, _):
        with pytest.raises(FolderInUseError):
            end_predecessor(tmp_path, "train", 4, timeout_s=0.3)
        assert is_running(process.pid)


def test_a_lock_says_who_holds_it_and_nothing_once_it_is_free(tmp_path: Path) -> None:
    assert read_holder(tmp_path, run_lock("train")) is None
    note = json.dumps({"token": 1}).encode()
    with folder_lock(tmp_path, run_lock("train"), 0.0, note):
        assert read_holder(tmp_path, run_lock("train")) == note
        with pytest.raises(FolderInUseError), folder_lock(tmp_path, run_lock("train"), 0.0):
            pass
        assert read_holder(tmp_path, run_lock("train")) == note
    assert read_holder(tmp_path, run_lock("train")) is None
    assert (tmp_path / ".locks" / run_lock("train")).read_bytes() == b""
