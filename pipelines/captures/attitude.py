"""Which way is up in a photo, as far as the device that took it has measured that.

Phones have an accelerometer, drones a gimbal: an iPhone writes what the first felt into its maker's
note, DJI's drones write the angles of the second into the picture's XMP. Where all cameras look the
same way, straight down above all, nothing else tells a floor from a wall.

Directions are in the axes of the picture as people see it: +X right, +Y up, +Z out of the picture
towards who took it.

Sources: ExifTool, "Apple Tags" (AccelerationVector); DJI's XMP (GimbalPitchDegree: 0 looks at the
horizon, -90 straight down).
"""

from __future__ import annotations

import math
import re
import struct

Direction = tuple[float, float, float]

_APPLE = b"Apple iOS\0"
_FIRST_ENTRY, _ENTRY = 16, 12
"""Bytes before the first entry of Apple's directory, which follows TIFF, and of an entry."""
_FELT, _SIGNED_RATIONAL = 8, 10
_MOST_OFF_G = 0.25
"""How far from 1 g the felt acceleration may be: a phone that is swung feels more."""
_ANGLE = rb"drone-dji:Gimbal%sDegree(?:\s*=\s*[\"']|>)\s*([-+]?\d{1,3}(?:\.\d*)?)\s*[\"'<]"
_PITCH, _ROLL = (re.compile(_ANGLE % name) for name in (b"Pitch", b"Roll"))
_MOST_ROLL_DEG = 30.0
"""A gimbal that is rolled further holds the camera on its side, and what is up is not known."""
_MOST_UPSIDE_DOWN = 0.3
"""Cameras turn pictures upright: one that is this far upside down was turned by a program since."""
VIEWED = {
    3: ((-1.0, 0.0), (0.0, -1.0)),
    6: ((0.0, -1.0), (1.0, 0.0)),
    8: ((0.0, 1.0), (-1.0, 0.0)),
}
"""By EXIF orientation (3, 6, 8): columns are the viewed picture's X and Y axis in those of the
stored one, X right and Y up."""
_AS_STORED = ((1.0, 0.0), (0.0, 1.0))


def measured_up(
    note: object, xmp: object, *, orientation: int, is_wide: bool, lens: str | None
) -> Direction | None:
    """The direction away from gravity, unit; None where nothing usable was measured.

    note: EXIF's maker's note. xmp: the picture's. orientation: EXIF's, of the pixels as the camera
    stored them. is_wide: whether those are wider than high. lens: its name, which tells a phone's
    front camera.
    """
    up = None
    # A phone's sensor is wide: a high picture was turned by a program, and nobody knows which way.
    if isinstance(note, bytes) and is_wide and "front" not in (lens or "").lower():
        up = _felt(note)
    if up is None and isinstance(xmp, bytes):
        up = _of_gimbal(xmp)
    axes = _AS_STORED if orientation == 1 else VIEWED.get(orientation)
    if up is None or axes is None:
        return None
    (xx, yx), (xy, yy) = axes
    turned = (xx * up[0] + xy * up[1], yx * up[0] + yy * up[1], up[2])
    length = math.hypot(*turned)
    if turned[1] < -_MOST_UPSIDE_DOWN * length:
        return None
    return turned[0] / length, turned[1] / length, turned[2] / length


def _felt(note: bytes) -> Direction | None:
    """Up in the pixels as an iPhone's back camera stores them, by its accelerometer.

    It tells gravity in g along the device's right, top and screen. Its sensor lies on its side: the
    stored picture's top is at the device's right, its right at the device's bottom.
    """
    if not note.startswith(_APPLE) or note[12:14] not in (b"MM", b"II"):
        return None
    order = ">" if note[12:14] == b"MM" else "<"
    try:
        (num,) = struct.unpack_from(f"{order}H", note, 14)
        for index in range(num):
            place = _FIRST_ENTRY + _ENTRY * index
            tag, kind, count, offset = struct.unpack_from(f"{order}HHII", note, place)
            if (tag, kind, count) != (_FELT, _SIGNED_RATIONAL, 3):
                continue
            parts = struct.unpack_from(f"{order}6i", note, offset)
            right, top, screen = (parts[k] / parts[k + 1] for k in (0, 2, 4))
            if abs(math.hypot(right, top, screen) - 1.0) > _MOST_OFF_G:
                return None
            return top, -right, -screen
    except (struct.error, ZeroDivisionError):
        return None
    return None


def _of_gimbal(xmp: bytes) -> Direction | None:
    """Up in the pixels of a DJI drone's camera."""
    found = _PITCH.search(xmp)
    if found is None:
        return None
    rolled = _ROLL.search(xmp)
    pitch, roll = math.radians(float(found[1])), 0.0 if rolled is None else float(rolled[1])
    if abs(pitch) > math.pi / 2 + 0.05 or abs(roll) > _MOST_ROLL_DEG:
        return None
    level = math.cos(pitch)
    return (
        -level * math.sin(math.radians(roll)),
        level * math.cos(math.radians(roll)),
        -math.sin(pitch),
    )
