"""What is kept of a photo's EXIF, and what is not."""

from __future__ import annotations

import io
import json
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from PIL.TiffImagePlugin import IFDRational

from pipelines.captures.exif import Exif, read_exif
from pipelines.options import IngestOptions
from pipelines.stages import ingest
from tests.unit.pipelines.captures.archives import context, phone_exif, picture, write_zip


def reopened(**save: Any) -> PIL.Image.Image:
    return PIL.Image.open(io.BytesIO(picture(**save)))


def with_detail(**tags: Any) -> PIL.Image.Exif:
    """EXIF with tags of the inner directory, by hexadecimal name such as xA20E."""
    made = PIL.Image.Exif()
    for name, value in tags.items():
        made.get_ifd(0x8769)[int(name[1:], 16)] = value
    return made


def test_lens_orientation_and_time_are_kept() -> None:
    assert read_exif(reopened(exif=phone_exif(5.7, 26, 6))) == Exif(
        make="Maker",
        model="Phone 9",
        lens="back camera 5.7mm",
        focal_mm=5.7,
        focal_35mm=26.0,
        orientation=6,
        taken_at="2024:05:06 07:08:09",
    )


def test_place_owner_and_serial_numbers_never_reach_the_record(tmp_path: Path) -> None:
    ctx = context(tmp_path)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    files = {f"{n}.jpg": picture(seed=n, exif=phone_exif(5.7, 26)) for n in range(8)}
    assert b"SERIAL-4711" in files["0.jpg"]
    write_zip(ctx.workspace.capture_file, files)
    ingest.run(IngestOptions(), ctx)
    text = (ctx.out / "capture.json").read_text("utf-8")
    assert json.loads(text)["images"][0]["exif"] == {
        "make": "Maker",
        "model": "Phone 9",
        "lens": "back camera 5.7mm",
        "focal_mm": 5.7,
        "focal_35mm": 26.0,
        "orientation": 1,
        "taken_at": "2024:05:06 07:08:09",
    }
    for secret in ("SERIAL", "Owner", "48", "46.0"):
        assert secret not in json.dumps(json.loads(text)["images"][0]["exif"])


@pytest.mark.parametrize("kind", ["PNG", "WEBP"])
def test_other_formats_say_it_too(kind: str) -> None:
    assert read_exif(reopened(kind=kind, exif=phone_exif(5.7, 26))).focal_35mm == 26.0


def test_sensor_is_as_long_as_its_pixels_at_their_density() -> None:
    """A camera of 36 mm: 6,000 pixels at 4,233.3 an inch."""
    tags = {"xA002": 6000, "xA003": 4000, "xA20E": IFDRational(6000 * 254, 360), "xA210": 2}
    assert read_exif(reopened(exif=with_detail(**tags))).sensor_mm == pytest.approx(36.0)


def exposure(time_s: Any, f_number: Any, iso: Any, **more: Any) -> float | None:
    tags = {"x829A": time_s, "x829D": f_number, "x8827": iso, **more}
    return read_exif(reopened(exif=with_detail(**tags))).exposure_value


def test_exposure_is_told_as_one_number() -> None:
    """Sunny 16: f/16 for 1/100 s at ISO 100 is 14.6; and a room, f/1.8 for 1/30 s at ISO 400."""
    assert exposure(IFDRational(1, 100), IFDRational(16, 1), 100) == 14.6
    assert exposure(IFDRational(1, 30), IFDRational(18, 10), 400) == 4.6
    # A short time is not rounded away.
    assert exposure(IFDRational(1, 32000), IFDRational(2, 1), 100) == 17.0


def test_how_bright_it_was_is_not_known_of_what_a_flash_lit() -> None:
    by_flash = IFDRational(1, 200), IFDRational(8, 1), 200
    assert exposure(*by_flash, x9209=0x19) is None  # fired, by itself
    assert exposure(*by_flash, x9209=0x18) == 12.6  # did not


@pytest.mark.parametrize(
    ("time_s", "f_number"), [(0.01, 1e300), (1e-310, 2.0), (5e-324, 1e308), (1e300, 2.0)]
)
def test_an_exposure_beyond_all_bounds_takes_nothing_with_it(
    time_s: float, f_number: float
) -> None:
    """Of tags that hold doubles: neither an error, nor a number that JSON does not know."""
    exif = PIL.Image.Exif()
    detail = {0x829A: time_s, 0x829D: f_number, 0x8827: 100, 0x920A: 5.7}
    exif.get_ifd(0x8769).update(detail)
    image = PIL.Image.new("RGB", (8, 8))
    image.getexif = lambda: exif  # type: ignore[method-assign]
    assert read_exif(image) == Exif(focal_mm=5.7)


@pytest.mark.parametrize(
    ("time_s", "f_number", "iso"),
    [
        (IFDRational(0, 1), IFDRational(2, 1), 100),
        (IFDRational(1, 0), IFDRational(2, 1), 100),
        (IFDRational(1, 60), IFDRational(0, 0), 100),
        (IFDRational(1, 60), IFDRational(2, 1), 0),
    ],
)
def test_half_an_exposure_is_none(time_s: Any, f_number: Any, iso: Any) -> None:
    assert exposure(time_s, f_number, iso) is None


@pytest.mark.parametrize(
    "tags",
    [
        {"x920A": IFDRational(0, 0)},
        {"x920A": IFDRational(0, 1)},
        {"xA405": 0},
        {"xA405": 65535},
        {"xA434": "\x00\x01 "},
        {"xA002": 6000, "xA20E": IFDRational(1, 1000)},
        {"xA002": 6000, "xA20E": IFDRational(0, 0)},
    ],
)
def test_values_that_mean_nothing_are_left_out(tags: dict[str, Any]) -> None:
    assert read_exif(reopened(exif=with_detail(**tags))) == Exif()


def test_a_picture_without_exif_says_nothing() -> None:
    assert read_exif(reopened()).as_dict() == {}


@pytest.mark.filterwarnings("ignore::UserWarning")  # Pillow's, on opening
def test_damaged_exif_never_raises() -> None:
    """Every byte of the directory in turn is replaced, and the whole by noise."""
    rng = np.random.default_rng(0)
    whole = picture(exif=phone_exif(5.7, 26))
    start, end = whole.index(b"Exif\0\0") + 6, whole.index(b"SERIAL") + 40
    for position in range(start, end):
        damaged = bytearray(whole)
        damaged[position] = int(rng.integers(256))
        assert json.dumps(read_exif(PIL.Image.open(io.BytesIO(damaged))).as_dict(), allow_nan=False)
    for _ in range(50):
        damaged = bytearray(whole)
        damaged[start + 8 : end] = rng.bytes(end - start - 8)
        read_exif(PIL.Image.open(io.BytesIO(damaged)))
