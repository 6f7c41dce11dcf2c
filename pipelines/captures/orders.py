"""The orders in which rows of poses that name no picture may belong to pictures. Standard library
only; which of them is right the pictures tell (`pipelines.captures.pose_order`)."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Sequence

from pipelines.captures.contents import PosedSource, Reading
from pipelines.scene.natural_order import natural_key

COUNTED = "in the order in which people count names"
AS_TEXT = "in the order of names as text"
FROM_0 = "by the number in the name, counted from 0"
FROM_1 = "by the number in the name, counted from 1"

Rows = Sequence[tuple[str, int]]
"""Pictures in the order in which people count them, and the row of each."""


def orders(names: Sequence[str], num_rows: int, *, by_number: bool) -> dict[str, Rows]:
    """Ways to pair pictures with rows, the likeliest first; none where no way fits.

    by_number: whether the number in a name may be that of its row, where there are more rows than
    pictures, or fewer; of both ways to count, those that give most pictures a row.
    """
    counted, as_text = sorted(names, key=natural_key), sorted(names)
    found: dict[str, Rows] = {}
    if len(names) == num_rows:
        found[COUNTED] = [(name, row) for row, name in enumerate(counted)]
        if as_text != counted:
            row_of = {name: row for row, name in enumerate(as_text)}
            found[AS_TEXT] = [(name, row_of[name]) for name in counted]
    elif by_number:
        numbers = {name: number for name in counted if (number := frame_number(name)) is not None}
        unique = len(set(numbers.values())) == len(numbers)
        if unique:
            found = {
                rule: [
                    (name, n - first) for name, n in numbers.items() if 0 <= n - first < num_rows
                ]
                for rule, first in ((FROM_0, 0), (FROM_1, 1))
            }
        most = max((len(rows) for rows in found.values()), default=0)
        found = {rule: rows for rule, rows in found.items() if rows and len(rows) == most}
    return found


def readings_of(
    orders: dict[str, Rows], parse: Callable[[str, int], PosedSource | None]
) -> list[Reading]:
    """Each order as pictures with poses; rows of which `parse` makes nothing are left out.

    An order is plain where it is the only one, and each row has a picture.
    """
    plain = set(orders) == {COUNTED}
    found = []
    for rule, rows in orders.items():
        sources = [source for name, row in rows if (source := parse(name, row)) is not None]
        found.append(Reading(rule, sources, plain))
    return found


def frame_number(name: str) -> int | None:
    """The last number in a file's name, without its folders; None where there is none."""
    digits = re.findall(r"[0-9]+", name.rpartition("/")[2].rpartition(".")[0])
    return int(digits[-1]) if digits and len(digits[-1]) <= 12 else None


def numbered(names: Iterable[str]) -> dict[int, str]:
    """Files by the number in their names, in the order of numbers; the first of several alike."""
    found: dict[int, str] = {}
    for name in sorted(names, key=natural_key):
        number = frame_number(name)
        if number is not None:
            found.setdefault(number, name)
    return dict(sorted(found.items()))
