"""Pictures between their pixels, against the formula of bilinear interpolation."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.scene.picture_sampling import between_pixels


@pytest.mark.parametrize("shape", [(7, 5, 3), (1, 4, 1), (3, 1, 2), (540, 961, 3)])
def test_values_are_those_of_the_four_pixels_around(shape: tuple[int, int, int]) -> None:
    generator = np.random.default_rng(4)
    picture = generator.random(shape, dtype=np.float32)
    height, width, _ = shape
    u, v = generator.uniform(-1.0, width + 1.0, 300), generator.uniform(-1.0, height + 1.0, 300)
    found = between_pixels(picture, u, v)
    for index in range(300):
        x, y = np.clip(u[index] - 0.5, 0, width - 1), np.clip(v[index] - 0.5, 0, height - 1)
        i, j = int(x), int(y)
        right, below = min(i + 1, width - 1), min(j + 1, height - 1)
        top = picture[j, i] + (x - i) * (picture[j, right] - picture[j, i])
        bottom = picture[below, i] + (x - i) * (picture[below, right] - picture[below, i])
        assert found[index] == pytest.approx(top + (y - j) * (bottom - top), abs=2e-4)


def test_pixel_centres_give_the_pixels_and_nothing_asked_gives_nothing() -> None:
    picture = np.arange(24, dtype=np.float32).reshape(4, 3, 2)
    rows, columns = np.divmod(np.arange(12), 3)
    found = between_pixels(picture, columns + 0.5, rows + 0.5)
    assert found == pytest.approx(picture.reshape(12, 2), abs=1e-5)
    assert between_pixels(picture, np.zeros(0), np.zeros(0)).shape == (0, 2)
