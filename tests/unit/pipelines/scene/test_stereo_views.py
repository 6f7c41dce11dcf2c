"""Pictures and sensor depths as stereo wants them, of lenses that bend."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from pipelines.scene.cameras_file import Intrinsics, PosedImage
from pipelines.scene.depth_views import Pinhole
from pipelines.scene.stereo_views import color_view, sensor_depth, stereo_view

LENS = Intrinsics(200, 120, 150.0, 150.0, 101.0, 58.0)
BENT = dataclasses.replace(LENS, model="OPENCV", k1=-0.2, k2=0.03, p1=0.004)
POSE = ((1.0, 0.0, 0.0, 0.0), (0.0, 1.0, 0.0, 0.0), (0.0, 0.0, 1.0, 0.0))


def test_an_image_without_depth_has_none(tmp_path: Path) -> None:
    image = PosedImage("a.png", 0, POSE)
    assert sensor_depth(tmp_path, image, LENS, Pinhole.of(LENS, 100)) is None


@pytest.mark.parametrize("lens", [LENS, BENT], ids=["pinhole", "bent"])
def test_depth_lies_under_the_picture_that_it_belongs_to(tmp_path: Path, lens: Intrinsics) -> None:
    """A picture whose brightness is its depth, both stored as the lens has them."""
    column = (np.arange(200) + 0.5) / 200
    grey = np.tile(np.rint(60 + 120 * column), (120, 1)).astype(np.uint8)
    Image.fromarray(grey).convert("RGB").save(tmp_path / "a.png")
    small = grey.reshape(60, 2, 100, 2).mean(axis=(1, 3)).astype(np.float32) / 255.0
    np.savez_compressed(tmp_path / "a.npz", z=small)
    image = PosedImage("a.png", 0, POSE, depth="a.npz")
    view = stereo_view(tmp_path, image, lens, 200)
    pinhole = Pinhole(200, 120, *view.lens)
    z = sensor_depth(tmp_path, image, lens, pinhole)
    assert z is not None
    known = (view.picture >= 0) & (z > 0)
    assert known.mean() > 0.8
    assert np.abs(z - view.picture)[known].max() < 0.01
    straight = sensor_depth(tmp_path, image, LENS, pinhole)
    assert straight is not None
    if lens is BENT:
        assert np.abs(straight - view.picture)[known].max() > 0.02, "the test sees no bending"


@pytest.mark.parametrize("lens", [LENS, BENT], ids=["pinhole", "bent"])
def test_a_picture_in_colour_is_the_one_in_grey(tmp_path: Path, lens: Intrinsics) -> None:
    """Also in what of it there is: not beyond a bent lens's frame, nor where a mask says no."""
    row, column = np.mgrid[:120, :200]
    grey = (40 + row + column // 2).astype(np.uint8)
    Image.fromarray(grey).convert("RGB").save(tmp_path / "a.png")
    Image.fromarray(np.where(column < 150, 255, 0).astype(np.uint8)).save(tmp_path / "mask.png")
    image = PosedImage("a.png", 0, POSE, mask="mask.png")

    found = color_view(tmp_path, image, lens, 100)

    expected = stereo_view(tmp_path, image, lens, 100)
    assert vars(found.lens) == vars(Pinhole(100, 60, *expected.lens))
    assert np.array_equal(found.usable, expected.picture >= 0.0)
    assert 0.6 < found.usable.mean() < 0.8
    known = found.usable
    assert np.abs(found.picture[known] / 255.0 - expected.picture[known][:, None]).max() < 0.01


def test_a_reduced_picture_is_seen_through_a_smaller_lens(tmp_path: Path) -> None:
    row, column = np.mgrid[:120, :200]
    picture = np.stack([row, column, row + column // 2], axis=-1).astype(np.uint8)
    Image.fromarray(picture).save(tmp_path / "a.png")
    Image.fromarray(np.where(column < 151, 255, 0).astype(np.uint8)).save(tmp_path / "mask.png")
    image = PosedImage("a.png", 0, POSE, mask="mask.png")
    view = color_view(tmp_path, image, LENS, 200)

    half = view.reduced(2)

    assert vars(half.lens) == vars(Pinhole(100, 60, 75.0, 75.0, 50.5, 29.0))
    assert np.abs(half.picture - picture[::2, ::2] - 0.5).max() <= 1.0
    assert np.array_equal(half.usable, np.mgrid[:60, :100][1] < 75)
    assert view.reduced(1) is view


@pytest.mark.parametrize("lengths", [(0.29, 0.29), (0.47, 0.31)], ids=["120 degrees", "tall"])
def test_a_plain_lens_that_is_too_wide_shows_what_it_says(
    tmp_path: Path, lengths: tuple[float, float]
) -> None:
    """Stereo's is zoomed, and so must be the picture: its brightness is the ray's slope."""
    width, height = 800, 600
    lens = Intrinsics(width, height, width * lengths[0], width * lengths[1], 400.0, 300.0)
    slope = (np.arange(width) + 0.5 - lens.cx) / lens.fl_x
    grey = np.tile(np.rint(128 + 60 * slope).astype(np.uint8), (height, 1))
    Image.fromarray(grey).convert("RGB").save(tmp_path / "a.png")
    image = PosedImage("a.png", 0, POSE)
    view = stereo_view(tmp_path, image, lens, 320)
    x, _ = view.rays()
    known = view.picture[120] >= 0
    shown = (255 * view.picture[120] - 128) / 60
    assert known.mean() > 0.95
    assert np.abs(shown - x)[known].max() < 0.03
    colored = color_view(tmp_path, image, lens, 320)
    assert np.abs(colored.picture[120, known, 0] / 255.0 - view.picture[120, known]).max() < 0.01
