"""Zip files that are the same bytes whenever the same content is written."""

from __future__ import annotations

import zipfile

_EPOCH = (1980, 1, 1, 0, 0, 0)


def entry(name: str, compressed: bool = True) -> zipfile.ZipInfo:
    """A file of an archive, at a fixed time."""
    info = zipfile.ZipInfo(name, _EPOCH)
    info.compress_type = zipfile.ZIP_DEFLATED if compressed else zipfile.ZIP_STORED
    info.external_attr = 0o644 << 16
    return info
