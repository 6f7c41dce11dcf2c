"""Numbers as text: what Python's own formatting says, faster."""

from __future__ import annotations

import time

import numpy as np
import pytest

from pipelines.exports.formats import numbers
from pipelines.exports.formats.numbers import position_decimals, rows

RNG = np.random.default_rng(0)


@pytest.mark.parametrize("decimals", [1, 5, 9])
@pytest.mark.parametrize("extent", [1e-4, 1.0, 12_345.0])
def test_each_row_is_what_python_says(decimals: int, extent: float) -> None:
    values = RNG.uniform(-extent, extent, (3000, 2))
    values[:4] = [[0.0, -0.0], [1.0, -1.0], [extent, 0.1], [-(0.1**decimals), 9.99]]
    whole = RNG.integers(0, 70_000, 3000)
    found = b"".join(rows("v {} {}/{};\n", [*values.T, whole], [decimals, decimals, 0])).decode()
    places = 10.0**decimals
    for line, (x, y), number in zip(found.splitlines(), values, whole, strict=True):
        # A number whose steps are 0 has no sign; halves of a step go to the even one in both.
        x, y = (np.rint(value * places) / places + 0.0 for value in (x, y))
        assert line == f"v {x:.{decimals}f} {y:.{decimals}f}/{number};"


def test_more_rows_than_are_made_at_once_are_all_there_and_told(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(numbers, "_ROWS", 7)
    told: list[float] = []
    parts = list(rows("{}\n", [np.arange(20)], [0], told.append))
    assert b"".join(parts).decode().split() == [str(number) for number in range(20)]
    assert told == [7 / 20, 14 / 20, 1.0]
    assert list(rows("{}\n", [np.arange(0)], [0], told.append)) == []


@pytest.mark.parametrize("at", [0.0, 500_000.0])
@pytest.mark.parametrize("extent", [1e-9, 1e-3, 2.0, 3e4])
def test_positions_have_decimals_for_what_they_hold(extent: float, at: float) -> None:
    places = RNG.uniform(-extent, extent, (500, 3)) + at
    decimals = position_decimals(places)
    lines = b"".join(rows("{} {} {}\n", list(places.T), [decimals] * 3)).decode()
    read = np.array([[float(word) for word in line.split()] for line in lines.splitlines()])
    assert np.abs(read - places).max() <= max(1e-8 * extent, 5e-15 * (at + extent))


def test_what_cannot_be_written_is_refused() -> None:
    for wrong in (np.inf, np.nan, 1e30):
        with pytest.raises(ValueError, match="not finite, or too large for 3 decimals"):
            list(rows("{}\n", [np.array([0.0, wrong])], [3]))
    with pytest.raises(ValueError, match="has 2 columns, not 1"):
        list(rows("{} {}\n", [np.array([0.0])], [3]))


def test_it_is_faster_than_a_row_at_a_time() -> None:
    values, line = RNG.uniform(-3.0, 3.0, (50_000, 3)), "v %.8f %.8f %.8f\n"
    mine, theirs = list[float](), list[float]()
    for _ in range(3):
        started = time.process_time()
        text = b"".join(rows("v {} {} {}\n", list(values.T), [8] * 3))
        mine.append(time.process_time() - started)
        again = "".join([line % tuple(row) for row in values.tolist()])
        theirs.append(time.process_time() - started - mine[-1])
        assert text.decode() == again
    assert min(mine) < 0.7 * min(theirs), "it was .3 to .4"
