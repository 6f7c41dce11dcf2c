"""A picture as KTX2 with UASTC blocks, which graphics cards keep at a byte a pixel.

A file is a header, an index of the levels, what the pixels are (the data format descriptor), a note
of who wrote it, and the levels, the smallest first, each compressed by itself (Zstandard). Level 0
is the picture, each further one has half its sides, down to one pixel; they are made of linear
light, so that fine patterns keep their brightness.

As KHR_texture_basisu wants base colours: RGB without alpha, sRGB with the primaries of BT.709, the
first row on top, sides multiples of 4.

Source: Khronos, KTX file format 2.0; Data Format Specification 1.4, sections 5.6.14 and 25;
KHR_texture_basisu.
"""

from __future__ import annotations

import struct
from collections.abc import Callable

import numpy as np
import zstandard
from numpy.typing import NDArray
from PIL import Image

from pipelines.exports.formats import uastc, uastc_encoder
from pipelines.exports.formats.srgb import linear_from_srgb

Bytes = NDArray[np.uint8]
Floats = NDArray[np.float32]

MAGIC = b"\xabKTX 20\xbb\r\n\x1a\n"
_HEADER, _INDEX, _LEVEL = struct.Struct("<9I"), struct.Struct("<4I2Q"), struct.Struct("<3Q")
_UNDEFINED, _ZSTANDARD = 0, 2
_UASTC, _BT709, _SRGB, _RGB = 166, 1, 2, 0
_ZSTANDARD_LEVEL = 9
"""The highest makes 4 % less of blocks in sixteen times as long."""
_MAX_SIDE = 16384
_ENCODE_SHARE = 0.95
_WRITER = b"KTXwriter\0nerfworks\0"
_DESCRIPTOR = struct.pack(
    "<I IHH 4B 4B 8B HBB 4B 2I",
    *(44, 0, 2, 40),  # bytes of all; vendor and type, version, bytes of the block
    *(_UASTC, _BT709, _SRGB, 0),  # the last: alpha is not multiplied in, nor is there any
    *(uastc.SIDE - 1, uastc.SIDE - 1, 0, 0),
    *(uastc.BLOCK_BYTES, 0, 0, 0, 0, 0, 0, 0),
    *(0, 8 * uastc.BLOCK_BYTES - 1, _RGB),  # the one sample: from this bit on, so many less 1
    *(0, 0, 0, 0, 0, 0xFFFFFFFF),  # where it lies in the block, its least and greatest value
)
_LINEAR = linear_from_srgb(np.linspace(0.0, 1.0, 256)).astype(np.float32)
_BETWEEN = linear_from_srgb(np.linspace(0.5, 254.5, 255) / 255.0).astype(np.float32)
"""Where one 8-bit value ends and the next begins, in linear light."""


def encode(picture: Bytes, on_progress: Callable[[float], None] = lambda done: None) -> bytes:
    """RGB [H, W, 3], sRGB, with all its levels. Raises ValueError for sides that are not right.

    on_progress: told the share that is done; may raise.
    """
    height, width = picture.shape[:2]
    if picture.dtype != np.uint8 or picture.shape[2:] != (3,):
        raise ValueError(f"a KTX2 texture is RGB of 8 bits, not {picture.shape} {picture.dtype}")
    if not 0 < height <= _MAX_SIDE or not 0 < width <= _MAX_SIDE or height % 4 or width % 4:
        raise ValueError(
            f"a KTX2 texture of {width}x{height} pixels cannot be: sides are multiples of 4, "
            f"at most {_MAX_SIDE}"
        )
    blocks = _encoded(levels(picture), lambda done: on_progress(_ENCODE_SHARE * done))
    compressor = zstandard.ZstdCompressor(level=_ZSTANDARD_LEVEL, write_content_size=True)
    packed = [compressor.compress(level) for level in blocks]
    described = len(MAGIC) + _HEADER.size + _INDEX.size + _LEVEL.size * len(blocks)
    noted = described + len(_DESCRIPTOR)
    note = struct.pack("<I", len(_WRITER)) + _WRITER
    note += b"\0" * (-len(note) % 4)
    at = noted + len(note)
    index = []
    for raw, small in reversed(list(zip(blocks, packed, strict=True))):
        index.append(_LEVEL.pack(at, len(small), len(raw)))
        at += len(small)
    head = _HEADER.pack(_UNDEFINED, 1, width, height, 0, 0, 1, len(blocks), _ZSTANDARD)
    head += _INDEX.pack(described, len(_DESCRIPTOR), noted, len(note), 0, 0)
    on_progress(1.0)
    return b"".join([MAGIC, head, *reversed(index), _DESCRIPTOR, note, *reversed(packed)])


