"""Pictures that a file of poses lists, found in the archive, and what is to be told of the others.

For every format that names its pictures. Standard library only.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from pipelines.captures.archive_rules import shown
from pipelines.captures.named_files import NamedFiles, folder_of
from pipelines.captures.parsing import missing, some_of
from pipelines.captures.roles import PICTURE_SUFFIX
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError

_SUFFIX = re.compile(rf"{PICTURE_SUFFIX}$", re.IGNORECASE)


@dataclass(frozen=True)
class Matched:
    """found: names in the archive by the paths that the file has. absent: paths without a picture.
    warnings: what is to be told."""

    found: dict[str, str]
    absent: list[str]
    warnings: list[str]


def match_pictures(
    archive: CaptureArchive, file: str, paths: Sequence[str], near: str = ""
) -> Matched:
    """The pictures of the paths, which are relative to a folder that the file does not say.

    file: what messages call it. near: the folder that it lies in, "" or ending with "/".
    Pictures that nobody lists are set aside. Raises CaptureError poses_missing where none is there.
    """
    files = NamedFiles(archive.images, folder_of(archive.images, paths, near))
    exact, loose = files.find(paths)
    loose |= _of_another_format(files, [path for path in paths if path not in exact | loose])
    loose = {path: name for path, name in loose.items() if name not in exact.values()}
    found = exact | loose
    if not found:
        raise none_there(file, paths)
    absent = [path for path in dict.fromkeys(paths) if path not in found]
    archive.set_aside(archive.images - set(found.values()), f"not listed in {file}")
    return Matched(found, absent, listing_warnings(file, paths, absent, loose))


def _of_another_format(files: NamedFiles, paths: Sequence[str]) -> dict[str, str]:
    """Pictures that were developed or converted since: of the same name but for its suffix."""
    stems = {path: _SUFFIX.sub("", path) for path in paths}
    exact, loose = files.find(stem for path, stem in stems.items() if stem != path)
    found = {path: (exact | loose)[stem] for path, stem in stems.items() if stem in exact | loose}
    count = Counter(found.values())
    return {path: name for path, name in found.items() if count[name] == 1}


def none_there(file: str, paths: Sequence[str]) -> CaptureError:
    """The error for a list of which no picture came along."""
    wanted = list(dict.fromkeys(paths))
    return missing(
        f"{file} lists {len(wanted)} pictures, and none of them is in the archive: "
        f"{some_of(wanted)}.",
        hint="Pack the pictures together with that file, under the names that it gives them; or "
        "send the pictures alone to have their poses found.",
    )


def listing_warnings(
    file: str, paths: Sequence[str], absent: Sequence[str], loose: Mapping[str, str]
) -> list[str]:
    """What is to be told of a list: pictures not there, found by the end of the name, or twice.

    paths: all of the list. loose: names by paths, where only the end of the name was the same.
    """
    warnings = []
    if absent:
        warnings.append(
            f"{file} lists {len(paths)} pictures; {len(absent)} of them are not in the "
            f"archive: {some_of(absent)}."
        )
    if loose:
        path, name = min(loose.items())
        warnings.append(
            f"{len(loose)} paths in {file} lead nowhere in the archive and were matched by the end "
            f'of the name, as "{shown(path)}" with "{shown(name)}".'
        )
    twice = [path for path, count in Counter(paths).items() if count > 1]
    if twice:
        warnings.append(
            f"{file} lists {len(twice)} pictures more than once, and the first pose is taken: "
            f"{some_of(twice)}."
        )
    return warnings
