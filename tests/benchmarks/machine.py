"""The machine that a benchmark ran on: without it no figure can be compared.

Also what every benchmark needs to know of its own process: threads and peak memory.
"""

from __future__ import annotations

import importlib.metadata
import os
import platform
import re
import resource
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import torch

GIB = 2**30


def describe(threads: int | None = None) -> dict[str, Any]:
    """Processor, memory, GPU and versions as plain data; None where something is not known.

    threads: set torch's (and with it the kernels') number first; None leaves it.
    """
    if threads is not None:
        torch.set_num_threads(threads)
    return {
        "cpu": _cpu_model(),
        "cores": _num_cores(),
        "threads": torch.get_num_threads(),
        "memory_gib": _memory_gib(),
        "load_average": _load_average(),
        "gpu": _gpu(),
        "system": f"{platform.system()} {platform.machine()}",
        "python": platform.python_version(),
        "versions": {name: _version(name) for name in ("torch", "numba", "numpy", "triton")},
        "commit": _commit(),
        "time_utc": time.strftime("%Y-%m-%dT%H:%M:%SZ", time.gmtime()),
    }


def heading(machine: dict[str, Any]) -> str:
    """The machine in two lines for the head of a table."""
    memory = "?" if machine["memory_gib"] is None else f"{machine['memory_gib']:.0f}"
    load = machine["load_average"]
    versions = ", ".join(f"{name} {text}" for name, text in machine["versions"].items() if text)
    busy = "" if load is None else f", load {load:.1f} at the start"
    return (
        f"Machine: {machine['cpu']}, {machine['cores']} cores, {machine['threads']} threads used, "
        f"{memory} GiB, GPU {machine['gpu'] or 'none'}{busy}.\n"
        f"Python {machine['python']}, {versions}, commit {machine['commit'] or 'unknown'}, "
        f"{machine['time_utc']}."
    )


def peak_memory_bytes() -> int:
    """The most memory this process had resident so far, bytes.

    Linux's VmHWM where it can be read: `getrusage` also counts what the parent held when it
    started us.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        found = re.search(r"^VmHWM:\s+(\d+) kB", status.read_text(), re.MULTILINE)
        if found:
            return int(found[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if sys.platform == "darwin" else peak * 1024


def wait_for_gpu() -> None:
    """Wait until the GPU has done what was asked of it, where there is one."""
    if torch.cuda.is_available():
        torch.cuda.synchronize()


def _cpu_model() -> str:
    path = Path("/proc/cpuinfo")
    if path.is_file():
        found = re.search(r"^model name\s*:\s*(.+)$", path.read_text(), re.MULTILINE)
        if found:
            return found[1].strip()
    return platform.processor() or platform.machine()


def _num_cores() -> int:
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def _memory_gib() -> float | None:
    try:
        return round(os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE") / GIB, 1)
    except (ValueError, OSError):
        return None


def _load_average() -> float | None:
    try:
        return round(os.getloadavg()[0], 2)
    except OSError:
        return None


def _gpu() -> str | None:
    if not torch.cuda.is_available():
        return None
    properties = torch.cuda.get_device_properties(0)
    return f"{properties.name}, {properties.total_memory / GIB:.0f} GiB"


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _commit() -> str | None:
    """The commit of this checkout, with a + where files differ from it."""
    command = ["git", "describe", "--always", "--dirty=+", "--exclude=*"]
    folder = Path(__file__).resolve().parent
    try:
        answer = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return answer.stdout.strip() if answer.returncode == 0 else None
