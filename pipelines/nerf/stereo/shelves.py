"""Where the maps of a capture lie while they are being found: in memory, or in files.

A capture has hundreds of views, and each step of stereo makes a map of each. In files they leave
memory to what is being looked at, and a search that was cut short goes on from them.
"""

from __future__ import annotations

import shutil
import threading
from collections import OrderedDict
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Protocol, TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]
T_co = TypeVar("T_co", covariant=True)

_RECENT_BYTES = 2**26
"""Of all that lies in files, in memory too: what was looked at last."""


class ByView(Protocol[T_co]):
    """One thing of each view, by number, as a list or a full shelf has it."""

    def __len__(self) -> int: ...

    def __getitem__(self, index: int, /) -> T_co: ...

    def __iter__(self) -> Iterator[T_co]: ...


class Shelf(ByView[Any], Protocol):
    """Arrays of views. Who puts or takes one does not write into it any more. Several threads may
    put and take those of different views.
    """

    def has(self, index: int) -> bool:
        """Whether that view's lies there."""
        ...

    def __setitem__(self, index: int, values: Array, /) -> None: ...


class Shelves(Protocol):
    """Opens shelves for a number of views."""

    def kept(self, name: str, count: int, *, fresh: bool = False) -> Shelf:
        """One with what a search that was cut short left on it, unless it is to be empty."""
        ...

    def scratch(self, name: str, count: int) -> Shelf:
        """An empty one, for what nobody needs later."""
        ...


class MemoryShelf:
    """A shelf in memory."""

    def __init__(self, count: int) -> None:
        self._held: list[Array | None] = [None] * count

    def __len__(self) -> int:
        return len(self._held)

    def __iter__(self) -> Iterator[Array]:
        return (self[index] for index in range(len(self)))

    def has(self, index: int) -> bool:
        """As `Shelf`."""
        return self._held[index] is not None

    def __getitem__(self, index: int, /) -> Array:
        values = self._held[index]
        if values is None:
            raise KeyError(index)
        return values

    def __setitem__(self, index: int, values: Array, /) -> None:
        self._held[index] = values


class MemoryShelves:
    """Shelves in memory, which nobody finds again."""

    def kept(self, name: str, count: int, *, fresh: bool = False) -> Shelf:
        """As `Shelves`."""
        return MemoryShelf(count)

    def scratch(self, name: str, count: int) -> Shelf:
        """As `Shelves`."""
        return MemoryShelf(count)


class FileShelf:
    """A shelf of .npy files, `recent` ones in memory too."""

    def __init__(self, folder: Path, count: int, recent: _Recent) -> None:
        self._folder, self._count, self._recent = folder, count, recent
        folder.mkdir(parents=True, exist_ok=True)
        self._there = {int(path.stem) for path in folder.glob("*.npy") if _is_whole(path)}

    def __len__(self) -> int:
        return self._count

    def __iter__(self) -> Iterator[Array]:
        return (self[index] for index in range(self._count))

    def has(self, index: int) -> bool:
        """As `Shelf`."""
        return index in self._there

    def __getitem__(self, index: int, /) -> Array:
        if index not in self._there:
            raise KeyError(index)
        path = self._path(index)
        values = self._recent.find(path)
        if values is None:
            values = np.load(path, allow_pickle=False)
            self._recent.add(path, values)
        return values

    def __setitem__(self, index: int, values: Array, /) -> None:
        """The file is replaced as a whole: copies of it by links stay as they are."""
        path = self._path(index)
        partial = path.with_suffix(".partial")
        with partial.open("wb") as stream:
            np.save(stream, values, allow_pickle=False)
        partial.replace(path)
        self._there.add(index)
        self._recent.add(path, values)

    def _path(self, index: int) -> Path:
        return self._folder / f"{index:06d}.npy"


class FileShelves:
    """Shelves in files. kept: the folder of what may be found again; scratch: that of the rest."""

    def __init__(self, kept: Path, scratch: Path) -> None:
        self._kept, self._scratch = kept, scratch
        self._recent = _Recent()

    def kept(self, name: str, count: int, *, fresh: bool = False) -> Shelf:
        """As `Shelves`."""
        return self._open(self._kept / name, count, fresh)

    def scratch(self, name: str, count: int) -> Shelf:
        """As `Shelves`. It takes the place of an older one of that name."""
        return self._open(self._scratch / name, count, True)

    def _open(self, folder: Path, count: int, fresh: bool) -> FileShelf:
        if fresh:
            shutil.rmtree(folder, ignore_errors=True)
            self._recent.forget(folder)
        return FileShelf(folder, count, self._recent)


class _Recent:
    """The arrays that were looked at last, by their files. For several threads."""

    def __init__(self) -> None:
        self._held: OrderedDict[Path, Array] = OrderedDict()
        self._bytes = 0
        self._lock = threading.Lock()

    def find(self, path: Path) -> Array | None:
        with self._lock:
            if path in self._held:
                self._held.move_to_end(path)
            return self._held.get(path)

    def add(self, path: Path, values: Array) -> None:
        with self._lock:
            self._drop(path)
            self._held[path] = values
            self._bytes += values.nbytes
            while self._bytes > _RECENT_BYTES and len(self._held) > 1:
                self._drop(next(iter(self._held)))

    def forget(self, folder: Path) -> None:
        with self._lock:
            for path in [path for path in self._held if path.parent == folder]:
                self._drop(path)

    def _drop(self, path: Path) -> None:
        dropped = self._held.pop(path, None)
        self._bytes -= 0 if dropped is None else dropped.nbytes


def _is_whole(path: Path) -> bool:
    """Whether a file can be read: a machine that lost power may have left less of it."""
    try:
        np.load(path, mmap_mode="r", allow_pickle=False)
    except (ValueError, OSError, EOFError):
        return False
    return True


MEMORY = MemoryShelves()
