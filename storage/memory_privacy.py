"""Closes this process's memory to other processes of the same user: it holds the service's keys."""

from __future__ import annotations

import ctypes
import sys

_PR_SET_DUMPABLE = 4


def close_memory() -> None:
    """From now on only root, with its capabilities, may read this process's memory, environment and
    open files in /proc, or trace it; it leaves no core file. Nothing happens but on Linux.

    What it starts is open again: a program's start opens its own.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).prctl(_PR_SET_DUMPABLE, ctypes.c_ulong(0), 0, 0, 0)
