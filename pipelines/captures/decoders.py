"""Opening pictures of every format that is read, as Pillow images whose pixels come when asked for.

Formats that Pillow does not know are added to it here: HEIF, which phones take photos in, by
libheif (it turns pictures as the file says, so that their EXIF calls them upright), and camera raw
(`pipelines.captures.raw_photos`). Both only decode. Depth maps and other pictures that lie in a
HEIF file beside its main one are ignored.
"""

from __future__ import annotations

import functools
import io
import struct
import warnings
from pathlib import Path
from typing import BinaryIO

import PIL.Image

from pipelines.captures.heif_items import check_items
from pipelines.captures.raw_photos import FORMAT as RAW
from pipelines.captures.raw_photos import is_camera_raw, register_raw

DAMAGED = (
    OSError,
    SyntaxError,
    ValueError,
    TypeError,
    KeyError,
    IndexError,
    AttributeError,
    OverflowError,
    RuntimeError,
    EOFError,
    struct.error,
    PIL.Image.DecompressionBombError,
)
"""What is raised for a damaged picture, as it is opened or decoded."""

_HEIF_THREADS = 2


def open_picture(source: Path | BinaryIO, kind: str) -> PIL.Image.Image:
    """A picture whose header is read. kind: as `magic.image_format` names it.

    Its `format` is "RAW" for a camera raw, whatever `kind` is. Raises DAMAGED.
    """
    _add_formats()
    if kind == "HEIF":
        data = source.read_bytes() if isinstance(source, Path) else source.read()
        check_items(data)
        source = io.BytesIO(data)
    with warnings.catch_warnings():
        # Of tags that Pillow skips, and of sizes between its limit and twice that.
        warnings.simplefilter("ignore")
        return PIL.Image.open(source, formats=[_format(source, kind)])


def _format(source: Path | BinaryIO, kind: str) -> str:
    """Pillow's name of the format: TIFF is also what most cameras write their raw photos as."""
    if kind != "TIFF":
        return kind
    if isinstance(source, Path):
        with source.open("rb") as file:
            return RAW if is_camera_raw(file) else kind
    return RAW if is_camera_raw(source) else kind


@functools.cache
def _add_formats() -> None:
    """Tell Pillow of the formats that it does not read itself, once a process."""
    import pi_heif

    pi_heif.register_heif_opener(
        decode_threads=_HEIF_THREADS, thumbnails=False, depth_images=False, aux_images=False
    )
    register_raw()
