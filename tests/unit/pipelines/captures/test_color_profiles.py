"""Whatever colour space a picture is in, it arrives in sRGB with the colours that were seen."""

from __future__ import annotations

import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from PIL import ImageCms

from pipelines.options import IngestOptions
from pipelines.stage import StageContext
from pipelines.stages import ingest
from tests.unit.pipelines.captures import icc
from tests.unit.pipelines.captures.archives import (
    context,
    nerfstudio_files,
    phone_exif,
    picture,
    write_zip,
)

GREEN = (60, 180, 75)
P3 = icc.rgb_profile(icc.DISPLAY_P3_XYZ, icc.SRGB_GAMMA)
ADOBE = icc.rgb_profile(icc.ADOBE_RGB_XYZ, 563 / 256)


def plain(mode: str, color: Any, kind: str = "JPEG", seed: int = 0, **save: Any) -> bytes:
    """One colour, below a strip of noise that makes a photo of it, encoded."""
    stream = io.BytesIO()
    if kind == "JPEG":
        save = {"quality": 98, "subsampling": 0, **save}
    image = PIL.Image.new(mode, (64, 48), color)
    noise = np.random.default_rng(seed).bytes(64 * 8 * len(mode))
    image.paste(PIL.Image.frombytes(mode, (64, 8), noise))
    image.save(stream, kind, **save)
    return stream.getvalue()


def ingested(root: Path, files: Mapping[str, bytes | str]) -> tuple[StageContext, list[str]]:
    """The stage's context, and its warnings."""
    ctx = context(root)
    ctx.workspace.capture_file.parent.mkdir(parents=True)
    write_zip(ctx.workspace.capture_file, files)
    return ctx, list(ingest.run(IngestOptions(), ctx)["warnings"])


def first_color(tmp_path: Path, data: bytes, name: str = "0.jpg") -> tuple[list[int], list[str]]:
    """The middle pixel of a picture that went through `ingest`, and the warnings."""
    others = {f"{n}.jpg": picture(seed=n) for n in range(1, 8)}
    ctx, warnings = ingested(tmp_path, {name: data, **others})
    (path,) = (ctx.out / "images").glob("00001.*")
    with PIL.Image.open(path) as image:
        assert image.mode == "RGB"
        assert not image.info.get("icc_profile")
        return list(image.getpixel((32, 24))), warnings  # type: ignore[arg-type]


def assert_close(color: list[int], truth: tuple[int, ...], levels: int = 3) -> None:
    assert np.abs(np.array(color) - truth).max() <= levels, color


@pytest.mark.parametrize("kind", ["JPEG", "PNG", "WEBP"])
@pytest.mark.parametrize(
    ("columns", "gamma", "profile"),
    [(icc.DISPLAY_P3_XYZ, icc.SRGB_GAMMA, P3), (icc.ADOBE_RGB_XYZ, 563 / 256, ADOBE)],
    ids=["Display P3", "Adobe RGB"],
)
def test_wide_gamut_photos_become_srgb(
    tmp_path: Path, kind: str, columns: Any, gamma: float | None, profile: bytes
) -> None:
    stored = icc.encoded(GREEN, columns, gamma)
    assert np.abs(np.array(stored) - GREEN).max() > 20
    lossless = {"lossless": True} if kind == "WEBP" else {}
    data = plain("RGB", stored, kind, icc_profile=profile, **lossless)
    color, warnings = first_color(tmp_path, data, f"0.{kind.lower()}")
    # Near the edge of sRGB one level of red in Adobe RGB is 5 in sRGB, and JPEG rounds by one.
    assert_close(color, GREEN, levels=5 if (kind, profile) == ("JPEG", ADOBE) else 3)
    assert not warnings


def test_a_turned_photo_is_converted_too(tmp_path: Path) -> None:
    stored = icc.encoded(GREEN, icc.DISPLAY_P3_XYZ, None)
    data = plain("RGB", stored, icc_profile=P3, exif=phone_exif(5.7, 26, 6))
    color, _ = first_color(tmp_path, data)
    assert_close(color, GREEN)


def test_posed_pictures_are_converted(tmp_path: Path) -> None:
    files = nerfstudio_files(4)
    stored = icc.encoded(GREEN, icc.DISPLAY_P3_XYZ, None)
    files |= {f"images/{n}.jpg": plain("RGB", stored, icc_profile=P3) for n in range(4)}
    ctx, _ = ingested(tmp_path, files)
    with PIL.Image.open(ctx.out / "images" / "00001.jpg") as image:
        assert_close(list(image.getpixel((32, 24))), GREEN)  # type: ignore[arg-type]


