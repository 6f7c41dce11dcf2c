"""What a photo's EXIF says of its lens: kept as data, while the picture itself loses all metadata.

Kept, in `capture.json`: what tells lenses apart and gives their focal length (make, model, lens,
focal lengths, width of the sensor), how the stored pixels were turned, which way was up, as far as
the device had measured that, how bright it was, and when the photo was taken by the camera's clock.
Poses need the first for one camera model a lens and a focal length to start from, the search for
the sky how bright it was. Everything else is dropped, above all what says where a photo was taken
or by whose device: GPS, serial numbers, owner, thumbnails, the rest of the maker's notes. Numbers
that no lens has are left out.
"""

from __future__ import annotations

import math
import struct
import warnings
from dataclasses import asdict, dataclass
from typing import Any

import PIL.Image

from pipelines.captures.attitude import Direction, measured_up

# Tags of the Exif 2.32 standard.
_MAKE, _MODEL, _ORIENTATION, _EXIF_IFD = 0x010F, 0x0110, 0x0112, 0x8769
_TAKEN_AT, _FOCAL_MM, _FOCAL_35MM, _LENS = 0x9003, 0x920A, 0xA405, 0xA434
_MAKERS_NOTE = 0x927C
_MOST_EXPOSURE = 30.0
"""Of stars and of the sun, to either side."""
_EXPOSURE_S, _F_NUMBER, _ISO, _FLASH = 0x829A, 0x829D, 0x8827, 0x9209
_PIXELS_X, _PIXELS_Y = 0xA002, 0xA003
_PLANE_X, _PLANE_Y, _PLANE_UNIT = 0xA20E, 0xA20F, 0xA210
_ON_ITS_SIDE = 5
"""The first of EXIF's orientations in which a picture is stored on its side."""
_UNIT_MM = {2: 25.4, 3: 10.0, 4: 1.0, 5: 0.001}
_MOST_LETTERS = 64
_MALFORMED = (SyntaxError, ValueError, TypeError, KeyError, struct.error, OSError, EOFError)


@dataclass(frozen=True)
class Exif:
    """What is kept of one photo's EXIF; None where it says nothing usable.

    focal_mm: of the lens. focal_35mm: that of a 36 x 24 mm camera with the same angle of view
    along the diagonal. sensor_mm: long side of the sensor that the picture covers.
    orientation: 1 to 8, of the pixels as sent. taken_at: "YYYY:MM:DD HH:MM:SS", the camera's clock.
    up: the direction away from gravity, unit, as in `pipelines.captures.attitude`.
    exposure_value: at ISO 100, log2(N^2 / t) - log2(S / 100) for f-number N, time t in seconds, and
    speed S: 12 to 16 outdoors by day, 3 to 8 in rooms, more where the sun shines in. None where a
    flash was the light.
    """

    make: str | None = None
    model: str | None = None
    lens: str | None = None
    focal_mm: float | None = None
    focal_35mm: float | None = None
    sensor_mm: float | None = None
    orientation: int | None = None
    taken_at: str | None = None
    up: Direction | None = None
    exposure_value: float | None = None

    def as_dict(self) -> dict[str, Any]:
        """What is known, as plain JSON."""
        return {key: value for key, value in asdict(self).items() if value is not None}


def read_exif(image: PIL.Image.Image) -> Exif:
    """What is kept of an opened picture's EXIF; nothing where there is none or it is malformed."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of tags that Pillow skips
            tags = image.getexif()
            detail = tags.get_ifd(_EXIF_IFD)
        orientation = tags.get(_ORIENTATION)
        if orientation not in range(1, 9):
            orientation = None
        lens = _text(detail.get(_LENS))
        up = _up(image, detail.get(_MAKERS_NOTE), orientation, lens)
        return Exif(
            make=_text(tags.get(_MAKE)),
            model=_text(tags.get(_MODEL)),
            lens=lens,
            focal_mm=_length(detail.get(_FOCAL_MM)),
            focal_35mm=_length(detail.get(_FOCAL_35MM)),
            sensor_mm=_sensor(detail),
            orientation=orientation,
            taken_at=_text(detail.get(_TAKEN_AT)),
            up=up,
            exposure_value=_exposure_value(detail),
        )
    except _MALFORMED:
        return Exif()


def _up(
    image: PIL.Image.Image, note: object, orientation: int | None, lens: str | None
) -> Direction | None:
    """The direction away from gravity in the upright picture, to four digits, or None."""
    # libheif has turned its pictures already, and their EXIF calls them upright.
    turned = image.info.get("original_orientation")
    width, height = image.size
    if turned is not None and turned >= _ON_ITS_SIDE:
        width, height = height, width
    up = measured_up(
        note,
        image.info.get("xmp"),
        orientation=turned or orientation or 1,
        is_wide=width > height,
        lens=lens,
    )
    return None if up is None else (round(up[0], 4), round(up[1], 4), round(up[2], 4))


def _text(value: Any) -> str | None:
    """A short printable text, or None."""
    if not isinstance(value, str):
        return None
    kept = "".join(letter for letter in value if letter.isprintable()).strip()
    return kept[:_MOST_LETTERS] or None


def _positive(value: Any) -> float | None:
    """A finite number above 0, or None: 0 and 0/0 mean "not known"."""
    try:
        number = float(value)
    except (TypeError, ValueError, ZeroDivisionError, OverflowError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def _number(value: Any) -> float | None:
    """The same to four digits after the point."""
    number = _positive(value)
    return None if number is None else round(number, 4)


def _length(value: Any) -> float | None:
    """A focal length in millimetres that a lens can have, or None."""
    length = _number(value)
    return length if length is not None and 0.5 <= length <= 5000 else None


def _exposure_value(detail: Any) -> float | None:
    """At ISO 100, to a tenth, or None where a part of it is not known, or a flash fired."""
    flash = detail.get(_FLASH)
    if isinstance(flash, int) and flash & 1:
        return None
    speed = detail.get(_ISO)
    speed = speed[0] if isinstance(speed, tuple) and speed else speed
    time_s, f_number, iso = map(_positive, (detail.get(_EXPOSURE_S), detail.get(_F_NUMBER), speed))
    if time_s is None or f_number is None or iso is None:
        return None
    # Sums of logarithms: the numbers may be as large and small as floats are.
    value = 2.0 * math.log2(f_number) - math.log2(time_s) - math.log2(iso) + math.log2(100.0)
    return round(value, 1) if abs(value) <= _MOST_EXPOSURE else None


def _sensor(detail: Any) -> float | None:
    """Long side of the sensor in millimetres, from its pixels and their density; or None."""
    unit = _UNIT_MM.get(detail.get(_PLANE_UNIT, 2))
    sides = [
        pixels / density * unit
        for pixels, density in (
            (_number(detail.get(_PIXELS_X)), _number(detail.get(_PLANE_X))),
            (_number(detail.get(_PIXELS_Y)), _number(detail.get(_PLANE_Y))),
        )
        if pixels is not None and density is not None and unit is not None
    ]
    longest = max(sides, default=0.0)
    return round(longest, 4) if 1.0 <= longest <= 200.0 else None
