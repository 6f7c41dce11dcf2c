"""Room on the disk where jobs run."""

from __future__ import annotations

import logging
import shutil
from pathlib import Path

_log = logging.getLogger("nerfworks.worker")


def free_bytes(folder: Path) -> int:
    """What is free on the disk of a folder, which need not exist yet."""
    while not folder.exists():
        folder = folder.parent
    return shutil.disk_usage(folder).free


class DiskWatch:
    """Whether there is the room that every stage needs, so that a full disk fails no job."""

    def __init__(self, folder: Path, min_free_bytes: int) -> None:
        self._folder = folder
        self._min_free_bytes = min_free_bytes
        self._had_room = True

    def has_room(self) -> bool:
        """To be asked before a claim. The log hears when it changes."""
        free = free_bytes(self._folder)
        has_room = free >= self._min_free_bytes
        if has_room != self._had_room:
            if has_room:
                _log.warning("there is room on the disk again: stages are begun")
            else:
                _log.warning(
                    "no stage is begun: %s has %.2f GiB free and %.2f are needed; free some space",
                    self._folder,
                    free / 2**30,
                    self._min_free_bytes / 2**30,
                )
        self._had_room = has_room
        return has_room
