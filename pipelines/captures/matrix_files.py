"""Text files of plain numbers, as RGB-D programs write poses and intrinsics. Standard library only.

Numbers stand in rows, with blanks, tabs or commas between; empty rows and rows that start with "#"
count for nothing. "nan" and "inf" are numbers here: what they mean differs between programs.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import Rows
from pipelines.captures.parsing import malformed
from pipelines.captures.unpack import CaptureArchive
from pipelines.errors import CaptureError

_SLACK = 1e-3
"""How far the last row of a matrix may be from 0 0 0 1; files are rounded."""
_MATRIX_BYTES = 1 << 16
_LIST_BYTES = 64 << 20
MOST_ROWS = 200_000
"""Of a list: an hour of film at 55 frames a second."""
MOST_ROW_BYTES = 10_000


def broken(message: str) -> CaptureError:
    """The error for poses or intrinsics of files that no app exports again."""
    return malformed(
        message, hint="Check the file, or send the pictures alone to have their poses found."
    )


def starts_with_numbers(head: bytes) -> bool:
    """Whether a file whose first bytes these are may be such a file. The last one may be cut."""
    try:
        words = head.decode("ascii").replace(",", " ").split()
    except UnicodeDecodeError:
        return False
    whole = words[:-1] or words
    return bool(whole) and all(_float(word) is not None for word in whole)


def read_numbers(archive: CaptureArchive, name: str, max_bytes: int) -> list[list[float]]:
    """The rows of a file, which may be none. Raises CaptureError poses_malformed, too_large."""
    data = archive.read(name, max_bytes)
    require_few_rows(data, name)
    rows = []
    for number, line in enumerate(data.splitlines(), start=1):
        if len(line) > MOST_ROW_BYTES:
            raise broken(f'Row {number} of "{shown(name)}" is too long.')
        words = line.decode("ascii", "replace").replace(",", " ").split()
        if not words or words[0].startswith("#"):
            continue
        values = [_float(word) for word in words]
        if None in values:
            raise broken(f'Row {number} of "{shown(name)}" is not of numbers.')
        rows.append([value for value in values if value is not None])
    return rows


def require_few_rows(data: bytes, name: str) -> None:
    """Raise CaptureError too_large for a file of more rows than are read. Asked before they are
    split: as objects of their own, rows of a letter take hundreds of times their bytes."""
    num_rows = data.count(b"\n") + data.count(b"\r")
    if num_rows > 2 * MOST_ROWS or num_rows - data.count(b"\r\n") > MOST_ROWS:
        raise CaptureError(
            f'"{shown(name)}" has more than {MOST_ROWS} rows.',
            code="too_large",
            hint="Send a part of the capture, with fewer frames.",
        )


def read_matrix(archive: CaptureArchive, name: str) -> list[float]:
    """All numbers of a small file, row by row. Raises as `read_numbers`."""
    return [value for row in read_numbers(archive, name, _MATRIX_BYTES) for value in row]


def read_list(archive: CaptureArchive, name: str) -> list[list[float]]:
    """A row of numbers for each picture. Raises as `read_numbers`."""
    return read_numbers(archive, name, _LIST_BYTES)


def pose_of(values: Sequence[float], what: str) -> Rows:
    """The pose [3, 4] that 12 or 16 finite numbers are, row-major. Raises poses_malformed."""
    if len(values) not in (12, 16):
        raise broken(f"{what} has {len(values)} numbers, not the 16 of a 4x4 matrix.")
    if not all(math.isfinite(value) for value in values):
        raise broken(f"{what} has a number that is not finite.")
    last = (*values[12:],) or (0.0, 0.0, 0.0, 1.0)
    if any(abs(a - b) > _SLACK for a, b in zip(last, (0, 0, 0, 1), strict=True)):
        raise broken(f"{what} has no last row 0 0 0 1.")
    return tuple(tuple(values[at : at + 4]) for at in (0, 4, 8))


def lens_of(values: Sequence[float], what: str) -> tuple[float, float, float, float]:
    """fx, fy, cx, cy of a 3x3, 3x4 or 4x4 matrix, or of these four numbers.

    Raises CaptureError poses_malformed.
    """
    width = {4: 0, 9: 3, 12: 4, 16: 4}.get(len(values))
    if width is None:
        raise broken(f"{what} has {len(values)} numbers, not the 9 of a 3x3 matrix.")
    if not all(math.isfinite(value) for value in values):
        raise broken(f"{what} has a number that is not finite.")
    if not width:
        return values[0], values[1], values[2], values[3]
    below = values[2 * width : 2 * width + 3]
    if any(abs(a - b) > _SLACK for a, b in zip(below, (0, 0, 1), strict=True)):
        raise broken(f"{what} has no last row 0 0 1.")
    return values[0], values[width + 1], values[2], values[width + 2]


def _float(word: str) -> float | None:
    try:
        return float(word)
    except ValueError:
        return None
