"""Photos as phones and cameras write them: HEIC (ISO 23008-12) and DNG (1.4), byte by byte.

The HEVC picture of an HEIC is made by the ffmpeg that the product uses, as a program.
"""

from __future__ import annotations

import struct
import subprocess
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
import PIL.Image

from pipelines.tools.ffmpeg import ffmpeg_executable

Pixels = npt.NDArray[np.uint8]
"""[h, w, 3] sRGB."""

_VPS, _SPS, _PPS = 32, 33, 34
_PREFIX_SEI = 39


def _box(kind: bytes, *parts: bytes) -> bytes:
    body = b"".join(parts)
    return struct.pack(">I", 8 + len(body)) + kind + body


def _full(kind: bytes, version: int, flags: int, *parts: bytes) -> bytes:
    return _box(kind, struct.pack(">I", version << 24 | flags), *parts)


def _hevc(pixels: npt.NDArray[np.generic], ten_bit: bool, crf: int) -> list[bytes]:
    """One intra picture's NAL units, full range BT.601, 4:2:0."""
    height, width = pixels.shape[:2]
    deep = pixels.dtype == np.uint16
    command = [
        *(ffmpeg_executable(), "-nostdin", "-hide_banner", "-loglevel", "error"),
        *("-f", "rawvideo", "-pix_fmt", "rgb48le" if deep else "rgb24"),
        *("-s", f"{width}x{height}", "-i", "pipe:0"),
        *("-vf", "scale=out_range=full:out_color_matrix=bt601:flags=accurate_rnd"),
        *("-pix_fmt", "yuv420p10le" if ten_bit else "yuv420p", "-frames:v", "1"),
        *("-c:v", "libx265", "-x265-params", f"crf={crf}:log-level=none:info=0:repeat-headers=1"),
        *("-f", "hevc", "pipe:1"),
    ]
    done = subprocess.run(command, input=pixels.tobytes(), capture_output=True, check=True)
    units = [unit.rstrip(b"\0") for unit in done.stdout.split(b"\0\0\1")]
    return [unit for unit in units if unit and unit[0] >> 1 & 63 != _PREFIX_SEI]


def _hvcc(units: Sequence[bytes], ten_bit: bool) -> bytes:
    sets = [(kind, [u for u in units if u[0] >> 1 & 63 == kind]) for kind in (_VPS, _SPS, _PPS)]
    profile = sets[1][1][0][3:15]  # profile, tier and level as the SPS has them
    depth = 2 if ten_bit else 0
    head = (
        b"\1"
        + profile
        + struct.pack(
            ">HBBBBHBB", 0xF000, 0xFC, 0xFD, 0xF8 | depth, 0xF8 | depth, 0, 0x0F, len(sets)
        )
    )
    arrays = b""
    for kind, found in sets:
        arrays += struct.pack(">BH", 0x80 | kind, len(found))
        arrays += b"".join(struct.pack(">H", len(unit)) + unit for unit in found)
    return _box(b"hvcC", head + arrays)


@dataclass(frozen=True)
class Heic:
    """What an HEIC says beside its picture.

    quarter_turns: anticlockwise, that a viewer makes (irot). exif: as Pillow writes it. icc: a
    profile. nclx: primaries and transfer. size: width and height declared, where not the true ones.
    tile_px: side of the tiles that it is cut into, as phones do, 0 for one piece. depth: whether a
    depth map lies beside it.
    """

    quarter_turns: int = 0
    exif: PIL.Image.Exif | None = None
    icc: bytes = b""
    nclx: tuple[int, int] | None = None
    size: tuple[int, int] | None = None
    brand: bytes = b"heic"
    tile_px: int = 0
    depth: bool = False


