"""Rows of numbers as text, many at a time: what OBJ and XYZ are made of.

Each column has as many decimals as it is told, so that a number is a whole number of steps, and its
digits come out of tables, four at a time, for all rows at once. Python's own formatting of one row
after the other takes four times as long.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ROWS = 50_000
_EXTENT_DIGITS, _FLOAT_DIGITS = 9, 15
_AT_ONCE = 4
_TABLE = np.array([list(f"{number:04d}".encode()) for number in range(10**_AT_ONCE)], np.uint8)
"""[10000, 4], the digits of each number."""
_LARGEST = 10**18
"""Of what 64 bits hold."""
_MINUS, _POINT = ord("-"), ord(".")

Numbers = NDArray[np.floating[Any]] | NDArray[np.integer[Any]]


def position_decimals(positions: NDArray[np.float64]) -> int:
    """With how many decimals [N, 3] coordinates are written: to a hundred-millionth of their
    extent, finer than a float32, as far as a float64 has digits for that; N may be 0."""
    largest = float(max(positions.max(initial=0.0), -positions.min(initial=0.0)))
    if largest == 0.0:
        return 1
    extent = float(np.ptp(positions, axis=0).max()) or largest
    wanted, known = _EXTENT_DIGITS - _digits_before(extent), _FLOAT_DIGITS - _digits_before(largest)
    return max(1, min(wanted, known))


def _digits_before(size: float) -> int:
    """Of a number's point; 0 and below for those under 1."""
    return math.floor(math.log10(size)) + 1


def rows(
    template: str,
    columns: Sequence[Numbers],
    decimals: Sequence[int],
    on_progress: Callable[[float], None] = lambda done: None,
) -> Iterator[bytes]:
    """Lines, so many rows at a time.

    template: a line with `{}` for each column, such as "v {} {} {}\\n", ASCII. columns: [N] each.
    decimals: of each; 0 for whole numbers, without a point. on_progress: told the share of the
    rows that is done; may raise. Raises ValueError where a number is too large for its decimals.
    """
    between = [part.encode("ascii") for part in template.split("{}")]
    if not len(columns) == len(decimals) == len(between) - 1:
        raise ValueError(f"{template!r} has {len(between) - 1} columns, not {len(columns)}")
    count = len(columns[0])
    for start in range(0, count, _ROWS):
        part = slice(start, start + _ROWS)
        yield _lines(between, [column[part] for column in columns], decimals)
        on_progress(min(start + _ROWS, count) / count)


def _lines(between: Sequence[bytes], columns: Sequence[Numbers], decimals: Sequence[int]) -> bytes:
    """Some rows: all characters side by side as if numbers were equally long, then those kept."""
    count = len(columns[0])
    blocks, kept = list[NDArray[np.uint8]](), list[NDArray[np.bool_]]()

    def add(characters: NDArray[np.uint8], mask: NDArray[np.bool_] | bool) -> None:
        blocks.append(characters)
        kept.append(np.broadcast_to(mask, characters.shape))

    def constant(text: bytes) -> None:
        one = np.frombuffer(text, np.uint8)
        add(np.broadcast_to(one, (count, len(one))), True)

    constant(between[0])
    for column, places, after in zip(columns, decimals, between[1:], strict=True):
        steps, is_negative = _steps(column, places)
        add(np.full((count, 1), _MINUS, np.uint8), is_negative[:, None])
        digits = _digits(steps, places + 1)
        whole = digits.shape[1] - places
        # A digit before the last of the whole ones is there where the number reaches it.
        reached = [steps >= 10 ** (digits.shape[1] - 1 - at) for at in range(whole - 1)]
        add(digits[:, :whole], np.stack([*reached, np.ones(count, np.bool_)], axis=1))
        if places:
            constant(bytes([_POINT]))
            add(digits[:, whole:], True)
        constant(after)
    return np.concatenate(blocks, axis=1)[np.concatenate(kept, axis=1)].tobytes()


def _steps(column: Numbers, places: int) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """[N] how many steps of the last decimal each number is from 0, and whether below it."""
    if places or column.dtype.kind == "f":
        scaled = np.rint(column.astype(np.float64) * 10.0**places)
        if not np.isfinite(scaled).all() or float(np.abs(scaled).max(initial=0.0)) >= _LARGEST:
            raise ValueError(f"numbers are not finite, or too large for {places} decimals")
        steps = scaled.astype(np.int64)
    else:
        steps = column.astype(np.int64)
    return np.abs(steps), steps < 0


def _digits(steps: NDArray[np.int64], least: int) -> NDArray[np.uint8]:
    """[N, D] characters of whole numbers, zeros first; D: `least`, or more where they need it."""
    width = max(least, len(str(int(steps.max(initial=0)))))
    groups, rest = list[NDArray[np.uint8]](), steps
    for _ in range(-(-width // _AT_ONCE)):
        rest, group = np.divmod(rest, 10**_AT_ONCE)
        groups.append(_TABLE[group])
    return np.concatenate(groups[::-1], axis=1)[:, -width:]
