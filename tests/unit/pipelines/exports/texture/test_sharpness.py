"""How sharp a photo is, whatever it shows."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, uniform_filter1d

from pipelines.exports.texture.photos import sharpness

Picture = NDArray[np.float32]


def pattern(height: int = 300, width: int = 400, seed: int = 0) -> Picture:
    """Overlapping rectangles of any size and grey, and edges about a pixel wide."""
    rng = np.random.default_rng(seed)
    picture = np.full((height, width), 128.0)
    for _ in range(400):
        y, x = rng.integers(0, height), rng.integers(0, width)
        side = np.exp(rng.uniform(np.log(6.0), np.log(80.0), 2)).astype(int)
        picture[y : y + side[0], x : x + side[1]] = rng.uniform(20.0, 235.0)
    return np.asarray(gaussian_filter(picture, 0.6), np.float32)


@pytest.mark.parametrize("axis", [0, 1])
def test_a_shaken_picture_is_less_sharp_whichever_way_it_was_shaken(axis: int) -> None:
    picture = pattern()
    shaken = [sharpness(uniform_filter1d(picture, px, axis=axis)) for px in (4, 8, 16)]
    assert shaken[0] < 0.9 * sharpness(picture)
    assert shaken[1] < 0.75 * sharpness(picture)
    assert shaken[2] < shaken[1]


def test_a_defocused_picture_is_less_sharp_the_more_it_is() -> None:
    found = [sharpness(gaussian_filter(pattern(), sigma)) for sigma in (0.1, 1.0, 2.0, 4.0)]
    assert found == sorted(found, reverse=True)
    assert found[2] < 0.75 * found[0]


def test_what_a_picture_shows_and_how_much_of_it_says_nothing() -> None:
    picture = pattern()
    usual = sharpness(picture)
    faint = 200.0 + 0.15 * (picture - 128.0)
    plain = np.full((900, 1200), 128.0, np.float32)
    plain[300:600, 400:800] = picture
    for other in (faint, plain, picture[:150, :200], pattern(seed=1)):
        assert sharpness(np.asarray(other, np.float32)) == pytest.approx(usual, rel=0.1)


def test_noise_makes_nothing_sharp() -> None:
    blurred = gaussian_filter(pattern(), 2.0)
    noise = np.random.default_rng(1).normal(scale=4.0, size=blurred.shape)
    noisy = np.asarray(blurred + noise, np.float32)
    assert sharpness(noisy) == pytest.approx(sharpness(blurred), rel=0.1)


@pytest.mark.parametrize("size", [(300, 400), (4, 400), (1, 1)])
def test_a_picture_of_one_colour_has_no_edge_that_is_not_sharp(size: tuple[int, int]) -> None:
    assert sharpness(np.full(size, 90.0, np.float32)) == 1.0