def decode(data: bytes | memoryview, level: int = 0) -> Bytes:
    """A level, RGB [H, W, 3], of what `encode` made. Raises ValueError for other files, and for
    what is cut short."""
    try:
        if bytes(data[: len(MAGIC)]) != MAGIC:
            raise ValueError("its first bytes are others")
        head = _HEADER.unpack_from(data, len(MAGIC))
        where = len(MAGIC) + _HEADER.size
        described, length = _INDEX.unpack_from(data, where)[:2]
        width, height, num_levels = head[2], head[3], head[7]
        plain = (_UNDEFINED, 1, width, height, 0, 0, 1, num_levels, _ZSTANDARD)
        if head != plain or bytes(data[described : described + length]) != _DESCRIPTOR:
            raise ValueError("it holds another kind of picture")
        if not 0 < max(width, height) <= _MAX_SIDE or not 0 <= level < num_levels:
            raise ValueError("it has no such level")
        at, packed, size = _LEVEL.unpack_from(data, where + _INDEX.size + _LEVEL.size * level)
        width, height = max(1, width >> level), max(1, height >> level)
        rows, columns = -(-height // 4), -(-width // 4)
        wanted = rows * columns * uastc.BLOCK_BYTES
        small = data[at : at + packed]
        if size != wanted or zstandard.frame_content_size(small) != wanted:
            raise ValueError("its levels have other sizes")
        raw = zstandard.ZstdDecompressor().decompress(small)
    except (struct.error, zstandard.ZstdError, ValueError) as error:
        raise ValueError(f"no KTX2 texture of ours: {error}") from error
    pixels = uastc.decode(np.frombuffer(raw, np.uint8).reshape(-1, uastc.BLOCK_BYTES))
    whole = pixels.reshape(rows, columns, 4, 4, 3).swapaxes(1, 2).reshape(4 * rows, 4 * columns, 3)
    return np.ascontiguousarray(whole[:height, :width])


def levels(picture: Bytes) -> list[Bytes]:
    """The picture [H, W, 3] and its smaller copies, down to one pixel, by means of linear light."""
    # Channel by channel: light is four times the picture's bytes.
    channels = [_smaller(picture[:, :, channel]) for channel in range(3)]
    return [picture, *(np.stack(level, axis=2) for level in zip(*channels, strict=True))]


def _encoded(pictures: list[Bytes], on_progress: Callable[[float], None]) -> list[bytes]:
    """The blocks of each of them."""
    total, before = sum(picture.size for picture in pictures), 0
    found = []
    for picture in pictures:

        def on_share(done: float, before: int = before, size: int = picture.size) -> None:
            on_progress((before + size * done) / total)

        found.append(uastc_encoder.encode(picture, on_share).tobytes())
        before += picture.size
    return found


def _smaller(channel: Bytes) -> list[Bytes]:
    """Its copies, each with half the sides. Boxes overlap where a side is odd."""
    light = Image.fromarray(_LINEAR[channel])
    found = []
    while max(light.size) > 1:
        width, height = light.size
        half = (max(1, width // 2), max(1, height // 2))
        light = light.resize(half, Image.Resampling.BOX)
        found.append(_srgb(np.asarray(light)))
    return found


def _srgb(linear: Floats) -> Bytes:
    """8-bit sRGB of linear light in 0...1."""
    return np.searchsorted(_BETWEEN, linear.ravel()).astype(np.uint8).reshape(linear.shape)
