"""Camera raw photos as Pillow images: DNG, CR2, CR3, NEF, ARW and whatever else LibRaw reads.

All photos of a capture are developed alike: the camera's white balance, its white level as the
brightest value, and no brightness that goes by the picture, so that what has the same light in two
photos has the same colour. A DNG may say by how many stops its maker wants it brighter
(BaselineExposure); phones that expose some photos less than others say so there. Pixels are as the
sensor has them; `getexif` says how to turn them.

Sources: TIFF 6.0; DNG specification 1.7, chapters 4 (tags) and 6 (BaselineExposure).
"""

from __future__ import annotations

import io
import math
import struct
from typing import Any, BinaryIO, cast

import numpy as np
import PIL.Image
import PIL.ImageFile

FORMAT = "RAW"

_NEW_SUBFILE_TYPE, _PHOTOMETRIC, _SUB_IFDS = 254, 262, 330
_DNG_VERSION, _BASELINE_EXPOSURE = 50706, 50730
_ORIENTATION, _EXIF_IFD, _FOCAL_MM = 0x0112, 0x8769, 0x920A
_OF_A_SENSOR = frozenset({32803, 34892})
"""Photometric interpretations: one colour a pixel, and linear values after demosaicing."""
_MOST_ENTRIES = 512
_MOST_SUB_IFDS = 16
_ORIENTATION_OF_FLIP = {0: 1, 3: 3, 5: 8, 6: 6}
"""EXIF's number for LibRaw's."""
_MOST_STOPS = 5.0
_MARGIN_FACTOR = 4
"""How many times the pixels shown a sensor may have; borders are a few in a hundred."""
_MOST_PER_BYTE = 32
"""Pixels of a sensor that a byte can hold: real photos come to one or two."""
_SRGB_GAMMA = (2.4, 12.92)


def is_camera_raw(file: BinaryIO) -> bool:
    """Whether a TIFF holds a camera's raw photo, and not a picture. The position is left at 0.

    Raw photos say DNG, or hold values of a sensor in their first directory or one below it; where
    a thumbnail comes first, the photo is somewhere that only LibRaw knows.
    """
    try:
        file.seek(0)
        head = file.read(16)
        order = {b"II": "<", b"MM": ">"}[head[:2]]
        if head[8:10] == b"CR":
            return True
        first = _directory(file, order, struct.unpack_from(order + "I", head, 4)[0])
        if _DNG_VERSION in first or first.get(_NEW_SUBFILE_TYPE, [0])[0] & 1:
            return True
        below = [
            _directory(file, order, place) for place in first.get(_SUB_IFDS, [])[:_MOST_SUB_IFDS]
        ]
        return any(
            not _OF_A_SENSOR.isdisjoint(directory.get(_PHOTOMETRIC, []))
            for directory in (first, *below)
        )
    except (KeyError, IndexError, struct.error, OSError, ValueError):
        return False
    finally:
        file.seek(0)


def _directory(file: BinaryIO, order: str, place: int) -> dict[int, list[int]]:
    """Tags of a TIFF directory that are SHORT or LONG, or BYTE as DNG's version; no others.

    Raises struct.error for one that is cut off.
    """
    file.seek(place)
    (count,) = struct.unpack(order + "H", file.read(2))
    entries = file.read(12 * min(count, _MOST_ENTRIES))
    found: dict[int, list[int]] = {}
    for start in range(0, len(entries) - 11, 12):
        tag, kind, num = struct.unpack_from(order + "HHI", entries, start)
        letter = {1: "B", 3: "H", 4: "I", 13: "I"}.get(kind)
        if letter is None or not 0 < num <= _MOST_ENTRIES:
            continue
        form = f"{order}{num}{letter}"
        size = struct.calcsize(form)
        if size <= 4:
            data = entries[start + 8 : start + 8 + size]
        else:
            file.seek(struct.unpack_from(order + "I", entries, start + 8)[0])
            data = file.read(size)
        found[tag] = list(struct.unpack(form, data))
    return found


def register_raw() -> None:
    """Tell Pillow how camera raw photos are opened."""
    PIL.Image.register_open(FORMAT, _RawFile, _may_be_raw)


