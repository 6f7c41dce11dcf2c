"""File names in the order in which people count. Standard library only."""

from __future__ import annotations

import re


def natural_key(name: str) -> tuple[tuple[tuple[int, int, str], ...], str]:
    """Sorts names as people count: "2.jpg" before "10.jpg", capitals like small letters.

    Names that differ in capitals or leading zeros alone come in the order of their characters.
    """
    parts = re.split(r"([0-9]+)", name.casefold())
    counted = tuple(
        (0, int(part), "") if index % 2 else (1, 0, part)
        for index, part in enumerate(parts)
        if part
    )
    return counted, name
