"""Bounds that the kernel keeps for each process: memory, files, processes, processor time.

RLIMIT_DATA bounds what a process can write to and nobody shares: its memory, and not the address
space that libraries reserve. CUDA writes to reservations of that kind too, so that a stage on a GPU
has no bound there.
"""

from __future__ import annotations

import os
import resource
import sys
from dataclasses import dataclass
from pathlib import Path

_SHARE_OF_MEMORY = 0.95
_CGROUP = Path("/sys/fs/cgroup")
_CGROUP_FILES = ("memory.max", "memory/memory.limit_in_bytes")


@dataclass(frozen=True)
class Limits:
    """memory_bytes, file_bytes: 0 for none. processes: that the user may have besides those that
    run already. open_files: of one process."""

    memory_bytes: int
    file_bytes: int
    processes: int
    open_files: int


def machine_memory_bytes() -> int:
    """What this machine, or the container around us, has; 0 where nobody knows."""
    found = []
    try:
        found.append(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE"))
    except (ValueError, OSError):
        return 0
    for name in _CGROUP_FILES:
        try:
            found.append(int((_CGROUP / name).read_text()))
        except (OSError, ValueError):
            continue  # no such group, or "max"
    return min(found)


def default_memory_bytes() -> int:
    """Nearly all that there is: a stage that wants more would be killed by the kernel anyway."""
    return int(machine_memory_bytes() * _SHARE_OF_MEMORY)


def _num_tasks(uid: int) -> int:
    """Processes and threads of a user."""
    total = 0
    for entry in Path("/proc").iterdir():
        try:
            if entry.name.isdigit() and entry.stat().st_uid == uid:
                total += len(os.listdir(entry / "task"))
        except OSError:
            continue  # it has ended
    return total


def _lower(kind: int, value: int) -> None:
    """Set both bounds, where they are not lower already."""
    hard = resource.getrlimit(kind)[1]
    bound = value if hard == resource.RLIM_INFINITY else min(value, hard)
    resource.setrlimit(kind, (bound, bound))


def apply_limits(limits: Limits) -> list[str]:
    """Bound this process and all that it starts, each by itself. Names what is bounded."""
    _lower(resource.RLIMIT_CORE, 0)
    _lower(resource.RLIMIT_NOFILE, limits.open_files)
    bounded = ["core", "open files"]
    if limits.file_bytes:
        _lower(resource.RLIMIT_FSIZE, limits.file_bytes)
        bounded.append("file size")
    if sys.platform != "linux":
        return bounded
    if limits.memory_bytes:
        _lower(resource.RLIMIT_DATA, limits.memory_bytes)
        bounded.append("memory")
    if os.getuid() != 0:  # the kernel lets root have as many as it likes
        _lower(resource.RLIMIT_NPROC, _num_tasks(os.getuid()) + limits.processes)
        bounded.append("processes")
    return bounded


def allow_cpu_seconds(seconds: float) -> None:
    """From now on this process may use so much processor time, and what it starts as much each."""
    used = resource.getrusage(resource.RUSAGE_SELF)
    hard = resource.getrlimit(resource.RLIMIT_CPU)[1]
    soft = int(used.ru_utime + used.ru_stime + seconds) + 1
    if hard != resource.RLIM_INFINITY:
        soft = min(soft, hard)
    resource.setrlimit(resource.RLIMIT_CPU, (soft, hard))