def heic(
    pixels: npt.NDArray[np.generic], said: Heic | None = None, ten_bit: bool = False, crf: int = 4
) -> bytes:
    """A picture as HEIC. pixels: [h, w, 3] as stored, even sides, uint8, or uint16 of 16 bits."""
    said = said or Heic()
    side = said.tile_px
    height, width = pixels.shape[:2]
    parts = [pixels]
    if side:
        padding = ((0, -height % side), (0, -width % side), (0, 0))
        padded = np.pad(pixels, padding, mode="edge")
        rows, columns = padded.shape[0] // side, padded.shape[1] // side
        parts = [
            padded[side * y : side * (y + 1), side * x : side * (x + 1)]
            for y in range(rows)
            for x in range(columns)
        ]
    coded = [_hevc(part, ten_bit, crf) for part in parts]
    primaries, transfer = said.nclx or (1, 13)
    # Properties of a tile, and of the whole picture, by their numbers from 1 on.
    properties = [_hvcc(coded[0], ten_bit), _extent(*parts[0].shape[1::-1])]
    whole = [2] if not side and said.size is None else [3]
    if whole == [3]:
        properties.append(_extent(*(said.size or (width, height))))
    for box in (
        _box(b"colr", b"prof", said.icc) if said.icc else b"",
        _box(b"colr", b"nclx", struct.pack(">HHHB", primaries, transfer, 6, 0x80)),
        _box(b"irot", bytes([said.quarter_turns % 4])) if said.quarter_turns else b"",
    ):
        if box:
            properties.append(box)
            whole.append(len(properties))
    turned = len(properties) if said.quarter_turns else 0
    data = [
        b"".join(struct.pack(">I", len(u)) + u for u in units if u[0] >> 1 & 63 < _VPS)
        for units in coded
    ]
    num_tiles = len(data)
    hidden = int(bool(side))
    items = [_item(n, b"hvc1", hidden) for n in range(1, num_tiles + 1)]
    links = {n: [1, 2] for n in range(1, num_tiles + 1)}
    references = b""
    primary = 1
    if side:
        data.append(struct.pack(">BBBBHH", 0, 0, rows - 1, columns - 1, width, height))
        primary = len(data)
        items.append(_item(primary, b"grid"))
        tiles = struct.pack(f">HH{num_tiles}H", primary, num_tiles, *range(1, num_tiles + 1))
        references += _box(b"dimg", tiles)
        links[primary] = whole
    else:
        links[1] = [1, *whole]
    if said.depth:
        data.append(b"".join(data[:1]))
        items.append(_item(len(data), b"hvc1"))
        properties.append(_full(b"auxC", 0, 0, b"urn:mpeg:hevc:2015:auxid:2\0"))
        links[len(data)] = [1, 2, len(properties)]
        references += _box(b"auxl", struct.pack(">HHH", len(data), 1, primary))
    if said.exif is not None:
        data.append(struct.pack(">I", 6) + said.exif.tobytes())
        items.append(_item(len(data), b"Exif"))
        references += _box(b"cdsc", struct.pack(">HHH", len(data), 1, primary))
    linked = b"".join(
        struct.pack(">HB", item, len(numbers))
        + bytes(n | (0x80 if n in (1, turned) else 0) for n in numbers)
        for item, numbers in sorted(links.items())
    )
    first = _box(b"ftyp", said.brand, bytes(4), b"mif1", b"heic")

    def meta(start: int) -> bytes:
        places = b""
        for number, part in enumerate(data, start=1):
            places += struct.pack(">HHHII", number, 0, 1, start, len(part))
            start += len(part)
        return _full(
            b"meta",
            0,
            0,
            _full(b"hdlr", 0, 0, bytes(4), b"pict", bytes(13)),
            _full(b"pitm", 0, 0, struct.pack(">H", primary)),
            _full(b"iloc", 0, 0, b"\x44\0", struct.pack(">H", len(data)), places),
            _full(b"iinf", 0, 0, struct.pack(">H", len(items)), *items),
            _full(b"iref", 0, 0, references) if references else b"",
            _box(
                b"iprp",
                _box(b"ipco", *properties),
                _full(b"ipma", 0, 0, struct.pack(">I", len(links)), linked),
            ),
        )

    start = len(first) + len(meta(0)) + 8
    return first + meta(start) + _box(b"mdat", *data)


def _extent(width: int, height: int) -> bytes:
    return _full(b"ispe", 0, 0, struct.pack(">II", width, height))


def _item(number: int, kind: bytes, hidden: int = 0) -> bytes:
    return _full(b"infe", 2, hidden, struct.pack(">HH", number, 0), kind, b"\0")


_SHORT, _LONG, _RATIONAL, _SRATIONAL, _ASCII, _BYTE = 3, 4, 5, 10, 2, 1
_FORMS = {_SHORT: "H", _LONG: "I", _BYTE: "B"}
Tags = dict[int, tuple[int, Sequence[float] | bytes]]


def _value(kind: int, values: Sequence[float] | bytes) -> tuple[int, bytes]:
    """How many values there are, and their bytes."""
    if isinstance(values, bytes):
        return len(values), values
    if kind in (_RATIONAL, _SRATIONAL):
        form = "<II" if kind == _RATIONAL else "<ii"
        return len(values), b"".join(struct.pack(form, round(v * 10_000), 10_000) for v in values)
    return len(values), struct.pack(f"<{len(values)}{_FORMS[kind]}", *map(int, values))


def _directory(tags: Tags, place: int) -> bytes:
    """A TIFF directory that is to lie at `place`, its longer values behind it."""
    extra_at = place + 2 + 12 * len(tags) + 4
    entries, extra = struct.pack("<H", len(tags)), b""
    for tag, (kind, values) in sorted(tags.items()):
        count, data = _value(kind, values)
        if len(data) > 4:
            where = struct.pack("<I", extra_at + len(extra))
            extra += data + bytes(len(data) % 2)
        else:
            where = data.ljust(4, b"\0")
        entries += struct.pack("<HHI", tag, kind, count) + where
    return entries + bytes(4) + extra


