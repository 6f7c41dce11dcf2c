"""Pictures that a file of poses names, looked up in the archive they came in.

Paths are often those of another machine: absolute, with folders that were not packed, without a
suffix, in other capitals. A path is only ever compared with the archive's names, so none can lead
out of it. Standard library only.
"""

from __future__ import annotations

import posixpath
from collections import Counter
from collections.abc import Iterable, Mapping

from pipelines.captures.roles import folder_role, named_role

_SUFFIXES = ("", ".png", ".jpg", ".jpeg", ".webp", ".PNG", ".JPG", ".JPEG")


class NamedFiles:
    """Finds files of an archive by the paths in a file that lies at `root`."""

    def __init__(self, names: Iterable[str], root: str) -> None:
        self._names = frozenset(names)
        self._root = root
        self._by_base: dict[str, list[str]] = {}
        for name in sorted(self._names):
            self._by_base.setdefault(name.rpartition("/")[2].casefold(), []).append(name)

    def exact(self, path: str) -> str | None:
        """The file at that very path below the root; a picture's suffix may be left out."""
        plain = _plain(path)
        if plain.startswith("/"):
            return None
        name = posixpath.normpath(posixpath.join(self._root, plain))
        return next((name + end for end in _SUFFIXES if name + end in self._names), None)

    def by_its_end(self, path: str) -> str | None:
        """The one file whose name ends like the path, over as many folders as any file does.

        None where several do, and where a mask or a depth map would stand for a photo.
        """
        parts = [part for part in _plain(path).casefold().split("/") if part not in ("", ".", "..")]
        if not parts:
            return None
        candidates = {
            name
            for end in {end.casefold() for end in _SUFFIXES}
            for name in self._by_base.get(parts[-1] + end, ())
            if named_role(name) == named_role(path)
        }
        shared = {name: _shared_folders(name, parts[:-1]) for name in candidates}
        best = [name for name in candidates if shared[name] == max(shared.values())]
        return best[0] if len(best) == 1 else None

    def find(self, paths: Iterable[str]) -> tuple[dict[str, str], dict[str, str]]:
        """Files by the paths that name them: those found exactly, and those found by their end.

        A file that one path names exactly, or that several would have by its end, is not found by
        its end.
        """
        wanted = dict.fromkeys(paths)
        exact = {path: name for path in wanted if (name := self.exact(path))}
        taken = set(exact.values())
        loose = {
            path: name
            for path in wanted
            if path not in exact and (name := self.by_its_end(path)) and name not in taken
        }
        return exact, _unique(loose)


def folder_of(names: Iterable[str], paths: Iterable[str], near: str = "") -> str:
    """The folder that most of the paths are relative to, "" or ending with "/".

    Of several, as `images/` and its reduced copy `images_2/`: none for masks or depth maps, then
    one called `images`, then the one that shares most with `near`, then the least deep.
    """
    by_base: dict[str, list[str]] = {}
    for name in names:
        by_base.setdefault(name.rpartition("/")[2], []).append(name)
    counts: Counter[str] = Counter()
    for path in {posixpath.normpath(_plain(path)).lstrip("/") for path in paths}:
        base = path.rpartition("/")[2]
        for wanted in (path + end for end in _SUFFIXES if base + end in by_base):
            for name in by_base[wanted.rpartition("/")[2]]:
                if name == wanted or name.endswith("/" + wanted):
                    counts[name[: len(name) - len(wanted)]] += 1

    def rank(folder: str) -> tuple[int, bool, bool, int, int, str]:
        return (
            -counts[folder],
            folder_role(folder) is not None,
            not f"/{folder}".endswith("/images/"),
            -len(posixpath.commonprefix([folder, near])),
            folder.count("/"),
            folder,
        )

    return min(counts, key=rank, default=near)


def _plain(path: str) -> str:
    plain = path.replace("\\", "/")
    return "/" + plain[2:] if plain[1:2] == ":" else plain


def _shared_folders(name: str, folders: list[str]) -> int:
    """How many folders above the file agree, from the last one up."""
    count = 0
    for ours, theirs in zip(
        reversed(name.casefold().split("/")[:-1]), reversed(folders), strict=False
    ):
        if ours != theirs:
            break
        count += 1
    return count


def _unique(found: Mapping[str, str]) -> dict[str, str]:
    count = Counter(found.values())
    return {path: name for path, name in found.items() if count[name] == 1}