def _may_be_raw(head: bytes) -> bool:
    del head  # who opens with `formats=["RAW"]` has looked
    return True


class _RawFile(PIL.ImageFile.ImageFile):
    """A raw photo, developed when its pixels are asked for; at half its size after `draft`."""

    format = FORMAT
    format_description = "Camera raw photo"
    _close_exclusive_fp_after_loading = True

    def _open(self) -> None:
        import rawpy

        data = cast(BinaryIO, self.fp).read()
        self._raw: rawpy.RawPy | None = rawpy.RawPy()
        try:
            self._raw.open_buffer(io.BytesIO(data))
            sizes = self._raw.sizes
        except rawpy.LibRawError as error:
            raise SyntaxError(f"LibRaw: {error}") from error
        num_raw = sizes.raw_width * sizes.raw_height
        if num_raw > _MARGIN_FACTOR * sizes.width * sizes.height:
            raise SyntaxError("a photo that is a small part of its sensor")
        if num_raw > _MOST_PER_BYTE * len(data):
            raise SyntaxError("fewer bytes than any packing leaves of so many pixels")
        self._size = (sizes.width, sizes.height)
        self._mode = "RGB"
        self._half = False
        self._tags = _exif(data, sizes.flip)
        self._bright = _brightness(self._tags)
        self.tile = []

    def getexif(self) -> PIL.Image.Exif:
        """The photo's EXIF; its orientation is what LibRaw makes of it, as for every format."""
        return self._tags

    def draft(
        self, mode: str | None, size: tuple[int, int] | None
    ) -> tuple[str, tuple[int, int, float, float]] | None:
        """Have it developed at half its size, and fast, where that is no smaller than `size`."""
        del mode
        if size is None or self._raw is None or min(self.size) < 2 * max(size):
            return None
        self._half = True
        return None

    def load(self) -> Any:
        """Develop it. Raises OSError."""
        if self._raw is not None:
            import rawpy

            raw, self._raw = self._raw, None
            try:
                raw.unpack()
                _add_focal_length(self._tags, raw.other.focal_length)
                pixels = raw.postprocess(
                    half_size=self._half,
                    use_camera_wb=True,
                    output_color=rawpy.ColorSpace.sRGB,
                    output_bps=8,
                    gamma=_SRGB_GAMMA,
                    user_flip=0,
                    no_auto_bright=True,
                    bright=self._bright,
                    # By default a photo's own maximum becomes white, where that is near it.
                    adjust_maximum_thr=0.0,
                )
            except rawpy.LibRawError as error:
                raise OSError(f"LibRaw: {error}") from error
            finally:
                raw.close()
            picture = PIL.Image.fromarray(np.ascontiguousarray(pixels))
            self._size = picture.size
            self.im = picture.im
        return super().load()


def _exif(data: bytes, flip: int) -> PIL.Image.Exif:
    """The tags of a raw that is a TIFF, none of others; the orientation is LibRaw's."""
    tags = PIL.Image.Exif()
    try:
        tags.load_from_fp(io.BytesIO(data))
        tags.get_ifd(_EXIF_IFD)
    except (SyntaxError, ValueError, TypeError, KeyError, struct.error, OSError, EOFError):
        tags = PIL.Image.Exif()
    tags[_ORIENTATION] = _ORIENTATION_OF_FLIP.get(flip, 1)
    return tags


def _add_focal_length(tags: PIL.Image.Exif, focal_mm: float) -> None:
    """Add what LibRaw knows once it has read the photo, where the tags do not say it."""
    detail = tags.get_ifd(_EXIF_IFD)
    if _FOCAL_MM not in detail and math.isfinite(focal_mm) and focal_mm > 0:
        detail[_FOCAL_MM] = focal_mm


def _brightness(tags: PIL.Image.Exif) -> float:
    """The factor of light that a DNG asks for, the same for photos that say the same."""
    try:
        stops = float(tags.get(_BASELINE_EXPOSURE, 0.0))
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return 1.0
    return float(2.0**stops) if abs(stops) <= _MOST_STOPS else 1.0
