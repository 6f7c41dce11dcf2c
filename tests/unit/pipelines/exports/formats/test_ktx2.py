"""KTX2 files, read by hand and by our own reader."""

from __future__ import annotations

import struct

import numpy as np
import pytest
import zstandard
from numpy.typing import NDArray

from pipelines.exports.formats import ktx2, uastc, uastc_encoder
from tests.texture_pictures import gradients, photo, psnr

Bytes = NDArray[np.uint8]

# KTX 2.0, section 3.10, and Data Format 1.4, section 5.6.14: a block of 44 bytes in all.
DESCRIPTOR = (
    "2c000000"  # size of all
    "00000000 02002800"  # Khronos, a basic descriptor; version 2, 40 bytes
    "a6 01 02 00"  # UASTC, primaries of BT.709, sRGB, straight alpha
    "03030000 10000000 00000000"  # blocks of 4x4, 16 bytes
    "0000 7f 00 00000000 00000000 ffffffff"  # one sample: 128 bits from bit 0, RGB, 0 to all bits
)


def _index(data: bytes) -> list[tuple[int, int, int]]:
    """Of each level where it begins, its bytes, and those of what is in it."""
    (many,) = struct.unpack_from("<I", data, 40)
    return [struct.unpack_from("<3Q", data, 80 + 24 * level) for level in range(many)]


@pytest.mark.parametrize(("height", "width"), [(64, 64), (16, 128), (12, 4), (4, 4)])
def test_a_file_is_as_the_specification_has_it(height: int, width: int) -> None:
    data = ktx2.encode(gradients(128)[:height, :width])
    assert data[:12] == bytes.fromhex("ab4b5458203230bb0d0a1a0a")
    many = max(height, width).bit_length()
    head = struct.unpack_from("<9I", data, 12)
    # No vkFormat, type size, sides, depth, layers, faces, levels, Zstandard.
    assert head == (0, 1, width, height, 0, 0, 1, many, 2)
    described, length, noted, note_bytes, global_at, global_bytes = struct.unpack_from(
        "<4I2Q", data, 48
    )
    assert described == 80 + 24 * many
    assert data[described : described + length] == bytes.fromhex(DESCRIPTOR)
    assert noted == described + length
    assert (global_at, global_bytes) == (0, 0)
    (text_bytes,) = struct.unpack_from("<I", data, noted)
    assert data[noted + 4 : noted + 4 + text_bytes] == b"KTXwriter\0nerfworks\0"
    assert note_bytes == 4 + text_bytes + -text_bytes % 4
    # Levels follow without a gap, the smallest first.
    at = noted + note_bytes
    for level, (begin, packed, size) in reversed(list(enumerate(_index(data)))):
        assert begin == at
        blocks = -(-max(1, height >> level) // 4) * -(-max(1, width >> level) // 4)
        assert size == 16 * blocks
        raw = zstandard.ZstdDecompressor().decompress(data[begin : begin + packed])
        assert len(raw) == size
        at += packed
    assert at == len(data)


def test_levels_come_back() -> None:
    picture = photo(256)[:64, :64]
    data = ktx2.encode(picture)
    levels = ktx2.levels(picture)
    assert [level.shape for level in levels] == [(64 >> k, 64 >> k, 3) for k in range(7)]
    for number, level in enumerate(levels):
        blocks = uastc.decode(uastc_encoder.encode(level))
        side = -(-len(level) // 4)
        whole = blocks.reshape(side, side, 4, 4, 3).swapaxes(1, 2).reshape(4 * side, 4 * side, 3)
        np.testing.assert_array_equal(ktx2.decode(data, number), whole[: len(level), : len(level)])
    assert psnr(ktx2.decode(memoryview(data)), picture) > 38.0


def test_the_share_that_is_done_rises_to_1() -> None:
    told: list[float] = []
    blocks = uastc_encoder.encode(photo(512), told.append)
    assert told == [0.25, 0.5, 0.75, 1.0]
    np.testing.assert_array_equal(blocks, uastc_encoder.encode(photo(512)))
    told.clear()
    ktx2.encode(photo(512), told.append)
    assert told == sorted({*told})
    assert len(told) == 4 + 9 + 1  # of the picture, each of its levels, the file
    assert told[0] == pytest.approx(0.25 * 0.75 * 0.95, rel=0.01)
    assert told[-1] == 1.0


def test_blocks_lie_row_by_row() -> None:
    picture = np.zeros((8, 12, 3), np.uint8)
    picture[:4, 8:] = (250, 10, 90)
    data = ktx2.encode(picture)
    begin, packed, _ = _index(data)[0]
    raw = zstandard.ZstdDecompressor().decompress(data[begin : begin + packed])
    colors = uastc.decode(np.frombuffer(raw, np.uint8).reshape(-1, 16))[:, 0]
    np.testing.assert_array_equal(colors[2], (250, 10, 90))
    assert not colors[[0, 1, 3, 4, 5]].any()
    np.testing.assert_array_equal(ktx2.decode(data), picture)


def test_smaller_copies_are_means_of_light() -> None:
    board = np.indices((16, 16)).sum(axis=0) % 2
    picture = np.repeat(255 * board[:, :, None], 3, axis=2).astype(np.uint8)
    for level in ktx2.levels(picture)[1:]:
        assert set(level.ravel().tolist()) == {188}, "half of the light is 188 in sRGB"
    plain = np.full((12, 20, 3), (7, 130, 255), np.uint8)
    levels = ktx2.levels(plain)
    assert [level.shape[:2] for level in levels] == [(12, 20), (6, 10), (3, 5), (1, 2), (1, 1)]
    assert all((level == (7, 130, 255)).all() for level in levels)


@pytest.mark.parametrize(
    ("shape", "why"),
    [
        ((10, 8, 3), "8x10 pixels .* multiples of 4"),
        ((8, 6, 3), "6x8 pixels .* multiples of 4"),
        ((0, 8, 3), "8x0 pixels"),
        ((4, 16388, 3), "at most 16384"),
        ((8, 8, 4), "is RGB"),
        ((8, 8), "is RGB"),
    ],
)
def test_a_picture_that_cannot_be_a_texture_is_refused(shape: tuple[int, ...], why: str) -> None:
    with pytest.raises(ValueError, match=why):
        ktx2.encode(np.zeros(shape, np.uint8))
    with pytest.raises(ValueError, match="is RGB of 8 bits"):
        ktx2.encode(np.zeros((8, 8, 3), np.uint16))


def test_files_that_are_cut_short_or_something_else_are_refused() -> None:
    data = ktx2.encode(photo(32))
    for broken in (b"", data[:30], data[:100], data[:-9], b"\x89PNG" + data[4:]):
        with pytest.raises(ValueError, match="no KTX2 texture of ours"):
            ktx2.decode(broken)
    for at, value in ((12, 37), (44, 0), (80 + 24 * 6 + 12, 163), (80 + 16, 1)):
        other = bytearray(data)
        other[at] = value
        with pytest.raises(ValueError, match="no KTX2 texture of ours"):
            ktx2.decode(bytes(other))
    with pytest.raises(ValueError, match="no such level"):
        ktx2.decode(data, 6)
