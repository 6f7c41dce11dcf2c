"""Pictures in one light: levelling undoes an exposure, and no half sees itself."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.nerf.data.images import load_images
from pipelines.nerf.data.light import (
    exposed,
    gain_between,
    in_the_light_of,
    is_measurable,
    levelled,
    light_table,
)

BENDS = (0.0, 0.5, 0.9, 1.0)
ALL = np.ones((40, 60), np.bool_)


def picture(seed: int = 0) -> np.ndarray:
    """[40, 60, 3] in [0.05, 0.95]."""
    return np.random.default_rng(seed).uniform(0.05, 0.95, (40, 60, 3))


@pytest.mark.parametrize("bend", BENDS)
def test_a_gain_of_one_changes_nothing(bend: float) -> None:
    assert (light_table((1.0, 1.0, 1.0, bend)) == np.arange(256)[:, None]).all()


@pytest.mark.parametrize("bend", BENDS)
def test_levelling_undoes_an_exposure(bend: float) -> None:
    scene, gain = picture(), (1.3, 0.8, 1.1)
    photo = exposed(scene, gain, bend)
    told = is_measurable(photo) & (photo.max(axis=-1) < 0.9)
    back = levelled(np.rint(255 * photo).astype(np.uint8), (*gain, bend)) / 255.0
    assert told.mean() > 0.3
    assert np.abs(back - scene)[told].max() < 0.01


def test_gains_of_a_straight_curve_are_factors_and_an_s_keeps_black_and_white() -> None:
    assert exposed(np.array([0.25, 0.5]), 1.5, 0.0) == pytest.approx([0.375, 0.75])
    assert exposed(np.array([0.0, 0.5, 1.0]), 3.0, 1.0) == pytest.approx([0.0, 0.75, 1.0])


@pytest.mark.parametrize("bend", BENDS)
def test_what_was_too_bright_for_the_camera_stays_white(bend: float) -> None:
    table = light_table((2.0, 1.0, 0.5, bend))
    assert (table[255] == 255).all()
    assert (np.diff(table.astype(int), axis=0) >= 0).all(), "brighter became darker"


@pytest.mark.parametrize("bend", BENDS)
def test_the_gain_between_two_pictures_is_that_of_most_of_their_pixels(bend: float) -> None:
    scene, gain = picture(), np.array([1.2, 0.9, 1.05])
    photo = exposed(scene, gain, bend)
    photo[:, :15] = picture(1)[:, :15]  # a passer-by
    assert gain_between(scene, photo, ALL, bend) == pytest.approx(gain, rel=0.03)
    masked = ALL.copy()
    masked[:, :15] = False
    assert gain_between(scene, photo, masked, bend) == pytest.approx(gain, rel=1e-6)


def test_too_few_pixels_tell_no_gain() -> None:
    few = np.zeros_like(ALL)
    few[0, :20] = True
    assert (gain_between(picture(), 0.5 * picture(), few, 0.0) == 1.0).all()
    assert (gain_between(np.ones((40, 60, 3)), picture(), ALL, 0.0) == 1.0).all()


def test_each_half_has_the_light_of_the_other() -> None:
    """Squares of a chess board, 16 along the long side."""
    scene, photo = np.full((40, 64, 3), 0.4), np.full((40, 64, 3), 0.5)
    row, column = np.mgrid[0:40, 0:64] // 4
    black = (row + column) % 2 == 1
    photo[black] = 0.3
    shown = in_the_light_of(scene, photo, np.ones((40, 64), np.bool_), 0.0)
    assert shown[~black] == pytest.approx(0.3)
    assert shown[black] == pytest.approx(0.5)


def test_what_shines_on_one_side_makes_no_seam() -> None:
    """A glare on a third of the photo that the scene does not have, and no change of exposure."""
    scene = 0.6 * picture()
    photo = scene.copy()
    photo[:, 40:] = np.minimum(1.3 * photo[:, 40:], 1.0)
    shown = in_the_light_of(scene, photo, ALL, 0.0)
    assert np.abs(shown - scene).max() < 0.01


def test_a_window_is_white_in_the_light_of_a_dark_photo_too() -> None:
    scene = picture()
    scene[:, :, :] *= 0.8
    scene[5:15] = 1.0
    photo = 0.7 * scene
    photo[5:15] = 1.0
    shown = in_the_light_of(scene, photo, ALL, 0.0)
    assert np.abs(shown - photo).max() < 0.01


def test_images_are_levelled_as_they_are_loaded(tmp_path: Path) -> None:
    light = (1.25, 1.0, 0.8, 0.5)
    stored = np.rint(255 * picture()).astype(np.uint8)
    for name in ("a.png", "b.png"):
        Image.fromarray(stored).save(tmp_path / name)
    data = load_images([tmp_path / "a.png", tmp_path / "b.png"], 60, lights=[light, None])
    assert (data.image(0).numpy() * 255).round().astype(int).tolist() == levelled(
        stored, light
    ).tolist()
    assert (data.image(1).numpy() * 255).round().astype(int).tolist() == stored.tolist()
