"""Where COLMAP models lie in an upload, and whether one is of any use beside the pictures there.

The API asks while it receives an upload: standard library only.
"""

from __future__ import annotations

import re
import tempfile
from collections.abc import Collection, Mapping
from pathlib import Path

from pipelines.captures.colmap_model import read_cameras, read_images
from pipelines.captures.importer import Listing
from pipelines.captures.named_files import NamedFiles, folder_of
from pipelines.errors import CaptureError

SUFFIXES = (".bin", ".txt")
MODEL_FILES = ("cameras", "images", "points3D", "frames", "rigs")
_COMMENTS = rb"(\xef\xbb\xbf)?(\s*#[^\n]*\n)*\s*"
_TEXTS = {
    "cameras": re.compile(
        rb"\s*#\s*(Camera list|CAMERA_ID)|" + _COMMENTS + rb"[0-9]+\s+[A-Z_]+\s+[0-9]+\s"
    ),
    "images": re.compile(
        rb"\s*#\s*(Image list|IMAGE_ID)|" + _COMMENTS + rb"[0-9]+(\s+[-+.0-9a-zA-Z]+){7}\s+[0-9]+\s"
    ),
}
"""How the texts start: with COLMAP's comments, or with others or none and a camera or an image."""
_MOST_LISTED = 1 << 24
_MOST_READ_BYTES = 256 << 20
"""In all, while an upload is received; what lies behind them is taken for useful until it is read.
"""


def folders_of(names: Collection[str], suffix: str) -> list[str]:
    """The folders with a model, "" or ending with "/", the least deep first."""
    last = "images" + suffix
    folders = [
        name[: len(name) - len(last)]
        for name in names
        if (name == last or name.endswith("/" + last))
        and name[: len(name) - len(last)] + "cameras" + suffix in names
    ]
    return sorted(folders, key=lambda folder: (folder.count("/"), folder))


def model_folders(listing: Listing) -> list[tuple[str, str]]:
    """Folders and suffixes of files that start as COLMAP writes them, the least deep first."""
    found = [
        (folder, suffix)
        for suffix in SUFFIXES
        for folder in folders_of(listing.heads, suffix)
        if all(_is_list(listing.heads, folder, what, suffix) for what in _TEXTS)
    ]
    return sorted(found, key=lambda place: (place[0].count("/"), place))


def useful_folder(listing: Listing) -> tuple[str, str] | None:
    """Folder and suffix of the least deep model that can be read and names a picture of those that
    came along; of the least deep one where no picture came, or nothing but heads is known.

    Raises CaptureError archive_damaged.
    """
    found = model_folders(listing)
    if not listing.pictures or listing.copy is None:
        return next(iter(found), None)
    left = _MOST_READ_BYTES
    for place in found:
        left -= _num_bytes(listing, *place)
        if left < 0 or fault_of(listing, *place) is None:
            return place
    return None


def _num_bytes(listing: Listing, folder: str, suffix: str) -> int:
    """Of the files that `fault_of` looks at."""
    return sum(listing.num_bytes[f"{folder}{what}{suffix}"] for what in _TEXTS)


def _is_list(heads: Mapping[str, bytes], folder: str, what: str, suffix: str) -> bool:
    """Whether a file of cameras or images starts as COLMAP writes it."""
    head = heads[f"{folder}{what}{suffix}"]
    if suffix == ".txt":
        return _TEXTS[what].match(head) is not None
    return len(head) >= 8 and int.from_bytes(head[:8], "little") < _MOST_LISTED


def fault_of(listing: Listing, folder: str, suffix: str) -> str | None:
    """Why a model is of no use to the pictures beside it, as the end of "a model that ..."; None
    where it is of use. listing: with `copy`. Raises CaptureError archive_damaged."""
    if listing.copy is None:
        raise ValueError("a listing of heads alone does not say what a model holds")
    cameras, images = (f"{folder}{what}{suffix}" for what in _TEXTS)
    with tempfile.TemporaryDirectory(prefix="colmap-") as scratch:
        path = Path(scratch) / "file"
        try:
            listing.copy(cameras, path)
            read_cameras(path, cameras)
            listing.copy(images, path)
            names = [image.name for image in read_images(path, images)]
        except CaptureError as error:
            if error.code != "poses_malformed":
                raise
            return f"cannot be read ({error.message.rstrip('.')})"
    exact, loose = NamedFiles(listing.pictures, folder_of(listing.pictures, names, folder)).find(
        names
    )
    return None if exact or loose else "names none of the pictures"
