"""Which way was up, from what an iPhone and a drone write into their photos."""

from __future__ import annotations

import io
import math
import struct
from typing import Any

import numpy as np
import PIL.Image
import pytest

from pipelines.captures.exif import read_exif

_DOWN_20 = (math.cos(math.radians(20)), math.sin(math.radians(20)))


def apple_note(gravity: tuple[float, float, float], order: str = ">") -> bytes:
    """A maker's note as iPhones write it. gravity: in g, along the phone's right, top, screen."""
    entries = [(1, 9, 1, 14), (8, 10, 3, 16 + 12 * 2 + 4)]
    note = b"Apple iOS\0\0\1" + (b"MM" if order == ">" else b"II")
    note += struct.pack(f"{order}H", len(entries))
    for entry in entries:
        note += struct.pack(f"{order}HHII", *entry)
    note += bytes(4)
    return note + b"".join(struct.pack(f"{order}ii", round(v * 10**6), 10**6) for v in gravity)


def photo(
    size: tuple[int, int] = (64, 48),
    orientation: int | None = 1,
    note: bytes | None = None,
    lens: str = "iPhone 12 back camera 4.2mm f/1.6",
    xmp: bytes | None = None,
) -> PIL.Image.Image:
    """A JPEG, opened."""
    tags = PIL.Image.Exif()
    detail = tags.get_ifd(0x8769)
    detail[0xA434] = lens
    if note is not None:
        detail[0x927C] = note
    if orientation is not None:
        tags[0x0112] = orientation
    file = io.BytesIO()
    more: dict[str, Any] = {} if xmp is None else {"xmp": xmp}
    PIL.Image.new("RGB", size).save(file, "JPEG", exif=tags, **more)
    return PIL.Image.open(file)


def drone_xmp(pitch: str, roll: str = "+0.00", *, as_elements: bool = False) -> bytes:
    """What DJI's drones write."""
    angles = {"GimbalRollDegree": roll, "GimbalYawDegree": "+45.00", "GimbalPitchDegree": pitch}
    if as_elements:
        inner = "".join(f"<drone-dji:{name}>{v}</drone-dji:{name}>" for name, v in angles.items())
        return f"<rdf:Description>{inner}</rdf:Description>".encode()
    inner = " ".join(f'drone-dji:{name}="{value}"' for name, value in angles.items())
    return f"<rdf:Description {inner}/>".encode()


def assert_up(image: PIL.Image.Image, expected: tuple[float, float, float]) -> None:
    """Which way the photo says was up."""
    found = read_exif(image).up
    assert found is not None
    np.testing.assert_allclose(np.array(found), np.array(expected), atol=1e-4)


@pytest.mark.parametrize("order", [">", "<"])
@pytest.mark.parametrize(
    ("held", "orientation"),
    [
        ((0.0, -1.0), 6),  # upright
        ((-1.0, 0.0), 1),  # on its left side, as its sensor lies
        ((1.0, 0.0), 3),  # on its right side
        ((0.0, 1.0), 8),  # upside down
    ],
)
def test_a_phone_that_looks_down_a_little_knows_up_however_it_is_held(
    held: tuple[float, float], orientation: int, order: str
) -> None:
    level, down = _DOWN_20
    note = apple_note((held[0] * level, held[1] * level, -down), order)
    assert_up(photo(orientation=orientation, note=note), (0.0, level, down))


@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_a_phone_above_a_table_looks_straight_down(orientation: int) -> None:
    found = read_exif(photo(orientation=orientation, note=apple_note((0.02, -0.03, -0.99)))).up
    assert found is not None
    assert found[2] > 0.999


def test_a_rolled_phone_leans() -> None:
    """Its left side is down, and its top a little, clockwise for who looks at the picture."""
    note = apple_note((-math.cos(0.2), -math.sin(0.2), 0.0))
    assert_up(photo(note=note), (-math.sin(0.2), math.cos(0.2), 0.0))


def test_pictures_that_were_turned_by_their_reader_are_turned_once() -> None:
    """As libheif does it: pixels are upright, EXIF says so, and what it said before is told."""
    level, down = _DOWN_20
    image = photo(size=(48, 64), orientation=1, note=apple_note((0.0, -level, -down)))
    assert read_exif(image).up is None, "a program turned it, nobody knows which way"
    image.info["original_orientation"] = 6
    assert_up(image, (0.0, level, down))


@pytest.mark.parametrize(
    "more",
    [
        {"lens": "iPhone 12 front camera 2.7mm f/2.2"},
        {"note": apple_note((-0.5, 0.0, -0.2))},  # swung, or fallen
        {"note": apple_note((1.0, 0.0, 0.0))},  # upside down
        {"note": apple_note((-1.0, 0.0, 0.0))[:40]},
        {"note": b"Apple iOS\0\0\1MM\xff\xff"},
        {"note": b"Samsung" + bytes(100)},
        {"orientation": 5},  # mirrored
    ],
)
def test_what_cannot_be_trusted_is_left_out(more: dict[str, Any]) -> None:
    given = {"note": apple_note((-1.0, 0.0, 0.0)), **more}
    assert read_exif(photo(**given)).up is None


@pytest.mark.parametrize("as_elements", [False, True])
@pytest.mark.parametrize(
    ("pitch", "roll", "up"),
    [
        ("-90.00", "+0.00", (0.0, 0.0, 1.0)),
        ("+0.00", "+0.00", (0.0, 1.0, 0.0)),
        ("-45.00", "-0.00", (0.0, math.sqrt(0.5), math.sqrt(0.5))),
        ("+0.00", "+10.00", (-math.sin(math.radians(10)), math.cos(math.radians(10)), 0.0)),
    ],
)
def test_a_drones_gimbal_tells(
    pitch: str, roll: str, up: tuple[float, float, float], *, as_elements: bool
) -> None:
    assert_up(photo(xmp=drone_xmp(pitch, roll, as_elements=as_elements)), up)


@pytest.mark.parametrize(
    "xmp",
    [drone_xmp("-900.00"), drone_xmp("-45.00", "+90.00"), drone_xmp("down"), b"\0<x", b""],
)
def test_a_gimbal_that_makes_no_sense_tells_nothing(xmp: bytes) -> None:
    assert read_exif(photo(xmp=xmp)).up is None


def test_it_reaches_the_record_as_plain_numbers() -> None:
    assert read_exif(photo(xmp=drone_xmp("-90.00"))).as_dict()["up"] == (0.0, 0.0, 1.0)
