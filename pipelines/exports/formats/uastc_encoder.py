"""Pictures as UASTC blocks: for each block the mode and the lines that miss its pixels least.

All blocks get one line (mode 0); those that it misses by more are tried with two lines, in the way
of halving them that looks best (modes 2 and 4), and with a channel that goes its own way (mode 6).
A line begins as the principal axis of its pixels, its ends are rounded to what the mode has, and
then they are fitted to the weights by least squares, which is kept where it is better.

Symbols: B blocks, last in arrays, as that is how they are fast; C channels of a line.
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pipelines.exports.formats import etc1, uastc
from pipelines.exports.formats.uastc import MODES, PATTERNS, Blocks, Mode

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]
Floats = NDArray[np.float32]

_PORTION = 4096
"""Blocks that are worked on at once: they fit in a processor's cache."""
_GOOD = 48 * 0.5
"""Squared error of a block, summed over channels, that one line is good enough for."""
_ROUNDS, _AXIS_ROUNDS = 3, 6
_TINY = np.float32(1e-6)


def encode(picture: Bytes, on_progress: Callable[[float], None] = lambda done: None) -> Bytes:
    """RGB [H, W, 3] as blocks [ceil(H/4) ceil(W/4), 16], row by row. Where the sides are no
    multiples of 4 the last pixels are repeated.

    on_progress: told the share that is done after each portion; may raise.
    """
    height, width = picture.shape[:2]
    filled = np.pad(picture, ((0, -height % 4), (0, -width % 4), (0, 0)), "edge")
    rows, columns = filled.shape[0] // 4, filled.shape[1] // 4
    pixels = filled.reshape(rows, 4, columns, 4, 3).swapaxes(1, 2).reshape(-1, 16, 3)
    parts = []
    for first in range(0, len(pixels), _PORTION):
        parts.append(encode_blocks(pixels[first : first + _PORTION]))
        on_progress(min(first + _PORTION, len(pixels)) / len(pixels))
    return np.concatenate(parts)


def encode_blocks(pixels: Bytes) -> Bytes:
    """Blocks [B, 16] of pixels [B, 16, 3]."""
    found = np.empty((len(pixels), uastc.BLOCK_BYTES), np.uint8)
    solid = (pixels == pixels[:, :1]).all(axis=(1, 2))
    colors = pixels[solid, 0]
    found[solid] = uastc.pack_solid(colors, etc1.solid_hints(colors))
    rest = np.flatnonzero(~solid)
    if len(rest):
        planar = np.ascontiguousarray(pixels[rest].transpose(2, 1, 0)).astype(np.float32)
        for chosen, blocks in _best(planar):
            decoded = np.ascontiguousarray(blocks.colors().transpose(2, 1, 0)).astype(np.float32)
            found[rest[chosen]] = uastc.pack(blocks, etc1.hints(decoded))
    return found


@dataclass(frozen=True)
class _Line:
    """Lines fitted to pixels. ends: [2, C, B] of `Mode.ends`. weights: [16, B] of `Mode.weights`.
    error: [B], squared, of all pixels and channels."""

    ends: Bytes
    weights: Bytes
    error: Floats


@dataclass(frozen=True)
class _Tried:
    """Blocks of a mode as they were fitted, and how much they miss [B]."""

    blocks: Blocks
    error: Floats


def _best(pixels: Floats) -> list[tuple[Ints, Blocks]]:
    """Blocks by mode, and which of `pixels` [3, 16, B] they are."""
    plain = _one_line(pixels)
    hard = np.flatnonzero(plain.error > _GOOD)
    tried = [plain]
    best, least = np.zeros(pixels.shape[2], np.int64), plain.error.copy()
    if len(hard):
        some = np.ascontiguousarray(pixels[:, :, hard])
        pattern = _pattern(some)
        others: list[Callable[[], _Tried]] = [
            lambda: _two_lines(some, pattern, MODES[2]),
            lambda: _two_lines(some, pattern, MODES[4]),
            lambda: _two_planes(some),
        ]
        for number, way in enumerate(others, start=1):
            found = way()
            better = found.error < least[hard]
            best[hard[better]], least[hard[better]] = number, found.error[better]
            tried.append(found)
    place = np.zeros(pixels.shape[2], np.int64)
    place[hard] = np.arange(len(hard))
    answer = []
    for number, found in enumerate(tried):
        chosen = np.flatnonzero(best == number)
        if len(chosen):
            answer.append((chosen, _some(found.blocks, place[chosen] if number else chosen)))
    return answer


def _some(blocks: Blocks, which: Ints) -> Blocks:
    return Blocks(
        blocks.mode,
        blocks.ends[which],
        blocks.weights[which],
        blocks.pattern[which],
        blocks.channel[which],
    )


