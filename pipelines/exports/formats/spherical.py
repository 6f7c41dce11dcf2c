"""MP4 files that say that their picture is a whole sphere, so that players let people look round.

Both ways of saying so that players know: boxes `st3d` and `sv3d` in the video's sample entry
(version 2), and XML in a `uuid` box of the track (version 1), which says the same. Sources:
Google's "Spherical Video V2 RFC" and "Spherical Video RFC" (github.com/google/spatial-media,
docs/). Boxes: ISO/IEC 14496-12; a box is its size in 4 bytes, its kind in 4, and its content.
"""

from __future__ import annotations

import shutil
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import BinaryIO

_UUID = bytes.fromhex("ffcc8263f8554a938814587a02521fdd")
_XML = (
    '<?xml version="1.0"?><rdf:SphericalVideo'
    ' xmlns:rdf="http://www.w3.org/1999/02/22-rdf-syntax-ns#"'
    ' xmlns:GSpherical="http://ns.google.com/videos/1.0/spherical/">'
    "<GSpherical:Spherical>true</GSpherical:Spherical>"
    "<GSpherical:Stitched>true</GSpherical:Stitched>"
    "<GSpherical:StitchingSoftware>nerfworks</GSpherical:StitchingSoftware>"
    "<GSpherical:ProjectionType>equirectangular</GSpherical:ProjectionType>"
    "</rdf:SphericalVideo>"
)
_HOLDERS = (b"moov", b"trak", b"mdia", b"minf", b"stbl")
_SAMPLE_ENTRIES = (b"avc1", b"hvc1", b"hev1", b"av01")
_CODEC_BOXES = (b"avcC", b"hvcC", b"av1C")
_ENTRY_FIELDS = 78
"""Bytes of a visual sample entry before its boxes."""


def mark_equirectangular(path: Path) -> None:
    """Mark the video of a finished MP4, in place: the whole sphere, seen by one eye.

    Raises ValueError for a file that is none, or whose video is of another codec than ours.
    """
    with path.open("rb") as file:
        boxes = list(_top_level(file))
        places = {kind: (start, size) for kind, start, size in boxes}
        if b"moov" not in places or b"mdat" not in places:
            raise ValueError(f"{path.name} is no MP4 with a video")
        start, size = places[b"moov"]
        file.seek(start)
        old = file.read(size)[8:]
        marked = _marked(b"moov", old, 0)
        if _sphere() not in marked:
            raise ValueError(f"{path.name} has no video of a codec that is known here")
        grown = len(marked) - len(old)
        # Where pictures lie is told from the file's beginning, and the index comes before them.
        moved = grown if places[b"mdat"][0] > start else 0
        part = path.with_suffix(".part")
        with part.open("wb") as out:
            file.seek(0)
            out.write(file.read(start))
            out.write(_box(b"moov", _marked(b"moov", old, moved)))
            file.seek(start + size)
            shutil.copyfileobj(file, out, 1 << 20)
    part.replace(path)


def _top_level(file: BinaryIO) -> Iterator[tuple[bytes, int, int]]:
    """Kind, start and size of each box of a file."""
    end = file.seek(0, 2)
    start = 0
    while start + 8 <= end:
        file.seek(start)
        size, kind = struct.unpack(">I4s", file.read(8))
        if size == 1:
            size = struct.unpack(">Q", file.read(8))[0]
        elif size == 0:
            size = end - start
        if size < 8 or start + size > end:
            raise ValueError("a box reaches beyond the end of the file")
        yield kind, start, size
        start += size


def _boxes(content: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of each box in a box."""
    start = 0
    while start + 8 <= len(content):
        size, kind = struct.unpack_from(">I4s", content, start)
        if size < 8 or start + size > len(content):
            raise ValueError(f"the box {kind!r} reaches beyond the one that holds it")
        yield kind, content[start + 8 : start + size]
        start += size


def _box(kind: bytes, *content: bytes) -> bytes:
    whole = b"".join(content)
    return struct.pack(">I4s", 8 + len(whole), kind) + whole


def _full_box(kind: bytes, content: bytes) -> bytes:
    """One with version and flags, both 0."""
    return _box(kind, bytes(4), content)


def _marked(kind: bytes, content: bytes, moved: int) -> bytes:
    """A box's content with the marks in it. moved: bytes that pictures are moved by."""
    if kind in _HOLDERS:
        inside = b"".join(_box(one, _marked(one, held, moved)) for one, held in _boxes(content))
        return inside + _box(b"uuid", _UUID, _XML.encode()) if kind == b"trak" else inside
    if kind == b"stsd":
        entries = _boxes(content[8:])
        return content[:8] + b"".join(_box(one, _marked(one, held, 0)) for one, held in entries)
    if kind in _SAMPLE_ENTRIES:
        return content[:_ENTRY_FIELDS] + b"".join(
            _box(one, held) + (_sphere() if one in _CODEC_BOXES else b"")
            for one, held in _boxes(content[_ENTRY_FIELDS:])
        )
    if kind in (b"stco", b"co64"):
        word = ">I" if kind == b"stco" else ">Q"
        places = [place + moved for (place,) in struct.iter_unpack(word, content[8:])]
        return content[:8] + b"".join(struct.pack(word, place) for place in places)
    return content


def _sphere() -> bytes:
    """`st3d`: one eye. `sv3d`: the whole sphere, its middle ahead, nothing cropped."""
    projection = _box(b"proj", _full_box(b"prhd", bytes(12)), _full_box(b"equi", bytes(16)))
    header = _full_box(b"svhd", b"nerfworks\0")
    return _full_box(b"st3d", b"\0") + _box(b"sv3d", header, projection)
