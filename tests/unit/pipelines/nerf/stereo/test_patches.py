"""Patches of even brightness, and bands of them that only shading divides."""

from __future__ import annotations

import numpy as np

from pipelines.nerf.stereo.patches import even_patches, patches_of


def lit_wall() -> np.ndarray:
    """[200, 300], a blank wall in 8 bits that a lamp beyond its upper left corner shines on."""
    row, column = np.mgrid[:200, :300]
    away = np.hypot((column + 60) / 300, (row + 40) / 200)
    picture: np.ndarray = np.rint(255 * (0.95 - 0.12 * away)).astype(np.float32) / np.float32(255)
    return picture


def test_bands_of_one_wall_are_one_patch() -> None:
    assert patches_of(lit_wall()).max() > 5
    assert even_patches(lit_wall()).max() == 0


def test_corners_and_the_floor_are_other_patches() -> None:
    picture = lit_wall()
    picture[:, 200:] -= 0.1
    picture[150:] = np.random.default_rng(0).uniform(0.0, 0.15, (50, 300))
    patches = even_patches(picture)
    wall, other = patches[20, 100], patches[20, 280]
    assert wall != other
    assert (patches[5:140, 5:190] == wall).all()
    assert (patches[5:140, 210:290] == other).all()
    assert not np.isin(patches[155:], [wall, other]).any()
    assert sorted(np.unique(patches)) == list(range(patches.max() + 1))


def test_a_picture_of_one_brightness_is_one_patch() -> None:
    assert even_patches(np.full((40, 60), 0.5, np.float32)).max() == 0