def _one_line(pixels: Floats) -> _Tried:
    mode = MODES[0]
    line = _turned(_fitted(pixels, mode), mode, np.zeros(pixels.shape[2], np.int64))
    none = np.zeros(pixels.shape[2], np.uint8)
    return _Tried(Blocks(mode, _in_order([line]), line.weights.T, none, none), line.error)


def _two_lines(pixels: Floats, pattern: Ints, mode: Mode) -> _Tried:
    """pattern: [B], rows of PATTERNS."""
    second = PATTERNS.T[:, pattern]
    lines = []
    for subset in (0, 1):
        inside = second == subset
        line = _fitted(pixels, mode, inside.astype(np.float32))
        lines.append(_turned(line, mode, inside.argmax(axis=0)))
    weights = np.where(second == 1, lines[1].weights, lines[0].weights)
    none = np.zeros(len(pattern), np.uint8)
    blocks = Blocks(mode, _in_order(lines), weights.T, pattern.astype(np.uint8), none)
    return _Tried(blocks, lines[0].error + lines[1].error)


def _two_planes(pixels: Floats) -> _Tried:
    """With the channel by itself that leaves the others nearest to a line."""
    mode, many = MODES[6], pixels.shape[2]
    off = pixels - pixels.mean(axis=1, keepdims=True)
    left = []
    for channel in range(3):
        one, other = np.delete(off, channel, axis=0)
        a, b, c = (one * one).sum(axis=0), (other * other).sum(axis=0), (one * other).sum(axis=0)
        left.append((a + b) / 2 - np.hypot((a - b) / 2, c))
    alone = np.argmin(left, axis=0)
    order = np.array([[1, 2, 0], [0, 2, 1], [0, 1, 2]])[alone].T
    sorted_ = np.take_along_axis(pixels, order[:, None], axis=0)
    first = np.zeros(many, np.int64)
    pair = _turned(_fitted(sorted_[:2], mode), mode, first)
    single = _turned(_fitted(sorted_[2:], mode), mode, first)
    ends = np.empty((2, 3, many), np.uint8)
    by_order = np.concatenate([pair.ends, single.ends], axis=1)
    np.put_along_axis(ends, np.broadcast_to(order, ends.shape), by_order, axis=1)
    weights = np.stack([pair.weights, single.weights], axis=1).reshape(32, many)
    none = np.zeros(many, np.uint8)
    in_order = ends.transpose(2, 1, 0).reshape(many, 6)
    blocks = Blocks(mode, in_order, weights.T, none, alone.astype(np.uint8))
    return _Tried(blocks, pair.error + single.error)


def _in_order(lines: list[_Line]) -> Bytes:
    """Ends [B, 6 S] as blocks have them."""
    return np.concatenate([line.ends.transpose(2, 1, 0).reshape(-1, 6) for line in lines], axis=1)


def _turned(line: _Line, mode: Mode, first: Ints) -> _Line:
    """The same with its ends changed over where pixel `first` [B] is nearer to the second one: its
    weight has no highest bit."""
    most = len(mode.weights) - 1
    over = np.take_along_axis(line.weights, first[None], axis=0)[0] > most // 2
    weights = np.where(over, most - line.weights, line.weights)
    return _Line(np.where(over, line.ends[::-1], line.ends), weights, line.error)


@functools.cache
def _nearest(mode: Mode) -> tuple[Bytes, Floats, Bytes, Floats]:
    """The end nearest to each of 256 values, what ends are, the weight nearest to each of 64ths,
    what weights are, of 1."""
    to_end = np.abs(np.arange(256)[:, None] - mode.ends).argmin(axis=1).astype(np.uint8)
    to_weight = np.abs(np.arange(65)[:, None] - mode.weights).argmin(axis=1).astype(np.uint8)
    weights = (mode.weights / 64.0).astype(np.float32)
    return to_end, mode.ends.astype(np.float32), to_weight, weights


