"""Similarities: recovered exactly from exact points, refused where they are not unique."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.sample.align import path_extent, similarity


def _rotation(seed: int) -> np.ndarray:
    q, _ = np.linalg.qr(np.random.default_rng(seed).normal(size=(3, 3)))
    return np.asarray(q * np.sign(np.linalg.det(q)))


@pytest.mark.parametrize("seed", range(5))
def test_similarity_recovers_a_known_move(seed: int) -> None:
    random = np.random.default_rng(seed)
    source, rotation = random.normal(size=(20, 3)), _rotation(seed)
    shift = random.normal(size=3)
    found = similarity(source, 3.7 * source @ rotation.T + shift)
    assert found.scale == pytest.approx(3.7)
    assert found.rotation == pytest.approx(rotation)
    assert found.translation == pytest.approx(shift)


def test_similarity_never_mirrors() -> None:
    source = np.random.default_rng(0).normal(size=(30, 3))
    found = similarity(source, source * [1.0, 1.0, -1.0])
    assert np.linalg.det(found.rotation) == pytest.approx(1.0)


def test_similarity_of_noisy_points_is_a_least_squares_optimum() -> None:
    random = np.random.default_rng(1)
    source = random.normal(size=(40, 3))
    target = 0.5 * source @ _rotation(2).T + random.normal(size=(40, 3)) * 0.05
    found = similarity(source, target)
    best = ((found.apply_to_points(source) - target) ** 2).sum()
    for scale in (0.99, 1.01):
        moved = scale * (found.apply_to_points(source) - found.translation) + found.translation
        assert ((moved - target) ** 2).sum() > best


def test_points_on_a_line_are_refused() -> None:
    line = np.linspace(0, 1, 10)[:, None] * [1.0, 2.0, 3.0]
    with pytest.raises(ValueError, match="one line"):
        similarity(line, line)
    with pytest.raises(ValueError, match="at least 3"):
        similarity(line[:2], line[:2])


def test_path_extent_is_the_widest_gap() -> None:
    assert path_extent(np.array([[0.0, 0, 0], [3.0, 4.0, 0], [1.0, 0, 0]])) == pytest.approx(5.0)
