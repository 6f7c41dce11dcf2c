"""Compressed vertices and indices against meshoptimizer's own bytes and slow, plain decoders."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from pipelines.exports.formats.meshopt import (
    decode_attributes,
    decode_indices,
    encode_attributes,
    encode_indices,
)

Bytes = NDArray[np.uint8]

# meshoptimizer's encoder of vertices, version 0, on `_some_rows` (the wheel meshopt 0.1.0:
# encode_gltf_buffer(rows, "ATTRIBUTES", version=0)).
WANTED = (
    "a0152aaaaaaaaaaaaaaaaa8000002a0667676766767676676767667676766767676000000000001f0002060a"
    "0e12161a1e22262a2e32363a3e42464a4e52565a5e62666a6e72767affc000007e82868a8e15303c0f037271"
    "72717271c0f03c0f7271727172717203c0000071720400800000001f004a4a4a4a4a4a4a4a4a4a4a4a4a4a4a"
    "4a4a4a4a4a4a4a4a4a4a4a4a4a4a4a4affc000004a4a4a4a4a15155555555555555555400000000000000000"
    "000000000000000000000000000000000000000000c800090000"
)


def _some_rows() -> Bytes:
    i = np.arange(37)
    columns = [i, 3 * i % 7, i * i % 256, np.where(i % 5 == 0, 200, 1)]
    columns += [i // 20, 0 * i + 9, i * 37 % 256, -i % 256]
    return np.stack(columns, axis=1).astype(np.uint8)


def _plainly_decoded(data: bytes, count: int, stride: int) -> list[list[int]]:
    """Rows, byte after byte, as the specification tells it."""
    last, at = list(data[-stride:]), 1
    rows: list[list[int]] = []
    most = min(8192 // stride // 16 * 16, 256)
    assert data[0] == 0xA0
    while len(rows) < count:
        many = min(most, count - len(rows))
        groups = (many + 15) // 16
        block = [[0] * stride for _ in range(16 * groups)]
        for byte in range(stride):
            header, at = at, at + (groups + 3) // 4
            for group in range(groups):
                mode = data[header + group // 4] >> (2 * (group % 4)) & 3
                bits = (0, 2, 4, 8)[mode]
                beyond = at + 2 * bits
                for index in range(16):
                    bit = index * bits
                    value = (
                        data[at + bit // 8] >> (8 - bits - bit % 8) & (1 << bits) - 1 if bits else 0
                    )
                    if bits in (2, 4) and value == (1 << bits) - 1:
                        value, beyond = data[beyond], beyond + 1
                    delta = ~(value >> 1) if value & 1 else value >> 1
                    last[byte] = (last[byte] + delta) & 255
                    block[16 * group + index][byte] = last[byte]
                at = beyond
            last[byte] = block[many - 1][byte]
        rows += block[:many]
    assert at + max(32, stride) == len(data)
    return rows


def test_vertices_get_the_bytes_that_meshoptimizer_gives_them() -> None:
    rows = _some_rows()
    assert encode_attributes(rows).hex() == WANTED
    np.testing.assert_array_equal(decode_attributes(bytes.fromhex(WANTED), 37, 8), rows)


@pytest.mark.parametrize(
    ("count", "stride"), [(1, 4), (15, 8), (16, 4), (257, 12), (600, 64), (70, 256)]
)
@pytest.mark.parametrize("kind", ["noise", "smooth", "same", "jumps"])
def test_rows_of_any_kind_come_back(count: int, stride: int, kind: str) -> None:
    rng = np.random.default_rng(count + stride)
    steps = {
        "noise": rng.integers(0, 256, (count, stride)),
        "smooth": rng.integers(-2, 3, (count, stride)),
        "same": np.zeros((count, stride), np.int64),
        "jumps": np.where(rng.random((count, stride)) < 0.1, rng.integers(-99, 99), 1),
    }
    rows = (np.cumsum(steps[kind], axis=0) + 7).astype(np.uint8)
    data = encode_attributes(rows)
    np.testing.assert_array_equal(_plainly_decoded(data, count, stride), rows)
    np.testing.assert_array_equal(decode_attributes(data, count, stride), rows)
    most = 1 + rows.size + 16 * stride + -(-count // 64) * stride + max(stride, 32)
    assert len(data) <= most, "no larger than it was, but for headers"


def _plain_indices(data: bytes) -> list[int]:
    """As the specification tells it, from either of the last two that were counted from."""
    last, found, value, shift = [0, 0], list[int](), 0, 0
    assert data[0] == 0xD1
    assert data[-4:] == bytes(4)
    for byte in data[1:-4]:
        value |= (byte & 0x7F) << shift
        shift += 7
        if byte < 0x80:
            which, zigzag = value & 1, value >> 1
            last[which] += ~(zigzag >> 1) if zigzag & 1 else zigzag >> 1
            found.append(last[which])
            value = shift = 0
    return found


def test_indices_come_back_and_take_a_byte_each_where_they_are_near() -> None:
    rng = np.random.default_rng(3)
    near = np.abs(np.cumsum(rng.integers(-30, 31, 3000))) + 40
    for indices in (near, np.array([0, 2**30 - 1, 5, 2**20, 0]), np.zeros(1, np.int64)):
        data = encode_indices(indices)
        assert _plain_indices(data) == indices.tolist()
        np.testing.assert_array_equal(decode_indices(data, len(indices)), indices)
    assert len(encode_indices(near)) <= len(near) + 8


def test_what_is_cut_short_or_something_else_is_refused() -> None:
    rows, indices = encode_attributes(_some_rows()), encode_indices(np.arange(9))
    for data in (rows[:-1], rows[:20], b"\xa1" + rows[1:], b""):
        with pytest.raises(ValueError, match="compressed vertices"):
            decode_attributes(data, 37, 8)
    for data in (indices[:-1], b"\xe1" + indices[1:], b"\xd1\x81\0\0\0\0", b""):
        with pytest.raises(ValueError, match="compressed indices"):
            decode_indices(data, 9)
