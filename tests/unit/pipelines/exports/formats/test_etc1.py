"""Hints for ETC1, against blocks made from them pixel by pixel as the specification tells it."""

from __future__ import annotations

import itertools

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.formats import etc1
from tests.texture_pictures import edges, photo

STEPS = [(2, 8), (5, 17), (9, 29), (13, 42), (18, 60), (24, 80), (33, 106), (47, 183)]


def _colors(pixels: NDArray[np.uint8], flip: int, diff: int, bias: int) -> list[list[int]]:
    """The two colours, of 255, that a reader finds for a block [4, 4, 3] (rows first)."""
    parts = [pixels[:2], pixels[2:]] if flip else [pixels[:, :2], pixels[:, 2:]]
    limit = 31 if diff else 15
    colors = []
    for part in parts:
        color = []
        for channel in range(3):
            mean = (int(part[..., channel].astype(int).sum()) * limit + 1020) // 2040
            delta = bias // 3**channel % 3 - 1
            moved = mean + delta + (mean == 0) - (mean == limit)
            assert 0 <= moved <= limit
            color.append(moved)
        colors.append(color)
    if not diff:
        return [[17 * value for value in color] for color in colors]
    pairs = zip(*colors, strict=True)
    colors[1] = [one + min(max(two - one, -4), 3) for one, two in pairs]
    return [[value << 3 | value >> 2 for value in color] for color in colors]


def _errors(pixels: NDArray[np.uint8], flip: int, diff: int, bias: int) -> list[list[int]]:
    """Squared, of each half with each table, and the best step for each pixel."""
    errors = [[0] * len(STEPS), [0] * len(STEPS)]
    colors = _colors(pixels, flip, diff, bias)
    for row, column, table in itertools.product(range(4), range(4), range(len(STEPS))):
        half = (row if flip else column) // 2
        small, large = STEPS[table]
        errors[half][table] += min(
            sum(
                (min(max(base + step, 0), 255) - value) ** 2
                for base, value in zip(colors[half], pixels[row, column].tolist(), strict=True)
            )
            for step in (-large, -small, small, large)
        )
    return errors


def _told(bits: int) -> tuple[int, int, list[int], int]:
    assert bits & 3 == 0, "no hints for BC1"
    return bits >> 2 & 1, bits >> 3 & 1, [bits >> 4 & 7, bits >> 7 & 7], bits >> 10


def test_hints_are_near_the_best_of_all() -> None:
    red = photo(32) // 16
    red[..., 0] = 255 - red[..., 0]
    for picture in (photo(32), edges(32), red):
        blocks = picture.reshape(8, 4, 8, 4, 3).swapaxes(1, 2).reshape(-1, 4, 4, 3)
        planar = blocks.reshape(-1, 16, 3).transpose(2, 1, 0).astype(np.float32)
        found, least = 0, 0
        for block, bits in zip(blocks, etc1.hints(planar), strict=True):
            flip, diff, tables, bias = _told(int(bits))
            own = _errors(block, flip, diff, bias)
            found += own[0][tables[0]] + own[1][tables[1]]
            least += min(
                sum(min(half) for half in _errors(block, *way, bias))
                for way in itertools.product((0, 1), (0, 1))
            )
        assert found <= 1.02 * least


def test_black_stays_black_and_white_white() -> None:
    rng = np.random.default_rng(2)
    dark = rng.integers(0, 3, (4, 4, 3)).astype(np.uint8)
    light, mixed = 255 - dark, dark.copy()
    mixed[..., 1] = 255 - dark[..., 1]
    for block in (dark, light, mixed):
        planar = block.reshape(1, 16, 3).transpose(2, 1, 0).astype(np.float32)
        flip, diff, tables, bias = _told(int(etc1.hints(planar)[0]))
        assert bias not in (2, 5, 6, 7, 8, 10, 11, 15, 18, 19, 20, 21, 24)
        assert bias < 27
        if block is not mixed:
            own = _errors(block, flip, diff, bias)
            assert own[0][tables[0]] + own[1][tables[1]] < 16 * 3 * 3**2
            assert _colors(block, flip, diff, bias) == [[0 if block is dark else 255] * 3] * 2


def test_one_colour_is_met_as_nearly_as_can_be() -> None:
    rng = np.random.default_rng(7)
    colors = rng.integers(0, 256, (40, 3)).astype(np.uint8)
    for color, hints in zip(colors, etc1.solid_hints(colors).tolist(), strict=True):
        diff, table, step, *told = hints
        assert diff == 1
        small, large = STEPS[table]
        change = (-large, -small, small, large)[step]
        shown = [min(max((value << 3 | value >> 2) + change, 0), 255) for value in told]
        error = sum((one - int(two)) ** 2 for one, two in zip(shown, color, strict=True))
        least = min(
            sum(
                min(
                    (min(max((of_32 << 3 | of_32 >> 2) + step, 0), 255) - value) ** 2
                    for of_32 in range(32)
                )
                for value in color.tolist()
            )
            for steps in STEPS
            for step in (-steps[1], -steps[0], *steps)
        )
        assert error == least
