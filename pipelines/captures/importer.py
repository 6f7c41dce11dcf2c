"""What an importer is: one format of captures, how it is recognised, and where its reader is.

An importer is one file below `pipelines/captures/importers` and one line in
`pipelines.captures.catalogue`. Its file holds two functions and the record `IMPORTER`:

- `claims(listing) -> Claim | None`: is an upload of this format, and where in it does that start?
- `read(archive, claim) -> Photos | PosedPictures`: what is in it (`pipelines.captures.contents`).

Both use the standard library alone, since the API loads every importer to recognise uploads, and
neither decodes a picture: checks of poses and lenses, pictures, masks and files to write are the
same for all formats (`pipelines.captures.photos`, `pipelines.captures.posed`). A reader that needs
more than that goes into a file of its own: `IMPORTER.read` is only resolved in the stage process.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Literal

from pipelines.captures.magic import image_format

Brings = Literal["film", "photos", "poses"]


@dataclass(frozen=True)
class Listing:
    """What an upload holds, as far as it is known without unpacking.

    heads: the first bytes (`magic.HEAD_BYTES`) of each file of an archive by its name, with "/";
    of an upload that is no archive, those of the upload itself under the name "".
    copy: writes one file of an archive to a path; None where there is nothing but heads.
    num_bytes: of each file, where `copy` is.
    """

    heads: Mapping[str, bytes]
    is_archive: bool = True
    copy: Callable[[str, Path], None] | None = None
    num_bytes: Mapping[str, int] = field(default_factory=dict)

    @cached_property
    def pictures(self) -> frozenset[str]:
        """Files that are pictures by content, and of a format that is read."""
        return frozenset(name for name, head in self.heads.items() if image_format(head))

    @cached_property
    def _picture_folders(self) -> frozenset[str]:
        """Every folder with a picture in it or below it, ending with "/"; "" is the top."""
        return frozenset(folder for name in self.pictures for folder in folders_above(name))

    def has_pictures_below(self, folder: str) -> bool:
        """Whether any picture lies in a folder ("" or ending with "/") or deeper."""
        return folder in self._picture_folders

    def roots_of(self, file: str) -> list[str]:
        """Folders ("" or ending with "/") in which `file` lies, the least deep first."""
        roots = (
            name[: len(name) - len(file)]
            for name in self.heads
            if name == file or name.endswith("/" + file)
        )
        return sorted(roots, key=_depth)

    def roots_of_folder(self, folder: str) -> list[str]:
        """Folders in which the folder `folder` (ending with "/") lies, the least deep first."""
        roots = {
            above[: len(above) - len(folder)]
            for name in self.heads
            for above in folders_above(name)
            if above == folder or above.endswith("/" + folder)
        }
        return sorted(roots, key=_depth)


def folders_above(name: str) -> Iterator[str]:
    """The folders that a file lies in, from "" down, each ending with "/"."""
    yield ""
    end = name.find("/")
    while end >= 0:
        yield name[: end + 1]
        end = name.find("/", end + 1)


def _depth(root: str) -> tuple[int, str]:
    return root.count("/"), root


@dataclass(frozen=True)
class Claim:
    """An importer's word that an upload is of its format.

    root: the folder that it starts in, "" or ending with "/". why: what it was recognised by.
    """

    root: str
    why: str


@dataclass(frozen=True)
class Importer:
    """One format.

    kind: what the API and the record call it.
    brings: "film", the upload itself is a video whose frames are to be chosen; "photos", pictures
        whose poses are to be found; "poses", pictures that have theirs.
    read: dotted path "module:function" of `(archive, claim) -> contents`; "" for a film.
    """

    kind: str
    brings: Brings
    claims: Callable[[Listing], Claim | None]
    read: str = ""
