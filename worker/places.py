"""Folders that a stage process was let into, and whether they are still the same.

Landlock lets a process into a folder, not into a name: where somebody deletes the folder of jobs or
of caches under a worker, and it is made anew, a process from before may not write there.
"""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterable
from pathlib import Path


def make_places(paths: Iterable[str]) -> None:
    """Make the folders that are gone; those that cannot be made are somebody else's."""
    for path in paths:
        with contextlib.suppress(OSError):
            Path(path).mkdir(parents=True, exist_ok=True)


def places_of(paths: Iterable[str]) -> dict[str, tuple[int, int]]:
    """(device, inode) of those that are there."""
    found = {}
    for path in paths:
        with contextlib.suppress(OSError):
            stat = os.stat(path)
            found[path] = (stat.st_dev, stat.st_ino)
    return found