def test_grey_photos_follow_their_own_curve(tmp_path: Path) -> None:
    """Half the light: 128 under gamma 1, 188 in sRGB."""
    data = plain("L", 128, icc_profile=icc.gray_profile(1.0))
    color, warnings = first_color(tmp_path, data)
    assert_close(color, (188, 188, 188))
    assert not warnings


def test_deep_grey_pictures_follow_their_own_curve(tmp_path: Path) -> None:
    stream = io.BytesIO()
    deep = PIL.Image.fromarray(np.full((48, 64), 128 * 257, np.uint16))
    deep.save(stream, "PNG", icc_profile=icc.gray_profile(1.0))
    ctx, _ = ingested(tmp_path, nerfstudio_files(4) | {"images/0.jpg": stream.getvalue()})
    with PIL.Image.open(ctx.out / "images" / "00001.png") as image:
        assert_close(list(image.getpixel((32, 24))), (188, 188, 188))  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("amounts", "truth"), [((255, 0, 0, 0), (20, 120, 200)), ((0, 255, 0, 0), (200, 30, 110))]
)
def test_print_pictures_get_the_colours_of_their_inks(
    tmp_path: Path, amounts: tuple[int, ...], truth: tuple[int, ...]
) -> None:
    inks = {"C": (20, 120, 200), "M": (200, 30, 110), "Y": (240, 220, 20), "K": (0, 0, 0)}
    profile = icc.cmyk_profile(inks)  # type: ignore[arg-type]
    color, warnings = first_color(tmp_path, plain("CMYK", amounts, icc_profile=profile))
    assert_close(color, truth, levels=6)  # the profile's own table has steps of 1 in Lab
    assert not warnings


def test_transparency_is_kept_apart_from_the_colours(tmp_path: Path) -> None:
    """Half transparent over white."""
    stored = icc.encoded(GREEN, icc.DISPLAY_P3_XYZ, None)
    data = plain("RGBA", (*stored, 128), "PNG", icc_profile=P3)
    color, _ = first_color(tmp_path, data, "0.png")
    assert_close(color, tuple((value * 128 + 255 * 127) // 255 for value in GREEN))


@pytest.mark.parametrize("name", ["sRGB of lcms", "sRGB by its primaries"])
def test_pixels_that_are_srgb_already_stay_as_they_are(tmp_path: Path, name: str) -> None:
    profile = (
        ImageCms.ImageCmsProfile(ImageCms.createProfile("sRGB")).tobytes()
        if name == "sRGB of lcms"
        else icc.rgb_profile(icc.SRGB_XYZ, icc.SRGB_GAMMA)
    )
    pixels = np.random.default_rng(0).integers(0, 256, (48, 64, 3), np.uint8)
    stream = io.BytesIO()
    PIL.Image.fromarray(pixels).save(stream, "PNG", icc_profile=profile)
    others = {f"{n}.jpg": picture(seed=n) for n in range(1, 8)}
    ctx, warnings = ingested(tmp_path, {"0.png": stream.getvalue(), **others})
    with PIL.Image.open(ctx.out / "images" / "00001.png") as image:
        np.testing.assert_array_equal(np.asarray(image), pixels)
    assert not warnings


@pytest.mark.parametrize(
    "profile",
    [b"no profile at all", P3[:200], P3[:128] + b"\xff" * 400, icc.gray_profile(1.8)],
    ids=["text", "cut off", "noise", "for grey"],
)
def test_an_unusable_profile_is_told_and_the_pixels_are_taken_as_srgb(
    tmp_path: Path, profile: bytes
) -> None:
    color, warnings = first_color(tmp_path, plain("RGB", GREEN, icc_profile=profile))
    assert_close(color, GREEN)
    (warning,) = warnings
    assert '"0.jpg"' in warning
    assert "sRGB" in warning


def test_many_unusable_profiles_give_one_warning(tmp_path: Path) -> None:
    files = {f"{n}.jpg": plain("RGB", GREEN, seed=n, icc_profile=b"broken") for n in range(8)}
    _, (warning,) = ingested(tmp_path, files)
    assert '"0.jpg" and 7 more' in warning
