"""Photos as phones and cameras take them, HEIC, raw, AVIF, TIFF: each arrives as it looked."""

from __future__ import annotations

import functools
import io
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import PIL.Image
import pytest
from numpy.typing import NDArray

from pipelines.captures.hdr import hlg_signal
from pipelines.options import IngestOptions
from pipelines.stage import StageContext
from tests.photo_writers import Dng, Heic, dng, heic
from tests.unit.pipelines.captures import icc
from tests.unit.pipelines.captures.archives import nerfstudio_files, phone_exif, picture
from tests.unit.pipelines.captures.ingesting import (
    Files,
    cameras,
    failure,
    ingest,
    sources,
    warning_with,
)
from tests.unit.pipelines.captures.test_photo_choice import scene

TOLERANCE = 4
"""Levels of 255, the mean over a smooth picture: what 4:2:0 at a high rate and JPEG lose."""


@functools.cache
def smooth(seed: int = 0, width: int = 96, height: int = 64) -> NDArray[np.uint8]:
    """A picture of soft colours whose top left quarter is red, [h, w, 3]."""
    rng = np.random.default_rng(seed)
    coarse = PIL.Image.fromarray(rng.integers(30, 200, (4, 6, 3), np.uint8))
    pixels = np.array(coarse.resize((width, height), PIL.Image.Resampling.BICUBIC))
    pixels[: height // 2, : width // 2] = (220, 40, 40)
    return pixels


@functools.cache
def made_heic(seed: int = 0, said: Heic | None = None) -> bytes:
    return heic(smooth(seed), said)


def jpeg(pixels: NDArray[np.uint8], **save: Any) -> bytes:
    stream = io.BytesIO()
    PIL.Image.fromarray(pixels).save(stream, "JPEG", quality=97, subsampling=0, **save)
    return stream.getvalue()


def fillers(count: int = 7) -> Files:
    """Photos that make a capture of one picture."""
    return {f"z{n}.jpg": jpeg(smooth(100 + n)) for n in range(count)}


def first(ctx: StageContext) -> NDArray[np.int64]:
    """The first picture that the stage wrote, [h, w, 3]; it says nothing but its pixels."""
    (path,) = (ctx.out / "images").glob("00001.*")
    with PIL.Image.open(path) as image:
        assert image.mode == "RGB"
        assert not {"exif", "icc_profile", "xmp"} & set(image.info)
        return np.asarray(image).astype(np.int64)


def arrived(tmp_path: Path, name: str, data: bytes) -> NDArray[np.int64]:
    """What becomes of a photo, the first of a capture; nothing is to be told of it."""
    summary, ctx = ingest(tmp_path, {name: data} | fillers())
    assert (summary["kind"], summary["warnings"]) == ("images", [])
    assert sources(ctx)[0] == name
    return first(ctx)


def exif_of(ctx: StageContext, index: int = 0) -> dict[str, Any]:
    record = json.loads((ctx.out / "capture.json").read_text())
    return dict(record["images"][index]["exif"])


def assert_shows(found: NDArray[Any], truth: NDArray[Any], levels: float = TOLERANCE) -> None:
    assert found.shape == truth.shape
    assert np.abs(found.astype(np.int64) - truth.astype(np.int64)).mean() <= levels


# --- HEIC ------------------------------------------------------------------------------------


@pytest.mark.parametrize("turns", [0, 1, 2, 3])
def test_heic_is_turned_once_and_its_lens_is_known(tmp_path: Path, turns: int) -> None:
    """A phone says it twice, for viewers (irot) and in EXIF; it stores pixels on their side."""
    stored = smooth()
    orientation = {0: 1, 1: 8, 2: 3, 3: 6}[turns]
    data = heic(stored, Heic(turns, phone_exif(5.7, 26, orientation)))
    summary, ctx = ingest(tmp_path, {"IMG_1.HEIC": data} | fillers())
    assert summary["warnings"] == []
    assert_shows(first(ctx), np.rot90(stored, turns))
    known = exif_of(ctx)
    assert (known["focal_mm"], known["focal_35mm"], known["model"]) == (5.7, 26.0, "Phone 9")


def test_heic_in_tiles_with_depth_beside_it_is_one_whole_picture(tmp_path: Path) -> None:
    """As iPhones write it: the last tiles reach over the edge, and the whole is turned."""
    stored = smooth(3, 160, 112)
    said = Heic(3, phone_exif(5.7, 26, 6), tile_px=64, depth=True)
    found = arrived(tmp_path, "IMG_1.HEIC", heic(stored, said))
    assert_shows(found, np.rot90(stored, 3))


@pytest.mark.parametrize("kind", [b"Ex\xfff", b"\x80xif"])
def test_heic_with_an_item_of_a_kind_that_is_no_text_is_left_out(
    tmp_path: Path, kind: bytes
) -> None:
    """The library by itself ends the process at such a file."""
    whole = heic(smooth(), Heic(exif=phone_exif(5.7, 26)))
    files = fillers(11)
    files["a.heic"] = whole.replace(b"Exif\0", kind + b"\0", 1)
    summary, ctx = ingest(tmp_path, files)
    assert len(sources(ctx)) == 11
    assert warning_with(summary, '"a.heic" does not decode')


def test_place_and_owner_in_an_heic_stay_out(tmp_path: Path) -> None:
    data = heic(smooth(), Heic(exif=phone_exif(5.7, 26)))
    assert b"SERIAL-4711" in data
    _, ctx = ingest(tmp_path, {"a.heic": data} | fillers())
    kept = (ctx.out / "capture.json").read_bytes() + (ctx.out / "images/00001.jpg").read_bytes()
    assert b"SERIAL" not in kept
    assert b"Ownerson" not in kept


def test_heic_in_display_p3_becomes_srgb(tmp_path: Path) -> None:
    """Once with a profile, as iPhones write it, once with H.273's number."""
    green = (60, 180, 75)
    stored = np.full((64, 96, 3), icc.encoded(green, icc.DISPLAY_P3_XYZ, None), np.uint8)
    stored[:8] = smooth()[:8]
    p3 = icc.rgb_profile(icc.DISPLAY_P3_XYZ, icc.SRGB_GAMMA)
    assert np.abs(stored[40, 40].astype(int) - green).max() > 20
    for n, said in enumerate((Heic(icc=p3), Heic(nclx=(12, 13)))):
        found = arrived(tmp_path / str(n), "a.heic", heic(stored, said))
        assert np.abs(found[40, 40] - green).max() <= 5


def test_heic_of_ten_bits_and_hlg_looks_as_an_sdr_screen_shows_it(tmp_path: Path) -> None:
    """A grey of a fifth of the light that HLG can say: its signal is the SDR screen's."""
    light = np.full((64, 96, 3), 0.2)
    light[:8] *= np.linspace(0.1, 3, 96)[None, :, None]
    signal = hlg_signal(light)
    data = heic(np.round(signal * 65535).astype(np.uint16), Heic(nclx=(9, 18)), ten_bit=True)
    found = arrived(tmp_path, "a.heic", data)
    assert np.abs(found[40, 40] - 255 * signal[40, 40]).max() <= 3


def test_poses_may_list_heic_photos(tmp_path: Path) -> None:
    files = nerfstudio_files(4)
    for n in range(4):
        del files[f"images/{n}.jpg"]
        files[f"images/{n}.heic"] = heic(smooth(n, 64, 48))
    files["transforms.json"] = str(files["transforms.json"]).replace(".jpg", ".heic")
    summary, ctx = ingest(tmp_path, files)
    assert (summary["kind"], summary["num_posed"]) == ("nerfstudio", 4)
    assert sources(ctx) == [f"images/{n}.heic" for n in range(4)]
    assert cameras(ctx).cameras[0].fl_x == 60.0
    assert_shows(first(ctx), smooth(0, 64, 48))


# --- camera raw ------------------------------------------------------------------------------


@pytest.mark.parametrize("thumbnail", [True, False])
@pytest.mark.parametrize("orientation", [1, 3, 6, 8])
def test_dng_has_the_colours_of_the_scene(
    tmp_path: Path, orientation: int, thumbnail: bool
) -> None:
    """A mosaic of the picture's own light: developed, it is the picture, but for edges."""
    said = Dng(orientation=orientation, thumbnail=thumbnail)
    summary, ctx = ingest(tmp_path, {"a.dng": dng(smooth(), said)} | fillers())
    assert summary["warnings"] == []
    turned = np.rot90(smooth(), {1: 0, 3: 2, 6: 3, 8: 1}[orientation])
    assert_shows(first(ctx), turned, levels=2)
    assert (exif_of(ctx)["focal_mm"], exif_of(ctx)["focal_35mm"]) == (5.0, 26.0)


def test_the_same_light_has_the_same_brightness_in_every_raw_photo(tmp_path: Path) -> None:
    """The brightest of one is a quarter of white, of another four fifths, of the last white."""
    files: Files = {}
    for n, brightest in enumerate((128, 230, 255)):
        pixels = np.minimum(smooth(n), 120)
        pixels[40:50, 60:80] = 100
        pixels[4:12, 4:12] = brightest
        files[f"{n}.dng"] = dng(pixels)
    _, ctx = ingest(tmp_path, files | fillers())
    for n in range(3):
        with PIL.Image.open(ctx.out / "images" / f"{n + 1:05d}.jpg") as image:
            patch = np.asarray(image)[42:48, 64:76]
        assert abs(patch.mean() - 100) <= 2


def test_raw_photos_are_brightened_as_their_maker_says(tmp_path: Path) -> None:
    """A phone that exposed by a stop less says so, and shows the same."""
    half = np.full((64, 96, 3), 137, np.uint8)  # half the light of 188 in sRGB
    half[:8] = smooth()[:8] // 2
    found = arrived(tmp_path, "a.dng", dng(half, Dng(stops=1.0)))
    assert np.abs(found[40, 40] - 188).max() <= 2


def test_a_damaged_raw_is_left_out_and_its_thumbnail_taken_for_nothing(tmp_path: Path) -> None:
    whole = dng(smooth())
    others: Files = {f"{n}.dng": dng(smooth(n)) for n in range(1, 10)}
    for n, damaged in enumerate((whole[:1200], whole[:8000])):
        summary, ctx = ingest(tmp_path / str(n), {"0.dng": damaged} | others)
        assert summary["num_images"] == 9
        assert warning_with(summary, '"0.dng" does not decode')
        assert sources(ctx) == [f"{n}.dng" for n in range(1, 10)]


# --- one photo, several files ----------------------------------------------------------------


def test_raw_beside_the_photo_developed_from_it_is_taken_once(tmp_path: Path) -> None:
    files: Files = {}
    for n in range(8):
        files[f"IMG_{n}.JPG"] = jpeg(smooth(n))
        files[f"IMG_{n}.dng"] = dng(smooth(n))
    summary, ctx = ingest(tmp_path, files)
    assert sources(ctx) == [f"IMG_{n}.JPG" for n in range(8)]
    assert warning_with(summary, "8 pictures at the top", "the same photo lies there developed")


@pytest.mark.parametrize("orientation", [1, 6])
@pytest.mark.parametrize("shape", ["16:9", "1:1"])
def test_raw_beside_a_photo_of_another_shape_is_taken_once(
    tmp_path: Path, shape: str, orientation: int
) -> None:
    """A camera set to 16:9 or square; RAF and CR3 tell no time by which they could be told."""
    files: Files = {}
    for n in range(8):
        whole = scene(n, (128, 192))
        middle = whole[10:118] if shape == "16:9" else whole[:, 32:160]
        files[f"DSCF{n:04d}.JPG"] = jpeg(np.rot90(middle, {1: 0, 6: 3}[orientation]))
        files[f"DSCF{n:04d}.RAF"] = dng(whole, Dng(orientation=orientation))
        files[f"DSCF{n + 50:04d}.JPG"] = jpeg(scene(n + 20, (128, 128)))
        files[f"DSCF{n + 50:04d}.RAF"] = dng(scene(n + 40, (128, 192)))
    summary, ctx = ingest(tmp_path, files)
    assert len(sources(ctx)) == 24, "two cameras may number alike"
    assert warning_with(summary, "8 pictures at the top", "the same photo lies there developed")


def test_raw_in_a_folder_of_its_own_is_known_by_what_it_shows(tmp_path: Path) -> None:
    """The phone's own development is brighter; a camera that counts from 1 too has other photos."""
    files: Files = {}
    for n in range(8):
        brighter = np.clip(smooth(n).astype(float) * 1.25 + 10, 0, 255).astype(np.uint8)
        files[f"jpg/{n}.jpg"] = jpeg(brighter[::-1, ::-1], exif=phone_exif(5.0, 26, 3))
        files[f"raw/{n}.dng"] = dng(smooth(n if n else 50))
    _, ctx = ingest(tmp_path, files)
    assert sources(ctx) == [*(f"jpg/{n}.jpg" for n in range(8)), "raw/0.dng"]


def test_live_photos_are_photos_and_their_films_are_told(tmp_path: Path) -> None:
    film = b"\x00\x00\x00\x14ftypqt  " + bytes(400)
    files: Files = {f"IMG_{n}.HEIC": made_heic(n) for n in range(8)}
    files |= {f"IMG_{n}.MOV": film + bytes([n]) for n in range(8)}
    files |= {f"IMG_{n}.JPG": jpeg(smooth(n)) for n in range(3)}
    summary, ctx = ingest(tmp_path, files)
    assert summary["kind"] == "images"
    assert sources(ctx) == [f"IMG_{n}.HEIC" for n in range(8)]
    assert warning_with(summary, "8 videos at the top", "short films that phones take with a photo")
    assert warning_with(summary, "3 pictures at the top", "in another format")


# --- other formats, and what is wrong --------------------------------------------------------


@pytest.mark.parametrize("kind", ["AVIF", "TIFF"])
def test_further_formats_of_photos(tmp_path: Path, kind: str) -> None:
    stream = io.BytesIO()
    save = {"quality": 95} if kind == "AVIF" else {"compression": "tiff_lzw"}
    PIL.Image.fromarray(smooth()).save(stream, kind, exif=phone_exif(5.0, 26, 6), **save)
    found = arrived(tmp_path, f"a.{kind.lower()}", stream.getvalue())
    assert_shows(found, np.rot90(smooth(), 3))


def test_depth_as_tiff_is_no_photo(tmp_path: Path) -> None:
    stream = io.BytesIO()
    PIL.Image.fromarray(np.linspace(0, 5, 64 * 96, dtype=np.float32).reshape(64, 96)).save(
        stream, "TIFF"
    )
    summary, ctx = ingest(tmp_path, {"a.tif": stream.getvalue()} | fillers(8))
    assert sources(ctx) == sorted(fillers(8))
    assert warning_with(summary, "a.tif", "16 bits or more")


@pytest.mark.parametrize("kind", ["heic", "dng"])
def test_photos_of_too_many_pixels_are_refused(tmp_path: Path, kind: str) -> None:
    make = {"heic": lambda n: heic(smooth(n, 192, 128)), "dng": lambda n: dng(smooth(n, 192, 128))}
    files: Files = {f"{n}.{kind}": make[kind](n) for n in range(3)}
    error = failure(tmp_path, files, IngestOptions(max_pixels=10_000))
    assert (error.code, "192x128" in error.message) == ("image_undecodable", True)


@pytest.mark.parametrize(
    "make",
    [
        lambda: heic(smooth(), Heic(size=(8, 8))),
        lambda: heic(smooth(), Heic(size=(16_000, 16_000))),
        lambda: heic(smooth(), Heic(size=(0, 0))),
        lambda: dng(smooth(), Dng(size=(12_000, 12_000))),
        lambda: dng(smooth(), Dng(size=(0, 64))),
        lambda: heic(smooth())[:700],
        lambda: b"\x00\x00\x00\x18ftypheic" + bytes(40),
        lambda: b"\x00\x00\x00\x18ftypcrx " + bytes(40),
        lambda: b"FUJIFILMCCD-RAW 0201FF" + bytes(400),
    ],
    ids=["small", "huge", "empty", "raw-huge", "raw-empty", "cut", "bare", "bare-cr3", "bare-raf"],
)
def test_files_that_lie_or_end_early_are_left_out(
    tmp_path: Path, make: Callable[[], bytes]
) -> None:
    files: Files = {f"{n}.jpg": picture(seed=n) for n in range(11)}
    summary, ctx = ingest(tmp_path, files | {"0.jpg": make()})
    assert len(sources(ctx)) == 10
    assert warning_with(summary, '"0.jpg"')
