"""Whether what an HEIF file calls its items is text, before the reader of it looks at them.

pi-heif 1.4 ends the process where the kind of an item of metadata is not UTF-8. Sources: ISO
14496-12, boxes `meta`, `iinf` and `infe`.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator


def check_items(data: bytes) -> None:
    """Raise SyntaxError where an item's kind, name or type of content is no text."""
    try:
        for kind, meta in _boxes(data):
            for inner, info in _boxes(meta[4:]) if kind == b"meta" else ():
                if inner == b"iinf" and info:
                    _check_entries(info[6 if info[0] == 0 else 8 :])
    except (struct.error, ValueError) as error:
        raise SyntaxError("its items are broken") from error


def _check_entries(entries: bytes) -> None:
    """Raise ValueError for an entry whose words are no text: all that is behind its numbers."""
    for kind, body in _boxes(entries):
        if kind == b"infe" and body:
            body[{2: 8, 3: 10}.get(body[0], 8) :].decode("utf-8")


def _boxes(data: bytes) -> Iterator[tuple[bytes, bytes]]:
    """Kind and content of the boxes that follow each other; one that is cut off is the last."""
    place = 0
    while place + 8 <= len(data):
        size, kind = struct.unpack_from(">I4s", data, place)
        head = 8
        if size == 1:
            (size,) = struct.unpack_from(">Q", data, place + 8)
            head = 16
        size = size or len(data) - place
        if size < head:
            raise ValueError("a box smaller than its head")
        yield kind, data[place + head : place + size]
        place += size
