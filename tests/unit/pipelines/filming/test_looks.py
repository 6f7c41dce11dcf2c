"""Blur and light of pictures whose blur and light are known."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image, ImageFilter

from pipelines.filming.looks import BLURRED_PX, Look, look_at, measure


def picture(seed: int = 0) -> np.ndarray:
    """[640 x 480] of edges at all scales: overlapping rectangles of many sizes."""
    rng = np.random.default_rng(seed)
    canvas = np.full((480, 640), 120.0)
    for size in np.geomspace(300, 6, 900):
        row, column = rng.integers(-50, 480), rng.integers(-50, 640)
        height, width = size * rng.uniform(0.5, 1.5, 2)
        top, left = max(row, 0), max(column, 0)
        canvas[top : int(row + height), left : int(column + width)] = rng.integers(20, 235)
    return canvas


def smeared(canvas: np.ndarray, px: int, *, down: bool = False) -> np.ndarray:
    shifts = [np.roll(canvas, (step if down else 0, step), (0, 1)) for step in range(px)]
    return np.mean(shifts, axis=0)


def look_of(canvas: np.ndarray, noise: float = 0.0) -> Look:
    noisy = canvas + np.random.default_rng(1).normal(0, noise, canvas.shape)
    return measure(np.clip(noisy, 0, 255).astype(np.uint8))


def width_of(look: Look) -> float:
    assert look.blur_px is not None
    return look.blur_px


@pytest.mark.parametrize("noise", [0.0, 3.0])
@pytest.mark.parametrize("down", [False, True])
def test_motion_blur_is_measured_and_has_a_direction(noise: float, down: bool) -> None:
    found = [look_of(smeared(picture(), px, down=down), noise) for px in (1, 12, 20, 32)]
    widths = [width_of(look) for look in found]
    assert widths == sorted(widths)
    assert widths[0] < 2.0
    assert [look.is_blurred for look in found] == [False, True, True, True]
    assert 8.0 < widths[3] < 32.0
    assert all(look.streak > 1.4 for look in found[1:])


def test_defocus_has_no_direction() -> None:
    round_blur = Image.fromarray(picture().astype(np.uint8)).filter(ImageFilter.GaussianBlur(5))
    look = measure(np.asarray(round_blur))
    assert width_of(look) > 2 * BLURRED_PX
    assert look.streak < 1.3


@pytest.mark.parametrize("seed", [1, 2, 3])
def test_sharp_pictures_of_whatever_content_are_not_blurred(seed: int) -> None:
    assert width_of(look_of(picture(seed))) < 2.0


def test_little_contrast_is_no_blur() -> None:
    assert width_of(look_of(120 + 0.3 * (picture() - 120))) < 2.0


def test_a_plain_wall_has_no_blur_to_speak_of() -> None:
    wall = np.full((480, 640), 150.0) + np.linspace(0, 30, 640)
    look = look_of(wall, noise=1.0)
    assert look.blur_px is None
    assert not look.is_blurred
    assert look.luma == pytest.approx(165 / 255, abs=0.01)


def test_light_is_measured() -> None:
    half = np.zeros((480, 640))
    half[:, 320:] = 255
    look = look_of(half)
    assert (look.dark, look.bright) == (0.5, 0.5)


def test_a_large_file_is_looked_at_small(tmp_path: Path) -> None:
    large = Image.fromarray(picture().astype(np.uint8)).resize((2560, 1920))
    large.save(tmp_path / "a.jpg", quality=92)
    look, shown = look_at(tmp_path / "a.jpg")
    assert shown.size == (640, 480)
    assert width_of(look) < 2.2
    (tmp_path / "b.jpg").write_bytes(b"no picture")
    with pytest.raises(OSError, match="cannot identify"):
        look_at(tmp_path / "b.jpg")


def cut_out(ground: int) -> np.ndarray:
    """A subject in the middle of a ground that somebody filled in."""
    canvas = np.full((480, 640), float(ground))
    canvas[120:400, 60:560] = picture()[120:400, 60:560]
    return canvas


@pytest.mark.parametrize("ground", [0, 255])
def test_a_ground_around_a_cut_out_subject_is_neither_dark_nor_burnt_out(ground: int) -> None:
    look = look_of(cut_out(ground))
    assert max(look.bright, look.dark) < 0.05
    assert look.luma > 0.3


def test_a_subject_that_is_burnt_out_is_so_on_white_as_well() -> None:
    canvas = cut_out(255)
    canvas[200:320, 100:520] = 255
    assert look_of(canvas).bright > 0.3


def test_a_burnt_out_sky_and_a_black_film_stay_what_they_are() -> None:
    sky = picture()
    sky[:230] = 255
    assert look_of(sky).bright > 0.4
    night = np.zeros((480, 640))
    night[230:240, 300:310] = 90
    assert look_of(night).dark > 0.9
    assert look_of(night).luma < 0.01
