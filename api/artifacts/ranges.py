"""HTTP's rules for downloads: byte ranges and entity tags. Pure functions.

Source: RFC 9110 sections 13 (conditions) and 14 (ranges).
"""

from __future__ import annotations

import re

from api.problems import BadRangeError

_RANGE = re.compile(r"bytes=(\d*)-(\d*)")
MAX_DIGITS = 19


def etag_of(sha256: str) -> str:
    """The strong entity tag of bytes with this digest."""
    return f'"{sha256}"'


def tag_listed(header: str, etag: str) -> bool:
    """Whether If-None-Match names the tag: weak comparison, `*` names every one."""
    if header.strip() == "*":
        return True
    return etag in {part.strip().removeprefix("W/") for part in header.split(",")}


def parse_range(header: str | None, size: int, if_range: str | None, etag: str) -> range | None:
    """The bytes that a Range header asks for, or None for all of them.

    header: the Range header. size: of the content. if_range: a Range counts only while this is the
    content's entity tag (dates never match: we give none). Several ranges, other units and
    malformed headers are answered with the whole content, as RFC 9110 allows.
    Raises BadRangeError where no byte lies inside.
    """
    if header is None or (if_range is not None and if_range.strip() != etag):
        return None
    match = _RANGE.fullmatch(header.replace(" ", "").lower())
    if match is None or match[1] == match[2] == "" or max(map(len, match.groups())) > MAX_DIGITS:
        return None
    if match[1] == "":
        first, last = max(size - int(match[2]), 0), size - 1
        satisfiable = int(match[2]) > 0 and size > 0
    else:
        first = int(match[1])
        last = min(int(match[2]), size - 1) if match[2] else size - 1
        if match[2] and int(match[2]) < first:
            return None
        satisfiable = first < size
    if not satisfiable:
        raise BadRangeError(
            f"The content has {size} bytes; {header!r} lies outside.",
            headers={"Content-Range": f"bytes */{size}", "Accept-Ranges": "bytes"},
        )
    return range(first, last + 1)
