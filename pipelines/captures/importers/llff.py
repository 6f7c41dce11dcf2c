"""LLFF's `poses_bounds.npy` beside the pictures that it is for.

    poses_bounds.npy   [N, 17] floats: rows [3, 5] of a pose and (height, width, focal length), then
                       the nearest and farthest depth
    images/*           or beside the file, N pictures; images_4/ and the like are reduced copies

A pose is world_from_camera, its columns are the camera's down, right and back. Lens: a pinhole,
its principal point in the middle of the picture. World: that of the structure from motion that
found it, no known unit. Row n is the n-th picture in the order of names: programs that wrote it
took names for text (0, 1, 10, ...), people count (0, 1, 2, ...), so that the pictures have to say
which (`pipelines.captures.pose_order`). A capture of more or fewer pictures than rows is refused.
Depths are not used: they are bounds of points with poses of a structure from motion, and ours are
found from the poses.
Source: Local Light Field Fusion, arXiv:1905.00889, and its public code.
"""

from __future__ import annotations

import ast
import math
import struct
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedPictures, PosedSource, Rows
from pipelines.captures.importer import Claim, Importer, Listing
from pipelines.captures.matrix_files import broken
from pipelines.captures.orders import orders, readings_of
from pipelines.captures.parsing import missing, resized
from pipelines.captures.roles import file_role
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError
from pipelines.scene.cameras_file import Intrinsics

_FILE = "poses_bounds.npy"
_MAGIC = b"\x93NUMPY"
_FOLDERS = ("images/", "")
_COLUMNS = 17
_FLOATS = {"<f8": "d", "<f4": "f"}
_MOST_BYTES = 16 << 20
_MOST_HEADER = 1000
_MOST_PIXELS = 1e6


def claims(listing: Listing) -> Claim | None:
    """An array of that name with pictures in `images/` beside it, or beside the file itself."""
    folders = {_folder(name) for name in listing.pictures}
    for root in listing.roots_of(_FILE):
        if not listing.heads[root + _FILE].startswith(_MAGIC):
            continue
        for folder in _FOLDERS:
            if root + folder in folders:
                return Claim(root, f"{_FILE} and pictures in {folder or 'its folder'}")
    return None


def read(archive: CaptureArchive, claim: Claim) -> PosedPictures:
    """The pictures, with poses in every order in which they may come.

    Raises CaptureError: poses_missing, poses_malformed, archive_damaged, too_large.
    """
    file = claim.root + _FILE
    rows = _rows(archive.read(file, _MOST_BYTES), file)
    names = _pictures(archive, claim.root)
    found = orders(names, len(rows), by_number=False)
    if not found:
        raise broken(
            f"{_FILE} has poses of {len(rows)} pictures, and {len(names)} pictures lie in "
            f'"{shown(_folder(names[0]) or "the top folder")}": it cannot be told which pose is '
            "whose."
        )
    failures: list[CaptureError] = []
    poses: list[_Row | None] = []
    for number, row in enumerate(rows):
        try:
            poses.append(_row(row, f"Row {number} of {_FILE}"))
        except CaptureError as error:
            failures.append(error)
            poses.append(None)

    def source(name: str, row: int) -> PosedSource | None:
        pose = poses[row]
        return None if pose is None else PosedSource(name, partial(resized, pose.lens), pose.pose)

    readings = readings_of(found, source)
    if not readings[0].sources:
        raise failures[0]
    archive.set_aside(
        [name for name in archive.images if name not in names], f"not among those of {_FILE}"
    )
    return PosedPictures(
        sources=readings[0].sources,
        readings=readings,
        failures=failures,
        metric=False,
        up="unknown",
        notes={"world": f"as in {_FILE}"},
        details={"num_poses": len(rows), "num_frames": len(names)},
    )


@dataclass(frozen=True)
class _Row:
    pose: Rows
    lens: Intrinsics


def _folder(name: str) -> str:
    return name[: name.rfind("/") + 1]


def _pictures(archive: CaptureArchive, root: str) -> list[str]:
    """The photos of the first folder that has any."""
    for folder in _FOLDERS:
        found = [
            name
            for name in archive.images
            if _folder(name) == root + folder and file_role(name) is None
        ]
        if found:
            return found
    raise missing(f"There are no photos beside {_FILE}.")


def _rows(data: bytes, file: str) -> list[tuple[float, ...]]:
    """The rows of an array file. Raises CaptureError poses_malformed."""
    what = f'"{shown(file)}"'
    try:
        form, fortran, shape, start = _header(data)
    except (ValueError, SyntaxError, LookupError, TypeError, struct.error, RecursionError) as error:
        raise broken(f"{what} is no array that is read.") from error
    if len(shape) != 2 or shape[1] != _COLUMNS or fortran:
        raise broken(f"{what} is an array of {shape}, not of rows of {_COLUMNS} numbers.")
    if not shape[0]:
        raise missing(f"{what} has no rows.")
    row = struct.Struct(f"<{_COLUMNS}{form}")
    if len(data) - start != shape[0] * row.size:
        raise broken(
            f"{what} says that it has {shape[0]} rows, and holds {len(data) - start} bytes of "
            f"{shape[0] * row.size}."
        )
    return list(row.iter_unpack(data[start:]))


def _header(data: bytes) -> tuple[str, bool, tuple[int, ...], int]:
    """Type of number, order, shape, and where the numbers start, of a .npy file.

    Source: numpy's documentation, numpy.lib.format, versions 1.0 and 2.0.
    """
    if not data.startswith(_MAGIC):
        raise ValueError("no array file")
    wide = data[len(_MAGIC)] > 1
    begin = 12 if wide else 10
    (length,) = struct.unpack_from("<I" if wide else "<H", data, 8)
    if length > _MOST_HEADER:
        raise ValueError("a header of absurd length")
    header = ast.literal_eval(data[begin : begin + length].decode("latin1").strip())
    shape = header["shape"]
    if not isinstance(shape, tuple) or not all(type(size) is int and size >= 0 for size in shape):
        raise ValueError("no shape")
    return _FLOATS[header["descr"]], bool(header["fortran_order"]), shape, begin + length


def _row(values: Sequence[float], what: str) -> _Row:
    """A pose [3, 4] and its lens. Raises CaptureError poses_malformed."""
    if not all(math.isfinite(value) for value in values):
        raise broken(f"{what} has a number that is not finite.")
    table = [values[at : at + 5] for at in (0, 5, 10)]
    height, width, focal = (row[4] for row in table)
    if not all(0 < value < _MOST_PIXELS for value in (height, width, focal)):
        raise broken(f"{what} is not of a camera's picture: {width:g}x{height:g}, {focal:g}.")
    lens = Intrinsics(round(width), round(height), focal, focal, width / 2, height / 2)
    pose = tuple((right, -down, back, place) for down, right, back, place, _ in table)
    return _Row(pose, lens)


IMPORTER = Importer(
    kind="llff",
    brings="poses",
    claims=claims,
    read="pipelines.captures.importers.llff:read",
)
