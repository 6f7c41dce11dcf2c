"""Which file or row belongs to which picture, where nothing but names and places says so.

The orders in which rows of poses that name no picture may belong to pictures: which of them is
right the pictures tell (`pipelines.captures.pose_order`). And files that lie beside pictures, one
for each. Standard library only.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Hashable, Iterable, Sequence

from pipelines.captures.archive_rules import shown
from pipelines.captures.contents import PosedSource, Reading
from pipelines.captures.parsing import malformed
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


def paired(names: Iterable[str], others: Iterable[str]) -> dict[str, str]:
    """The file among `others` that belongs to each name, in the order in which people count names.

    Files with equal names belong together: without folders and suffixes, without what says a
    frame's part (`.color`, `.depth`, `.pose`), and without the zeros that numbers start with. Only
    where no names are equal the last numbers in them tell ("frame7.jpg", "depth0007.png"). Of names
    that differ in their suffix alone the first is taken.
    Raises CaptureError poses_malformed where several files of a side would do: nothing is guessed.
    """
    theirs = sorted(others, key=natural_key)
    first: dict[str, str] = {}
    for name in sorted(names, key=natural_key):
        first.setdefault(name.rpartition(".")[0], name)
    ours = list(first.values())
    for key in (_stem, frame_number):
        mine, its = _by_key(ours, key), _by_key(theirs, key)
        both = [name for name in mine if name in its]
        for side in (mine, its):
            several = next((side[name] for name in both if len(side[name]) > 1), None)
            if several is not None:
                same = "name" if key is _stem else "number, and no names are equal"
                raise malformed(
                    f'"{shown(several[0])}" and "{shown(several[1])}" have the same {same}: it '
                    "cannot be told which belongs to which picture.",
                    "Give a picture, its pose and its depth the same name.",
                )
        if both:
            return {mine[name][0]: its[name][0] for name in both}
    return {}


def _by_key(names: Iterable[str], key: Callable[[str], Hashable]) -> dict[Hashable, list[str]]:
    found: dict[Hashable, list[str]] = {}
    for name in names:
        if (value := key(name)) is not None:
            found.setdefault(value, []).append(name)
    return found


_PART = re.compile(r"\.(color|depth|pose)$")
_ZEROS = re.compile(r"(?<![0-9])0+(?=[0-9])")


def _stem(name: str) -> str:
    """A file's name without what `paired` does without."""
    return _ZEROS.sub("", _PART.sub("", name.rpartition("/")[2].rpartition(".")[0]))