_XYZ_FROM_SRGB = np.array(
    [
        [0.4124564, 0.3575761, 0.1804375],
        [0.2126729, 0.7151522, 0.0721750],
        [0.0193339, 0.1191920, 0.9503041],
    ]
)


@dataclass(frozen=True)
class Dng:
    """What a DNG says beside its sensor's values.

    orientation: EXIF's. white: the sensor's balance, red and blue under green of 1. stops:
    BaselineExposure. focal_mm, focal_35mm: of its lens. size: declared, where not the true one.
    """

    orientation: int = 1
    white: tuple[float, float] = (0.5, 0.625)
    stops: float = 0.0
    focal_mm: float = 5.0
    focal_35mm: int = 26
    size: tuple[int, int] | None = None
    thumbnail: bool = True


def dng(pixels: Pixels, said: Dng | None = None, white_level: int = 16383) -> bytes:
    """A picture as an uncompressed Bayer DNG of 16 bits (RGGB), behind a thumbnail of 8x6.

    pixels: [h, w, 3] sRGB as stored, even sides. Its sensor sees sRGB's primaries, and a white
    surface as `said.white`.
    """
    said = said or Dng()
    signal = pixels.astype(np.float64) / 255
    linear = np.where(signal <= 0.04045, signal / 12.92, ((signal + 0.055) / 1.055) ** 2.4)
    sensor = linear * (said.white[0], 1.0, said.white[1]) * white_level
    mosaic = sensor[..., 1].copy()
    mosaic[::2, ::2] = sensor[::2, ::2, 0]
    mosaic[1::2, 1::2] = sensor[1::2, 1::2, 2]
    values = np.round(mosaic).astype("<u2").tobytes()
    thumbnail = bytes(range(48)) * 3
    width, height = said.size or (pixels.shape[1], pixels.shape[0])
    # Camera numbers of XYZ: those of linear sRGB, each as strong as the sensor sees it.
    balance = np.diag([said.white[0], 1.0, said.white[1]])
    from_xyz = balance @ np.linalg.inv(_XYZ_FROM_SRGB)
    photo: Tags = {
        254: (_LONG, [0]), 256: (_LONG, [width]), 257: (_LONG, [height]), 258: (_SHORT, [16]),
        259: (_SHORT, [1]), 262: (_SHORT, [32803]), 277: (_SHORT, [1]), 278: (_LONG, [height]),
        279: (_LONG, [len(values)]), 284: (_SHORT, [1]), 33421: (_SHORT, [2, 2]),
        33422: (_BYTE, bytes([0, 1, 1, 2])), 50714: (_SHORT, [0]), 50717: (_LONG, [white_level]),
    }  # fmt: skip
    main: Tags = {
        271: (_ASCII, b"Maker\0"), 272: (_ASCII, b"Phone 9\0"), 274: (_SHORT, [said.orientation]),
        50706: (_BYTE, bytes([1, 4, 0, 0])), 50707: (_BYTE, bytes([1, 1, 0, 0])),
        50708: (_ASCII, b"Maker Phone 9\0"),
        50721: (_SRATIONAL, from_xyz.ravel().tolist()),
        50728: (_RATIONAL, [said.white[0], 1.0, said.white[1]]),
        50730: (_SRATIONAL, [said.stops]), 50778: (_SHORT, [21]),
    }  # fmt: skip
    lens: Tags = {
        37386: (_RATIONAL, [said.focal_mm]), 41989: (_SHORT, [said.focal_35mm]),
        36867: (_ASCII, b"2024:05:06 07:08:09\0"),
    }  # fmt: skip
    small: Tags = {
        254: (_LONG, [1]), 256: (_LONG, [8]), 257: (_LONG, [6]), 258: (_SHORT, [8, 8, 8]),
        259: (_SHORT, [1]), 262: (_SHORT, [2]), 277: (_SHORT, [3]), 278: (_LONG, [6]),
        279: (_LONG, [len(thumbnail)]), 284: (_SHORT, [1]),
    }  # fmt: skip
    top = main | (small if said.thumbnail else photo)
    tables: list[Tags] = [top, lens, *([photo] if said.thumbnail else [])]

    def places(known: Sequence[int]) -> list[bytes]:
        top[34665] = (_LONG, [known[1]])
        if said.thumbnail:
            top[330], top[273] = (_LONG, [known[2]]), (_LONG, [known[3]])
        photo[273] = (_LONG, [known[-1]])
        if not said.thumbnail:
            top[273] = photo[273]
        return [_directory(table, place) for table, place in zip(tables, known, strict=False)]

    known = [8] * (len(tables) + 2)
    for _ in range(2):  # the first time for the lengths
        lengths = [*map(len, places(known)), len(thumbnail)]
        known = [8 + sum(lengths[:n]) for n in range(len(lengths) + 1)]
    return b"II*\0" + struct.pack("<I", 8) + b"".join([*places(known), thumbnail, values])
