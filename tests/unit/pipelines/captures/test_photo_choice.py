"""Nothing that is no photo becomes one, and photos are not taken for anything else."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import PIL.Image
import pytest
from numpy.typing import NDArray

from pipelines.captures.roles import file_role, folder_role, plain_stem
from tests.unit.pipelines.captures.archives import picture
from tests.unit.pipelines.captures.ingesting import (
    Files,
    failure,
    ingest,
    sources,
    warning_with,
)

SIZE = (120, 160)


def scene(seed: int, size: tuple[int, int] = SIZE) -> NDArray[np.uint8]:
    """A colourful picture with structure at all sizes, as photos have. [H, W, 3]"""
    rng = np.random.default_rng(seed)
    layers = [
        PIL.Image.fromarray(rng.integers(0, 256, (n, n, 3), np.uint8)).resize(size[::-1], 3)
        for n in (3, 6, 12)
    ]
    mean = np.mean([np.asarray(layer, np.float64) for layer in layers], axis=0)
    return np.clip(mean + rng.normal(0, 3, mean.shape), 0, 255).astype(np.uint8)


def encoded(pixels: NDArray[np.generic], kind: str = "PNG", mode: str | None = None) -> bytes:
    stream = io.BytesIO()
    image = PIL.Image.fromarray(pixels)
    (image.convert(mode) if mode else image).save(stream, kind)
    return stream.getvalue()


def reduced(pixels: NDArray[np.uint8], factor: int, kind: str = "JPEG") -> bytes:
    image = PIL.Image.fromarray(pixels)
    stream = io.BytesIO()
    image.resize((image.width // factor, image.height // factor), 4).save(stream, kind)
    return stream.getvalue()


def disc() -> NDArray[np.uint8]:
    """A mask: 255 in a disc, 0 around it. [H, W]"""
    rows, columns = np.mgrid[: SIZE[0], : SIZE[1]]
    return (((rows - 60) ** 2 + (columns - 80) ** 2 < 2000) * 255).astype(np.uint8)


def depth(seed: int) -> NDArray[np.uint16]:
    """Millimetres, with noise. [H, W]"""
    return (1500 + np.random.default_rng(seed).normal(0, 400, SIZE)).astype(np.uint16)


def photos(count: int = 9, folder: str = "images/", stem: str = "") -> Files:
    return {f"{folder}{stem}{n}.jpg": encoded(scene(n), "JPEG") for n in range(count)}


def taken(tmp_path: Path, files: Files, *words: str) -> list[str]:
    """What became photos, and that a warning says so of the others."""
    summary, ctx = ingest(tmp_path, files)
    assert summary["kind"] == "images"
    if words:
        assert warning_with(summary, *words)
    else:
        assert summary["warnings"] == []
    return sources(ctx)


# --- by content: the folders and names say nothing ------------------------------------------


def test_depth_maps_are_known_by_their_16_bits(tmp_path: Path) -> None:
    files = photos() | {f"x/{n}.png": encoded(depth(n)) for n in range(9)}
    assert taken(tmp_path, files, "9 pictures in x/", "16 bits") == list(photos())


def test_one_channel_beside_colour_is_no_photo(tmp_path: Path) -> None:
    noisy: Files = {f"x/{n}.png": encoded(scene(n), mode="L") for n in range(9)}
    assert taken(tmp_path, photos() | noisy, "9 pictures in x/", "one channel") == list(photos())


@pytest.mark.parametrize("kind", ["PNG", "JPEG", "WEBP"])
@pytest.mark.parametrize("mode", ["RGB", "L", "P"])
def test_masks_are_known_by_their_two_values(tmp_path: Path, kind: str, mode: str) -> None:
    if mode == "P" and kind != "PNG":
        mode = "RGB"
    suffix = kind.lower()
    files = photos() | {
        f"x/m{n}.{suffix}": encoded(np.roll(disc(), n, 0), kind, mode) for n in range(9)
    }
    assert taken(tmp_path, files, "9 pictures in x/") == list(photos())


def test_label_maps_are_known_by_their_few_colours(tmp_path: Path) -> None:
    colors = np.array([(200, 30, 40), (20, 90, 220), (90, 200, 60), (250, 220, 10)], np.uint8)
    labels: Files = {
        f"x/{n}.png": encoded(colors[np.roll(np.arange(160) // 40, n)][None].repeat(120, 0))
        for n in range(9)
    }
    assert taken(tmp_path, photos() | labels, "9 pictures in x/", "colours") == list(photos())


@pytest.mark.parametrize("factor", [2, 4, 8])
@pytest.mark.parametrize("kind", ["JPEG", "PNG"])
def test_reduced_copies_are_known_by_what_they_show(tmp_path: Path, factor: int, kind: str) -> None:
    suffix = "jpg" if kind == "JPEG" else "png"
    files = photos() | {f"a/{n}.{suffix}": reduced(scene(n), factor, kind) for n in range(9)}
    assert taken(tmp_path, files, "9 pictures in a/", "copy") == list(photos())


def test_copies_in_several_sizes_leave_the_largest(tmp_path: Path) -> None:
    files = photos()
    for factor in (2, 4):
        files |= {f"images_{factor}/{n}.jpg": reduced(scene(n), factor) for n in range(9)}
    assert taken(tmp_path, files, "images_2/", "images_4/") == list(photos())


def test_the_same_bytes_twice_are_one_photo(tmp_path: Path) -> None:
    files = photos() | {f"backup/copy of {n}.jpg": data for n, data in enumerate(photos().values())}
    kept = taken(tmp_path, files, "9 pictures", "again")
    assert len(kept) == 9


def test_only_masks_and_depth_are_no_capture(tmp_path: Path) -> None:
    files: Files = {f"depth_{n}.png": encoded(depth(n)) for n in range(9)}
    files |= {f"m{n}.png": encoded(np.roll(disc(), n, 0)) for n in range(9)}
    error = failure(tmp_path, files)
    assert error.code == "no_images"
    assert "18 pictures, and none of them is a photo" in error.message
    assert "16 bits" in error.message


# --- by name: pictures of many colours ------------------------------------------------------


@pytest.mark.parametrize("folder", ["masks", "Mask", "depth", "scan/confidence", "x_normals"])
def test_folders_beside_photos_speak(tmp_path: Path, folder: str) -> None:
    colored: Files = {f"{folder}/{n}.jpg": encoded(scene(50 + n), "JPEG") for n in range(9)}
    assert taken(tmp_path, photos() | colored, f"9 pictures in {folder}/") == list(photos())


def test_names_beside_a_photo_of_the_same_name_speak(tmp_path: Path) -> None:
    shots = photos(folder="", stem="IMG_")
    colored: Files = {f"IMG_{n}_mask.jpg": encoded(scene(50 + n), "JPEG") for n in range(9)}
    assert taken(tmp_path, shots | colored, "9 pictures", "named as masks") == list(shots)


def test_flat_export_with_a_word_before_the_number(tmp_path: Path) -> None:
    files: Files = {f"frame_{n:05d}.jpg": encoded(scene(n), "JPEG") for n in range(9)}
    shots = list(files)
    files |= {f"depth_{n:05d}.jpg": encoded(scene(50 + n), "JPEG") for n in range(9)}
    files |= {f"conf_{n:05d}.png": encoded(scene(70 + n)) for n in range(9)}
    summary, ctx = ingest(tmp_path, files)
    assert sources(ctx) == shots
    assert warning_with(summary, "depth maps")
    assert warning_with(summary, "confidence maps")


def test_words_are_found_in_names() -> None:
    assert folder_role("a/Depth Maps/x.png") == "depth maps"
    assert folder_role("unmasked/maskerade/x.png") is None
    assert file_role("a/IMG_1.mask.png") == "masks"
    assert file_role("confirmed.jpg") is None
    assert plain_stem("m/IMG_1_mask.jpg.PNG") == plain_stem("p/img-1.JPG") == "img1"


# --- photos that look like something else ---------------------------------------------------


def test_who_films_a_mask_keeps_the_photos(tmp_path: Path) -> None:
    shots = photos(folder="mask/", stem="mask_")
    assert taken(tmp_path, shots) == list(shots)


def test_grey_photos_alone_are_photos(tmp_path: Path) -> None:
    shots: Files = {f"{n}.png": encoded(scene(n), mode="L") for n in range(9)}
    assert taken(tmp_path, shots) == list(shots)


def test_grey_jpegs_among_colour_are_photos(tmp_path: Path) -> None:
    shots = photos() | {"images/9.jpg": encoded(scene(9), "JPEG", "L")}
    assert taken(tmp_path, shots) == list(shots)


def test_two_cameras_that_count_alike_keep_all_photos(tmp_path: Path) -> None:
    """Equal names and shapes, one camera smaller, other views."""
    shots = photos(folder="left/")
    shots |= {f"right/{n}.jpg": reduced(scene(100 + n), 2) for n in range(9)}
    assert taken(tmp_path, shots) == list(shots)


def test_a_rig_of_close_cameras_keeps_all_photos(tmp_path: Path) -> None:
    """The right eye sees the scene a twentieth of the picture aside."""
    wide = [scene(n, (120, 168)) for n in range(9)]
    shots: Files = {f"left/{n}.jpg": encoded(wide[n][:, :160], "JPEG") for n in range(9)}
    shots |= {f"right/{n}.jpg": encoded(wide[n][:, 8:], "JPEG") for n in range(9)}
    assert taken(tmp_path, shots) == list(shots)


def test_small_object_on_a_white_table_is_a_photo(tmp_path: Path) -> None:
    shots: Files = {}
    for n in range(9):
        pixels = np.full((480, 640, 3), 253, np.uint8)
        pixels[200:260, 40 * n : 40 * n + 60] = scene(n, (60, 60))
        shots[f"{n}.jpg"] = encoded(pixels, "JPEG")
    assert taken(tmp_path, shots) == list(shots)


def test_small_renders_with_a_clear_background_are_photos(tmp_path: Path) -> None:
    shots: Files = {}
    for n in range(9):
        pixels = np.zeros((120, 160, 4), np.uint8)
        pixels[40:80, 50:110, :3] = scene(n, (40, 60))
        pixels[40:80, 50:110, 3] = 255
        shots[f"r_{n}.png"] = encoded(pixels)
    assert taken(tmp_path, shots) == list(shots)


def test_a_damaged_picture_is_still_reported_as_that(tmp_path: Path) -> None:
    files = photos(12) | {"images/5.jpg": picture()[:300], "depth/1.png": encoded(depth(1))}
    summary, ctx = ingest(tmp_path, files)
    assert len(sources(ctx)) == 11
    assert warning_with(summary, "Left out", "images/5.jpg")


# --- copies under other names -----------------------------------------------------------------


def fine_scene(
    seed: int, shift: float = 0.0, size: tuple[int, int] = (480, 640)
) -> PIL.Image.Image:
    """A photo with details, filmed from a camera that has moved by so many pixels."""
    rng = np.random.default_rng(seed)
    moved = 0.75 * shift / size[1]
    layers = [
        PIL.Image.fromarray(rng.integers(0, 256, (n, n, 3), np.uint8)).resize(
            size[::-1], 3, box=(moved * n, 0, (moved + 0.75) * n, n)
        )
        for n in (8, 24, 60)
    ]
    mean = np.mean([np.asarray(layer, np.float64) for layer in layers], axis=0)
    return PIL.Image.fromarray(np.clip(mean, 0, 255).astype(np.uint8))


def sent(image: PIL.Image.Image, long_side: int = 480, taken_at: str = "", **save: int) -> bytes:
    """A photo as a messenger sends it: reduced, and packed harder."""
    exif = PIL.Image.Exif()
    if taken_at:
        exif.get_ifd(0x8769)[0x9003] = taken_at
    scale = long_side / max(image.size)
    stream = io.BytesIO()
    image.resize((round(image.width * scale), round(image.height * scale)), 1).save(
        stream, "JPEG", exif=exif, **{"quality": 75, **save}
    )
    return stream.getvalue()


def originals(count: int = 8, timed: bool = False) -> Files:
    return {
        f"IMG_{n:04d}.jpg": sent(
            fine_scene(n), 640, f"2024:05:06 07:08:{n:02d}" if timed else "", quality=92
        )
        for n in range(count)
    }


@pytest.mark.parametrize("timed", [True, False])
def test_what_a_messenger_sent_is_no_second_photo(tmp_path: Path, timed: bool) -> None:
    files = originals(timed=timed)
    files |= {f"IMG-20240506-WA{n + 40:04d}.jpg": sent(fine_scene(n)) for n in range(8)}
    kept = taken(tmp_path, files, "8 pictures", "copy of another photo")
    assert kept == list(originals())


def test_edited_photos_are_no_second_ones(tmp_path: Path) -> None:
    files = originals()
    for n in range(8):
        brighter = fine_scene(n).point([min(round(1.2 * value), 255) for value in range(256)] * 3)
        files[f"IMG_{n:04d}-edited.jpg"] = sent(brighter)
    assert taken(tmp_path, files, "8 pictures", "edited") == list(originals())


@pytest.mark.parametrize("moved_px", [0.5, 2.0, 20.0])
def test_neighbours_of_a_slow_film_are_no_copies(tmp_path: Path, moved_px: float) -> None:
    files: Files = {
        f"f{n}.jpg": sent(fine_scene(1, n * moved_px), 640, quality=90) for n in range(8)
    }
    assert taken(tmp_path, files) == list(files)


def test_photos_taken_at_other_times_are_no_copies(tmp_path: Path) -> None:
    """A camera on a tripod takes the same picture; only who has no time is compared."""
    files: Files = {
        f"t{n}.jpg": sent(fine_scene(1), 640, f"2024:05:06 07:08:{n:02d}", quality=90 - n)
        for n in range(8)
    }
    assert taken(tmp_path, files) == list(files)


def test_two_phones_that_number_alike_keep_their_photos(tmp_path: Path) -> None:
    files = originals()
    for n in range(8):
        stream = io.BytesIO()
        fine_scene(50 + n, size=(360, 480)).save(stream, "AVIF", quality=80)
        files[f"IMG_{n:04d}.avif"] = stream.getvalue()
    assert sorted(taken(tmp_path, files)) == sorted(files)


def test_a_photo_in_two_formats_is_one(tmp_path: Path) -> None:
    files = originals()
    for n in range(8):
        stream = io.BytesIO()
        fine_scene(n).resize((320, 240)).save(stream, "AVIF", quality=80)
        files[f"IMG_{n:04d}.avif"] = stream.getvalue()
    kept = taken(tmp_path, files, "8 pictures", "another format")
    assert kept == list(originals())
