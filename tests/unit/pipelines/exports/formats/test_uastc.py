"""Blocks of textures: against a slow, plain reader, and against the pictures they are made of."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.formats import uastc, uastc_encoder
from pipelines.exports.formats.uastc import MODES, PATTERNS, Blocks, Mode
from tests.texture_pictures import edges, gradients, photo, psnr

Bytes = NDArray[np.uint8]

# Of the specification: the mode's code and its length, bits of a weight, levels of an end.
WANTED = {0: (0b0001, 4, 4, 192), 2: (0b11101, 5, 3, 16), 4: (0b10011, 5, 2, 40)}
WANTED |= {6: (0b11011, 5, 2, 160)}


class _Reader:
    """Takes numbers out of a block, the lowest bits first."""

    def __init__(self, block: Bytes) -> None:
        self.left = int.from_bytes(block.tobytes(), "little")

    def __call__(self, bits: int) -> int:
        number = self.left & ((1 << bits) - 1)
        self.left >>= bits
        return number


def _end_value(number: int, levels: int) -> int:
    """As the specification tells it, table by table."""
    if levels == 16:
        return number * 17
    if levels == 192:
        low, digit = number & 63, number >> 6
        f_to_b, f = low >> 1, low >> 5
        added, factor = (f_to_b << 4) | f, 5
    elif levels == 160:
        low, digit = number & 31, number >> 5
        added, factor = ((low >> 1) << 5) | (low >> 4), 6
    else:
        low, digit = number & 7, number >> 3
        c_b, c = low >> 1, low >> 2
        added, factor = (c_b << 7) | (c_b << 1) | c, 26
    inverted = 0x1FF if low & 1 else 0
    value = (digit * factor + added) ^ inverted
    return (inverted & 0x80) | (value >> 2)


def _plainly_decoded(block: Bytes) -> list[list[int]]:
    """Pixels, number after number, as the specification tells it."""
    code = int(block[0])
    (number,) = [mode for mode, (bits, size, *_) in WANTED.items() if code % (1 << size) == bits]
    _, size, weight_bits, levels = WANTED[number]
    read = _Reader(block)
    read(size + 15)
    pattern = PATTERNS[read(5)].tolist() if number in (2, 4) else [0] * 16
    alone = read(2) if number == 6 else -1
    ends, many = list[int](), 12 if number in (2, 4) else 6
    base, group, lengths = {192: (3, 5, (2, 4, 5, 7, 8)), 16: (1, 12, (0,) * 12)}.get(
        levels, (5, 3, (3, 5, 7))
    )
    digits = list[int]()
    while len(digits) < many:
        some = min(group, many - len(digits))
        together = read(lengths[some - 1])
        for _ in range(some):
            digits.append(together % base)
            together //= base
    low_bits = {192: 6, 16: 4, 160: 5, 40: 3}[levels]
    for digit in digits:
        ends.append(_end_value(read(low_bits) | (digit << low_bits), levels))
    seen, weights = set[int](), list[list[int]]()
    for subset in pattern:
        bits = weight_bits - (subset not in seen)
        seen.add(subset)
        weights.append([read(bits) for _ in range(2 if number == 6 else 1)])
    pixels = []
    for subset, own in zip(pattern, weights, strict=True):
        pixel = []
        for channel in range(3):
            low, high = ends[6 * subset + 2 * channel : 6 * subset + 2 * channel + 2]
            weight = own[1] if channel == alone else own[0]
            steps = {4: weight * 4 + weight // 4, 3: weight * 9, 2: weight * 21}[weight_bits]
            steps += steps > 32
            pixel.append((low * 257 * (64 - steps) + high * 257 * steps + 32) // 64 // 256)
        pixels.append(pixel)
    return pixels


def _some(mode: Mode, many: int) -> Blocks:
    """Any blocks that the mode can hold."""
    rng = np.random.default_rng(mode.number)
    ends = rng.integers(0, len(mode.ends), (many, mode.num_ends)).astype(np.uint8)
    weights = rng.integers(0, len(mode.weights), (many, 16 * mode.planes)).astype(np.uint8)
    pattern = (np.arange(many) % 30).astype(np.uint8)
    weights[:, : mode.planes] %= len(mode.weights) // 2
    if mode.subsets == 2:
        other = (PATTERNS[pattern] != PATTERNS[pattern][:, :1]).argmax(axis=1)
        weights[np.arange(many), other] %= len(mode.weights) // 2
    return Blocks(mode, ends, weights, pattern, (np.arange(many) % 3).astype(np.uint8))


def _blocks_of(picture: Bytes) -> Bytes:
    side = len(picture) // 4
    return picture.reshape(side, 4, side, 4, 3).swapaxes(1, 2).reshape(-1, 16, 3)


@pytest.mark.parametrize("number", MODES)
def test_blocks_of_each_mode_are_as_the_specification_has_them(number: int) -> None:
    mode = MODES[number]
    blocks = _some(mode, 120)
    hints = np.arange(120) * 271 % (1 << 15)
    data = uastc.pack(blocks, hints)
    pixels = uastc.decode(data)
    np.testing.assert_array_equal(pixels, [_plainly_decoded(block) for block in data])
    np.testing.assert_array_equal(pixels, blocks.colors())
    whole = [int.from_bytes(block.tobytes(), "little") for block in data]
    assert [(block >> mode.code_bits) % (1 << 15) for block in whole] == hints.tolist()


def test_ends_have_the_values_of_the_specification() -> None:
    for number, (_, _, _, levels) in WANTED.items():
        found = MODES[number].ends.tolist()
        assert found == [_end_value(end, levels) for end in range(levels)]
        assert sorted(set(found))[:: levels - 1] == [0, 255], "none twice, from black to white"
        assert len(set(found)) == levels


def test_what_is_no_block_of_ours_is_refused() -> None:
    block = uastc.pack(_some(MODES[2], 1), np.zeros(1, np.int64))
    other = block.copy()
    other[:, 0] = 0x2  # mode 10, which has alpha
    with pytest.raises(ValueError, match="a mode that is not read here"):
        uastc.decode(other)
    whole = int.from_bytes(block.tobytes(), "little") | (31 << 20)
    other = np.frombuffer(whole.to_bytes(16, "little"), np.uint8)[None]
    with pytest.raises(ValueError, match="a pattern that there is not"):
        uastc.decode(other)


def test_one_colour_comes_back_exactly() -> None:
    rng = np.random.default_rng(4)
    colors = rng.integers(0, 256, (500, 3)).astype(np.uint8)
    colors[:2] = [[0, 0, 0], [255, 255, 255]]
    pixels = np.repeat(colors[:, None], 16, axis=1)
    np.testing.assert_array_equal(uastc.decode(uastc_encoder.encode_blocks(pixels)), pixels)


@pytest.mark.parametrize(
    ("picture", "least_db"),
    [(photo(256), 40.5), (gradients(256), 51.0), (edges(256), 60.0)],
    ids=["photo", "gradients", "edges"],
)
def test_pictures_come_back_with_little_error(picture: Bytes, least_db: float) -> None:
    data = uastc_encoder.encode(picture)
    assert data.shape == (64 * 64, 16)
    assert psnr(uastc.decode(data), _blocks_of(picture)) > least_db


def test_more_than_one_line_is_used_where_it_helps(monkeypatch: pytest.MonkeyPatch) -> None:
    blocks = _blocks_of(photo(256))
    data = uastc_encoder.encode_blocks(blocks)
    used = {
        number: int((data[:, 0] % (1 << mode.code_bits) == mode.code).sum())
        for number, mode in MODES.items()
    }
    assert min(used.values()) > 10, used
    best = psnr(uastc.decode(data), blocks)
    monkeypatch.setattr(uastc_encoder, "_GOOD", 1e9)
    assert psnr(uastc.decode(uastc_encoder.encode_blocks(blocks)), blocks) < best - 0.3


def test_halves_of_two_colours_each_are_found_in_every_pattern() -> None:
    rng = np.random.default_rng(8)
    colors = (rng.integers(0, 16, (30, 2, 2, 3)) * 17).astype(np.uint8)
    which = rng.integers(0, 2, (30, 16))
    pixels = colors[np.arange(30)[:, None], PATTERNS, which]
    found = uastc.decode(uastc_encoder.encode_blocks(pixels))
    assert np.abs(found.astype(int) - pixels).max() <= 1


def test_sides_that_are_no_multiples_of_4_repeat_their_last_pixels() -> None:
    picture = gradients(8)[:6, :7]
    found = uastc.decode(uastc_encoder.encode(picture)).reshape(2, 2, 4, 4, 3).swapaxes(1, 2)
    whole = found.reshape(8, 8, 3).astype(int)
    assert np.abs(whole[:6, :7] - picture).max() < 40
    wanted = uastc.decode(uastc_encoder.encode(np.pad(picture, ((0, 2), (0, 1), (0, 0)), "edge")))
    np.testing.assert_array_equal(
        whole, wanted.reshape(2, 2, 4, 4, 3).swapaxes(1, 2).reshape(8, 8, 3)
    )
