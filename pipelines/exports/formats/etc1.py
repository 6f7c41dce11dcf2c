"""Hints of a UASTC block for whoever makes ETC1 of it: how to halve it and how much light varies.

An ETC1 block is two halves, side by side or one above the other (flip), each a colour and, for each
pixel, one of four steps along grey (its table's). Colours are in 32 steps, the second told by its
difference to the first (diff), or in 16 each. The reader takes the mean of a half's pixels and
moves it by a bias. None would leave no black and no white: the one here keeps both.

Symbols: B blocks, last in arrays, as that is how they are fast.

Source: Khronos Data Format Specification 1.4, chapters 21 (ETC1) and 25 (UASTC, ETC1 hints).
"""

from __future__ import annotations

import functools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int32]
Floats = NDArray[np.float32]

_TABLES = ((2, 8), (5, 17), (9, 29), (13, 42), (18, 60), (24, 80), (33, 106), (47, 183))
"""Small and large step of each table, either way."""
_NO_BIAS = 13
_OTHERWISE = (2, 5, 6, 7, 8, 10, 11, 15, 18, 19, 20, 21, 24)
"""Biases that mean something else than their digits to the base of 3."""
_LEAST_DIFFERENCE, _MOST_DIFFERENCE = -4, 3


@dataclass(frozen=True)
class _Half:
    """Two halves of blocks. pixels: [3, 2, 8, B], 0...255."""

    flip: bool
    pixels: Floats

    def tried(self, diff: bool) -> tuple[Floats, Ints]:
        """Squared error [B] in 32 steps or in 16, and the hints' bits [B] from flip on."""
        limit = 31 if diff else 15
        total = self.pixels.sum(axis=2).astype(np.int32)
        mean = (total * limit + 1020) // 2040
        bias, digit = _bias(mean, limit)
        base = mean + digit[:, None]
        base += np.where(mean == 0, 1, 0) - np.where(mean == limit, 1, 0)
        if diff:
            step = np.clip(base[:, 1] - base[:, 0], _LEAST_DIFFERENCE, _MOST_DIFFERENCE)
            base[:, 1] = base[:, 0] + step
            wide = (base << 3) | (base >> 2)
        else:
            wide = 17 * base
        off = self.pixels - wide[:, :, None].astype(np.float32)
        grey = off.sum(axis=0) / np.float32(3.0)
        error = (off * off).sum(axis=(0, 1, 2)) - 3.0 * (grey * grey).sum(axis=(0, 1))
        np.abs(grey, out=grey)
        errors = np.empty((len(_TABLES), *grey.shape[::2]), np.float32)
        for table, (small, large) in enumerate(_TABLES):
            left = np.minimum(np.abs(grey - small), np.abs(grey - large))
            errors[table] = (left * left).sum(axis=1)
        table_of = errors.argmin(axis=0).astype(np.int32)
        error += 3.0 * errors.min(axis=0).sum(axis=0)
        bits = int(self.flip) | (int(diff) << 1) | (table_of[0] << 2) | (table_of[1] << 5)
        return error, bits | (bias << 8)


def hints(pixels: Floats) -> Ints:
    """The 15 bits [B] of blocks [3, 16, B] as they are decoded; those for BC1, which are the two
    lowest, are 0: the reader finds the ends of a line itself."""
    rows = pixels.reshape(3, 4, 4, -1)
    halves = (
        _Half(False, rows.reshape(3, 4, 2, 2, -1).swapaxes(1, 2).reshape(3, 2, 8, -1)),
        _Half(True, rows.reshape(3, 2, 8, -1)),
    )
    best, found = halves[0].tried(True)
    for half, diff in ((halves[0], False), (halves[1], True), (halves[1], False)):
        error, bits = half.tried(diff)
        better = error < best
        np.copyto(best, error, where=better)
        np.copyto(found, bits, where=better)
    return found << 2


def solid_hints(colors: Bytes) -> Bytes:
    """Hints [N, 6] of blocks of one colour [N, 3]: diff, table, step, red, green, blue of 32."""
    nearest, error = _solid_choices()
    total = error[:, colors].sum(axis=2)
    way = total.argmin(axis=0)
    told = np.empty((len(colors), 6), np.uint8)
    told[:, 0], told[:, 1], told[:, 2] = 1, way // 4, way % 4
    told[:, 3:] = nearest[way[:, None], colors]
    return told


@functools.cache
def _solid_choices() -> tuple[Bytes, Ints]:
    """For each table and step [32] and value [256] the nearest of 32, and its squared error."""
    steps = np.array([(-large, -small, small, large) for small, large in _TABLES]).ravel()
    of_32 = np.arange(32)
    shown = np.clip(((of_32 << 3) | (of_32 >> 2)) + steps[:, None], 0, 255)
    error = (shown[:, None] - np.arange(256)[:, None]) ** 2
    return error.argmin(axis=2).astype(np.uint8), error.min(axis=2).astype(np.int32)


def _bias(mean: Ints, limit: int) -> tuple[Ints, Ints]:
    """The bias [B] that leaves black black and white white in means [3, 2, B], and what it adds to
    each channel [3, B]."""
    digit = (mean == limit).all(axis=1).astype(np.int32) - (mean == 0).all(axis=1)
    bias = (digit + 1).astype(np.int32).T @ np.array([1, 3, 9], np.int32)
    other = np.isin(bias, _OTHERWISE)
    bias[other] = _NO_BIAS
    digit[:, other] = 0
    return bias, digit
