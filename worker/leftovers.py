"""What a stage started and left running when it ended.

Everything that a stage starts is in the process group of its process, and stays there where the
kernel filters system calls (`worker.containment.seccomp`).
"""

from __future__ import annotations

import contextlib
import os
import signal
from collections.abc import Container
from pathlib import Path

_ROUNDS = 20


def members(group: int) -> list[int]:
    """Processes of a group that are not dead; none where the system has no /proc."""
    found = []
    for entry in Path("/proc").glob("[0-9]*"):
        with contextlib.suppress(OSError, IndexError):
            fields = (entry / "stat").read_text().rpartition(")")[2].split()
            if int(fields[2]) == group and fields[0] not in ("Z", "X"):
                found.append(int(entry.name))
    return found


def end_group(group: int, spare: Container[int]) -> int:
    """Kill the members of a group but those to spare. Returns how many there were.

    Again and again, while they still start others.
    """
    ended = set()
    for _ in range(_ROUNDS):
        others = [pid for pid in members(group) if pid not in spare]
        if not others:
            break
        for pid in others:
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.kill(pid, signal.SIGKILL)
            ended.add(pid)
    return len(ended)