def _fitted(pixels: Floats, mode: Mode, inside: Floats | None = None) -> _Line:
    """The line of each block through pixels [C, 16, B]; inside: [16, B], 1 for those that count."""
    to_end, end_values, to_weight, weight_values = _nearest(mode)
    counted = np.float32(16.0) if inside is None else inside.sum(axis=0)
    masked = pixels if inside is None else pixels * inside
    begin, end = _principal(pixels, masked, counted, inside)
    many = pixels.shape[2]
    best = _Line(
        np.zeros((2, len(pixels), many), np.uint8),
        np.zeros((16, many), np.uint8),
        np.full(many, np.inf, np.float32),
    )
    for turn in range(_ROUNDS):
        ends = to_end[np.rint(np.clip(np.stack([begin, end]), 0.0, 255.0)).astype(np.intp)]
        low, high = end_values[ends]
        along = high - low
        from_low = pixels - low[:, None]
        scale = np.float32(64.0) / np.maximum((along * along).sum(axis=0), _TINY)
        place = (from_low * (along * scale)[:, None]).sum(axis=0)
        weights = to_weight[np.rint(np.clip(place, 0.0, 64.0)).astype(np.intp)]
        share = weight_values[weights]
        from_low -= share * along[:, None]
        squared = (from_low * from_low).sum(axis=0)
        error = (squared if inside is None else squared * inside).sum(axis=0)
        better = error < best.error
        np.copyto(best.ends, ends, where=better)
        np.copyto(best.weights, weights, where=better)
        np.copyto(best.error, error, where=better)
        if turn + 1 < _ROUNDS:
            begin, end = _refitted(masked, share, inside, counted, (begin, end))
    return best


def _principal(
    pixels: Floats, masked: Floats, counted: Floats | np.float32, inside: Floats | None
) -> tuple[Floats, Floats]:
    """The ends [C, B] of pixels along their principal axis."""
    mean = masked.sum(axis=1) / counted
    off = pixels - mean[:, None]
    if inside is not None:
        off *= inside
    axis = _axis(np.einsum("akn,bkn->abn", off, off))[0]
    along = (off * axis[:, None]).sum(axis=0)
    return mean + axis * along.min(axis=0), mean + axis * along.max(axis=0)


def _axis(scatter: Floats) -> tuple[Floats, Floats]:
    """Unit eigenvectors [C, ...] of the largest eigenvalues [...] of symmetric [C, C, ...], by
    powers, begun from the longest column."""
    largest = np.einsum("aa...->a...", scatter).argmax(axis=0)
    axis = np.take_along_axis(scatter, largest[None, None], axis=1)[:, 0]
    value = np.zeros(largest.shape, np.float32)
    for _ in range(_AXIS_ROUNDS if len(scatter) > 1 else 1):
        axis = axis / np.maximum(np.sqrt((axis * axis).sum(axis=0)), _TINY)
        grown = (scatter * axis).sum(axis=1)
        value = (grown * axis).sum(axis=0)
        axis = grown
    return axis / np.maximum(np.sqrt((axis * axis).sum(axis=0)), _TINY), value


def _refitted(
    masked: Floats,
    share: Floats,
    inside: Floats | None,
    counted: Floats | np.float32,
    before: tuple[Floats, Floats],
) -> tuple[Floats, Floats]:
    """The ends [C, B] that miss the pixels least with these shares [16, B]; as before, where all
    pixels have the same."""
    far = share if inside is None else share * inside
    sum_far, squares = far.sum(axis=0), (far * share).sum(axis=0)
    # Normal equations [[near, both], [both, squares]] of (1 - share) begin + share end.
    both = sum_far - squares
    near = counted - sum_far - both
    at_end = (masked * share).sum(axis=1)
    at_begin = masked.sum(axis=1) - at_end
    whole = near * squares - both * both
    known = whole > 1e-3
    scale = 1.0 / np.where(known, whole, 1.0).astype(np.float32)
    begin = (squares * at_begin - both * at_end) * scale
    end = (near * at_end - both * at_begin) * scale
    return np.where(known, begin, before[0]), np.where(known, end, before[1])


def _pattern(pixels: Floats) -> Ints:
    """The row of PATTERNS [B] whose two subsets are nearest to a line each."""
    off = pixels - pixels.mean(axis=1, keepdims=True)
    pairs = [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]
    # [16, 9, B]: values and products, whose sums over pixels make a scatter.
    moments = np.stack([*off, *(off[a] * off[b] for a, b in pairs)], axis=1)
    many, whole = pixels.shape[2], moments.sum(axis=0)
    inside = (PATTERNS.astype(np.float32) @ moments.reshape(16, -1)).reshape(-1, 9, many)
    left = np.zeros((len(PATTERNS), many), np.float32)
    size = PATTERNS.sum(axis=1).astype(np.float32)[:, None]
    for sums, count in ((inside, size), (whole - inside, 16.0 - size)):
        mean = sums[:, :3] / count[:, None]
        scatter = np.empty((3, 3, len(PATTERNS), many), np.float32)
        for at, (a, b) in enumerate(pairs, start=3):
            scatter[a, b] = scatter[b, a] = sums[:, at] - sums[:, a] * mean[:, b]
        left += np.einsum("aa...->...", scatter) - _axis(scatter)[1]
    best: Ints = left.argmin(axis=0)
    return best
