"""UASTC LDR 4x4: blocks of 4x4 pixels in 16 bytes, which a viewer turns into BC7, ASTC, ETC or BC1.

A block says its mode, hints for whoever turns it into ETC1 or BC1, the ends of one or two lines in
RGB, and for each pixel how far along its line it lies. Opaque modes that `uastc_encoder` writes are
read, no others.

Symbols: N blocks; S subsets, lines of a block; P planes, of which the second has the weights of one
channel alone. Pixels of a block come row by row.

Source: Khronos Data Format Specification 1.4, chapter 25 (UASTC), and for the values of ends and
weights chapter 23 (ASTC). As in a transcoder to RGBA, colours are interpolated as linear ones are:
what a GPU makes of the same as sRGB differs by a step of 255 at most.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

BLOCK_BYTES, SIDE = 16, 4
_BITS = 8 * BLOCK_BYTES
_HINT_BITS, _PATTERN_BITS, _CHANNEL_BITS = 15, 5, 2
_PORTION = 1 << 15
"""Blocks that are decoded at once."""
_PATTERNS = (
    *(0xCCCC, 0x8888, 0x1111, 0xECC8, 0x377F, 0xFEEC, 0x0137, 0x137F, 0xC800, 0x0013),
    *(0xFE80, 0x17FF, 0x0017, 0x00FF, 0xFFF0, 0x0FFF, 0xFF71, 0x8EFF, 0x08CE, 0x008C),
    *(0x7310, 0xCEFF, 0x7331, 0x088C, 0xCEEF, 0x6666, 0xF00F, 0x5555, 0x0F0F, 0x36C9),
)
PATTERNS = ((np.array(_PATTERNS)[:, None] >> np.arange(16)) & 1).astype(np.uint8)
"""Subset of each pixel [30, 16], in what ASTC and BC7 have in common of two."""
_WEIGHTS = {
    bits: np.array([value + (value > 32) for value in steps])
    for bits, steps in {
        2: (0, 21, 42, 63),
        3: (0, 9, 18, 27, 36, 45, 54, 63),
        4: (0, 4, 8, 12, 17, 21, 25, 29, 34, 38, 42, 46, 51, 55, 59, 63),
    }.items()
}
"""Weights of 64 by their number of bits."""
_SPREAD = {192: (5, "543210005"), 160: (6, "432100004"), 40: (26, "210000212")}
"""Of ends that are not whole bits, by their levels: the factor of the upper digit, and which of the
lower bits makes each bit of what is added, from the highest; the lowest of them, 0, counts none."""


@dataclass(frozen=True)
class Mode:
    """How blocks of a mode are laid out. code: what they begin with, the lowest bit first. base: of
    the upper digit of an end, 3, 5, or 1 for none, above so many low_bits."""

    number: int
    code: int
    code_bits: int
    weight_bits: int
    low_bits: int
    base: int
    subsets: int = 1
    planes: int = 1

    @property
    def num_ends(self) -> int:
        """Numbers that tell the ends of all lines."""
        return 6 * self.subsets

    @cached_property
    def ends(self) -> Ints:
        """The value in 0...255 of each number that an end may have."""
        low, upper = np.arange(1 << self.low_bits), np.arange(self.base)[:, None]
        if self.base == 1:
            times = -(-8 // self.low_bits)
            repeated = sum(low << (self.low_bits * place) for place in range(times))
            return np.asarray(repeated >> (self.low_bits * times - 8))
        factor, source = _SPREAD[self.base << self.low_bits]
        added = sum(
            ((low >> int(bit)) & 1) << (8 - at) for at, bit in enumerate(source) if bit > "0"
        )
        flip = (low & 1) * 0x1FF
        value = (upper * factor + added) ^ flip
        return np.asarray((flip & 0x80) | (value >> 2)).ravel()

    @property
    def weights(self) -> Ints:
        """The weight, of 64, of each number that a pixel may have."""
        return _WEIGHTS[self.weight_bits]

    def groups(self) -> list[tuple[slice, int]]:
        """Which ends tell their upper digits together, and in how many bits."""
        size, bits = {3: (5, (2, 4, 5, 7, 8)), 5: (3, (3, 5, 7))}.get(self.base, (1, (0,)))
        many = self.num_ends if self.base > 1 else 0
        return [
            (slice(first, first + size), bits[min(size, many - first) - 1])
            for first in range(0, many, size)
        ]


MODES = {
    0: Mode(0, 0x1, 4, weight_bits=4, low_bits=6, base=3),
    2: Mode(2, 0x1D, 5, weight_bits=3, low_bits=4, base=1, subsets=2),
    4: Mode(4, 0x13, 5, weight_bits=2, low_bits=3, base=5, subsets=2),
    6: Mode(6, 0x1B, 5, weight_bits=2, low_bits=5, base=5, planes=2),
}
SOLID_CODE, _SOLID_CODE_BITS = 0x17, 5


@dataclass(frozen=True)
class Blocks:
    """N blocks of a mode. ends: [N, 6 S], of a subset red of both ends, then green, then blue, each
    a place in `Mode.ends`. weights: [N, 16 P], of a pixel those of all planes, each a place in
    `Mode.weights`. pattern: [N], a row of PATTERNS, where there are two subsets. channel: [N], that
    of the second plane, where there is one."""

    mode: Mode
    ends: Bytes
    weights: Bytes
    pattern: Bytes
    channel: Bytes

    def colors(self) -> Bytes:
        """What the pixels [N, 16, 3] are."""
        mode, many = self.mode, len(self.ends)
        # 16 bits for 8, whose middle is what the pixel is.
        lines: Ints = (mode.ends * 257)[self.ends].reshape(many, mode.subsets, 3, 2)
        if mode.subsets == 2:
            subset = PATTERNS[self.pattern][:, :, None, None]
            at_pixels: Ints = np.where(subset == 1, lines[:, None, 1], lines[:, None, 0])
        else:
            at_pixels = lines[:, :1]
        weights = mode.weights[self.weights].reshape(many, 16, mode.planes)
        by_channel: Ints = np.broadcast_to(weights[:, :, :1], (many, 16, 3))
        if mode.planes == 2:
            second = np.arange(3) == self.channel[:, None, None]
            by_channel = np.where(second, weights[:, :, 1:], by_channel)
        begin, end = at_pixels[..., 0], at_pixels[..., 1]
        mixed: Ints = begin * (64 - by_channel) + end * by_channel + 32
        return (mixed >> 14).astype(np.uint8)


_FIRST = np.stack([np.isin(np.arange(16), [np.argmin(row), np.argmax(row)]) for row in PATTERNS])
"""Which pixels are the first of their subset, [30, 16]."""


def pack(blocks: Blocks, hints: NDArray[np.integer]) -> Bytes:
    """Blocks as bytes [N, 16]. hints: [N], 15 bits: two for BC1, those of `etc1.hints` above."""
    mode, many = blocks.mode, len(blocks.ends)
    fields = [
        _bits(np.full(many, mode.code), mode.code_bits),
        _bits(hints, _HINT_BITS),
    ]
    if mode.subsets == 2:
        fields.append(_bits(blocks.pattern, _PATTERN_BITS))
    if mode.planes == 2:
        fields.append(_bits(blocks.channel, _CHANNEL_BITS))
    upper = (blocks.ends >> mode.low_bits).astype(np.int64)
    for which, bits in mode.groups():
        digits = upper[:, which]
        fields.append(_bits(digits @ mode.base ** np.arange(digits.shape[1]), bits))
    low = blocks.ends & ((1 << mode.low_bits) - 1)
    fields.append(_bits(low, mode.low_bits))
    told = _told(mode, blocks.pattern)
    fields.append(_bits(blocks.weights, mode.weight_bits)[told].reshape(many, -1))
    return _as_bytes(fields)


def pack_solid(colors: Bytes, hints: Bytes) -> Bytes:
    """Blocks [N, 16] of one colour [N, 3] each. hints: [N, 6], those of `etc1.solid_hints`."""
    many = len(colors)
    rgba = np.concatenate([colors, np.full((many, 1), 255, np.uint8)], axis=1)
    code = _bits(np.full(many, SOLID_CODE), _SOLID_CODE_BITS)
    sizes = (1, 3, 2, 5, 5, 5)
    parts = (_bits(hints[:, at], size) for at, size in enumerate(sizes))
    return _as_bytes([code, _bits(rgba, 8), *parts])


def decode(data: Bytes) -> Bytes:
    """The pixels [N, 16, 3] of blocks [N, 16]. Raises ValueError for modes that are not ours."""
    pixels = np.empty((len(data), 16, 3), np.uint8)
    for first in range(0, len(data), _PORTION):
        portion = slice(first, first + _PORTION)
        pixels[portion] = _decoded(data[portion])
    return pixels


def _decoded(data: Bytes) -> Bytes:
    pixels = np.empty((len(data), 16, 3), np.uint8)
    known = (data[:, 0] & ((1 << _SOLID_CODE_BITS) - 1)) == SOLID_CODE
    pixels[known] = _solid_colors(data[known])[:, None]
    for mode in MODES.values():
        chosen = (data[:, 0] & ((1 << mode.code_bits) - 1)) == mode.code
        if chosen.any():
            pixels[chosen] = _unpacked(mode, data[chosen]).colors()
        known |= chosen
    if not known.all():
        raise ValueError("a block of the texture has a mode that is not read here")
    return pixels


def _solid_colors(data: Bytes) -> Bytes:
    bits = np.unpackbits(data, axis=1, bitorder="little")[:, _SOLID_CODE_BITS:]
    return np.packbits(bits[:, :24], axis=1, bitorder="little")


def _unpacked(mode: Mode, data: Bytes) -> Blocks:
    """The blocks [N, 16] of a mode. Raises ValueError for a pattern that there is not."""
    bits = np.unpackbits(data, axis=1, bitorder="little")
    many, at = len(data), mode.code_bits + _HINT_BITS
    pattern = channel = np.zeros(many, np.uint8)
    if mode.subsets == 2:
        pattern = _number(bits[:, at : at + _PATTERN_BITS]).astype(np.uint8)
        at += _PATTERN_BITS
        if (pattern >= len(PATTERNS)).any():
            raise ValueError("a block of the texture has a pattern that there is not")
    if mode.planes == 2:
        channel = _number(bits[:, at : at + _CHANNEL_BITS]).astype(np.uint8)
        at += _CHANNEL_BITS
    upper = np.zeros((many, mode.num_ends), np.int64)
    for which, size in mode.groups():
        group = _number(bits[:, at : at + size])[:, None]
        powers = mode.base ** np.arange(upper[:, which].shape[1])
        upper[:, which] = group // powers % mode.base
        at += size
    size = mode.num_ends * mode.low_bits
    low = _number(bits[:, at : at + size].reshape(many, -1, mode.low_bits))
    at += size
    ends = (low + (upper << mode.low_bits)).astype(np.uint8)
    told = _told(mode, pattern)
    every = np.zeros(told.shape, np.uint8)
    every[told] = bits[:, at : at + int(told[0].sum())].ravel()
    weights = _number(every.reshape(many, -1, mode.weight_bits)).astype(np.uint8)
    return Blocks(mode, ends, weights, pattern, channel)


def _told(mode: Mode, pattern: Bytes) -> NDArray[np.bool_]:
    """Which bits [N, 16 P B] of the weights, B each, are in the file: all but the highest of the
    first pixel of each subset, which is 0."""
    first = np.zeros((len(pattern), 16 * mode.planes), np.bool_)
    first[:, : mode.planes] = True
    if mode.subsets == 2:
        first |= _FIRST[pattern]
    highest = np.arange(mode.weight_bits) == mode.weight_bits - 1
    told: NDArray[np.bool_] = ~(first[:, :, None] & highest).reshape(len(pattern), -1)
    return told


def _bits(values: NDArray[np.integer], size: int) -> Bytes:
    """Numbers [N] or [N, K] as bits [N, size] or [N, K size], the lowest first."""
    wide = values.astype(np.uint16)[..., None]
    bits = (wide >> np.arange(size, dtype=np.uint16)) & np.uint16(1)
    return bits.astype(np.uint8).reshape(len(values), size * int(np.prod(values.shape[1:])))


def _number(bits: Bytes) -> Ints:
    """Numbers [...] from bits [..., size], the lowest first."""
    number: Ints = bits @ (1 << np.arange(bits.shape[-1], dtype=np.int64))
    return number


def _as_bytes(fields: Iterable[Bytes]) -> Bytes:
    """Fields of bits, each [N, some], one after the other as [N, 16]."""
    bits = np.concatenate(list(fields), axis=1)
    rest = np.zeros((len(bits), _BITS - bits.shape[1]), np.uint8)
    return np.packbits(np.concatenate([bits, rest], axis=1), axis=1, bitorder="little")
