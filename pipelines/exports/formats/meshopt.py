"""Arrays of a glTF file made smaller without loss, as EXT_meshopt_compression stores them.

Rows of vertices (`ATTRIBUTES`) are told byte by byte by how they differ from the row before, in
groups of 16 differences with 0, 2, 4 or 8 bits each; indices (`INDICES`) by how they differ from
the index before, in as few bytes as each needs. Both get small where neighbours in the file are
neighbours in space. What is larger than a group's bits have room for follows the group.

Source: Khronos, EXT_meshopt_compression, appendix A (bitstream, version 0 and 1); its other modes
and its filters are not used.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Bytes = NDArray[np.uint8]
Ints = NDArray[np.int64]

_ATTRIBUTES_HEADER, _INDICES_HEADER = 0xA0, 0xD1
_GROUP, _BLOCK, _BLOCK_BYTES, _TAIL = 16, 256, 8192, 32
_INDICES_TAIL = 4
_SIZES = (0, 4, 8, 16)
"""Bytes of a group by its mode, without what does not fit."""
_LIMITS = (1, 3, 15, 256)
"""The least difference that does not fit, by mode; of mode 0 none may."""


def encode_attributes(rows: Bytes) -> bytes:
    """Rows [N, S] of bytes, S a multiple of 4 and at most 256."""
    count, stride = rows.shape
    zigzag = _zigzag(np.diff(rows, axis=0, prepend=rows[:1]))
    groups = -(-count // _GROUP)
    padded = np.zeros((groups * _GROUP, stride), np.uint8)
    padded[:count] = zigzag
    by_byte = np.ascontiguousarray(padded.T).reshape(stride, groups, _GROUP)
    mode, packed, used = _packed(by_byte)
    parts = [bytes([_ATTRIBUTES_HEADER])]
    step = _block_rows(stride) // _GROUP
    for first in range(0, groups, step):
        block = slice(first, min(first + step, groups))
        for byte in range(stride):
            parts.append(_header(mode[byte, block]).tobytes())
            parts.append(packed[byte, block][used[byte, block]].tobytes())
    parts += [bytes(max(_TAIL - stride, 0)), rows[0].tobytes()]
    return b"".join(parts)


def decode_attributes(data: bytes | memoryview, count: int, stride: int) -> Bytes:
    """[N, S] of what `encode_attributes` made. Raises ValueError for what is cut short or other."""
    stream = np.frombuffer(data, np.uint8)
    if len(stream) < 1 + max(stride, _TAIL) or stream[0] != _ATTRIBUTES_HEADER:
        raise ValueError("compressed vertices have another beginning, or are cut short")
    groups, at = -(-count // _GROUP), 1
    found = np.zeros((stride, groups, _GROUP), np.uint8)
    step = _block_rows(stride) // _GROUP
    for first in range(0, groups, step):
        many = min(step, groups - first)
        for byte in range(stride):
            length = -(-many // 4)
            modes = _modes(stream[at : at + length])[:many]
            at += length
            for index in np.flatnonzero(modes):
                found[byte, first + index], at = _group(stream, at, int(modes[index]))
    if at + max(stride, _TAIL) != len(stream):
        raise ValueError("compressed vertices are cut short")
    difference = found.reshape(stride, -1)[:, :count].T
    signed = (difference >> 1) ^ (0 - (difference & 1)).astype(np.uint8)
    rows: Bytes = (stream[-stride:] + np.cumsum(signed, axis=0, dtype=np.uint8)).astype(np.uint8)
    return rows


def encode_indices(indices: NDArray[np.integer]) -> bytes:
    """Indices [N], each below 2**30."""
    wide: NDArray[np.int64] = indices.astype(np.int64)
    difference: NDArray[np.int64] = np.diff(wide, prepend=np.int64(0)).astype(np.int64)
    # The lowest bit would choose another index than the last to count from.
    values = ((difference << 1) ^ (difference >> 63)) << 1
    lengths = 1 + sum((values >> bits != 0).astype(np.int64) for bits in (7, 14, 21, 28))
    ends = np.cumsum(lengths)
    stream = np.zeros(int(ends[-1]) if len(ends) else 0, np.uint8)
    for place in range(5):
        longer = lengths > place
        value = (values[longer] >> (7 * place)) & 0x7F
        more = (lengths[longer] > place + 1).astype(np.int64) << 7
        stream[(ends - lengths)[longer] + place] = value | more
    return bytes([_INDICES_HEADER]) + stream.tobytes() + bytes(_INDICES_TAIL)


def decode_indices(data: bytes | memoryview, count: int) -> Ints:
    """[N] of what `encode_indices` made. Raises ValueError for what is cut short or other."""
    stream = np.frombuffer(data, np.uint8)
    if len(stream) < 1 + _INDICES_TAIL or stream[0] != _INDICES_HEADER:
        raise ValueError("compressed indices have another beginning, or are cut short")
    body = stream[1:-_INDICES_TAIL].astype(np.int64)
    ends = np.flatnonzero(body < 0x80)
    if len(ends) != count or (count and ends[-1] != len(body) - 1):
        raise ValueError("compressed indices are cut short")
    starts = np.concatenate([[0], ends[:-1] + 1]) if count else np.zeros(0, np.int64)
    place = np.arange(len(body)) - np.repeat(starts, ends - starts + 1)
    values = np.add.reduceat((body & 0x7F) << (7 * place), starts) if count else starts
    if (values & 1).any():
        raise ValueError("compressed indices count from elsewhere")
    values >>= 1
    found: Ints = np.cumsum((values >> 1) ^ -(values & 1))
    return found


def _zigzag(difference: Bytes) -> Bytes:
    """Small differences of either sign as small numbers: 0, -1, 1, -2 as 0, 1, 2, 3."""
    signed = difference.view(np.int8)
    zigzag: Bytes = ((signed << 1) ^ (signed >> 7)).view(np.uint8)
    return zigzag


def _block_rows(stride: int) -> int:
    return min(_BLOCK_BYTES // stride // _GROUP * _GROUP, _BLOCK)


def _packed(groups: Bytes) -> tuple[NDArray[np.int64], Bytes, NDArray[np.bool_]]:
    """Groups [S, G, 16] in the fewest bytes: mode [S, G], bytes [S, G, 16], which of them count."""
    over = [groups >= limit for limit in _LIMITS[:3]]
    sizes = np.stack(
        [
            np.where(over[0].any(axis=2), _GROUP + 1, 0),
            *(size + mask.sum(axis=2) for size, mask in zip(_SIZES[1:3], over[1:], strict=True)),
            np.full(groups.shape[:2], _GROUP),
        ]
    )
    mode = sizes.argmin(axis=0)
    packed = np.where(mode[..., None] == 3, groups, 0).astype(np.uint8)
    for one in (1, 2):
        chosen = mode == one
        some, mask = groups[chosen], over[one][chosen]
        bits = 8 * _SIZES[one] // _GROUP
        fitting = np.minimum(some, _LIMITS[one]).reshape(len(some), _SIZES[one], 8 // bits)
        shifts = np.arange(8 - bits, -1, -bits)
        rows = np.zeros_like(some)
        rows[:, : _SIZES[one]] = (fitting.astype(np.int64) << shifts).sum(axis=2)
        row, column = np.nonzero(mask)
        rows[row, _SIZES[one] + (mask.cumsum(axis=1) - 1)[row, column]] = some[row, column]
        packed[chosen] = rows
    used = np.arange(_GROUP) < sizes.min(axis=0)[..., None]
    return mode, packed, used


def _header(modes: NDArray[np.int64]) -> Bytes:
    """Modes of groups, four to a byte, the first lowest."""
    four = np.zeros(-(-len(modes) // 4) * 4, np.int64)
    four[: len(modes)] = modes
    header: Bytes = (four.reshape(-1, 4) << np.array([0, 2, 4, 6])).sum(axis=1).astype(np.uint8)
    return header


def _modes(header: Bytes) -> Bytes:
    modes: Bytes = ((header[:, None] >> np.array([0, 2, 4, 6], np.uint8)) & 3).astype(np.uint8)
    return modes.reshape(-1)


def _group(stream: Bytes, at: int, mode: int) -> tuple[Bytes, int]:
    """The 16 differences of a group from there, and where it ends."""
    size = _SIZES[mode]
    if mode == 3:
        return stream[at : at + size], at + size
    bits = 8 * size // _GROUP
    shifts = np.arange(8 - bits, -1, -bits).astype(np.uint8)
    packed: Bytes = ((stream[at : at + size, None] >> shifts) & _LIMITS[mode]).astype(np.uint8)
    values = packed.reshape(-1)
    over = values == _LIMITS[mode]
    end = at + size + int(over.sum())
    values[over] = stream[at + size : end]
    return values, end
