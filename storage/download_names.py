"""The name that a download gets, from the API and from signed URLs of an object store alike.

Source: RFC 6266 (Content-Disposition).
"""

from __future__ import annotations

import re
from urllib.parse import quote


def content_disposition(name: str) -> str:
    """`attachment` with a file name that no header parser can be fooled by.

    The plain form holds safe ASCII only; the extended form the whole name in UTF-8.
    """
    name = "".join(c for c in name if c.isprintable()).replace("\\", "/").rsplit("/", 1)[-1]
    name = name.strip(" .") or "download"
    plain = re.sub(r"[^A-Za-z0-9 ._()+-]", "_", name)
    extended = quote(name.encode("utf-8", "replace"), safe="")
    return f"attachment; filename=\"{plain}\"; filename*=UTF-8''{extended}"
