"""What of a picture lies on no face, filled so that small copies of it are right."""

from __future__ import annotations

import numpy as np

from pipelines.exports.texture.texels import fill


def filled_slowly(picture: np.ndarray, known: np.ndarray) -> np.ndarray:
    """Each texel by itself: the mean of what is known in the smallest block that has any."""
    found = picture.copy()
    for row, column in np.argwhere(~known):
        side = 1
        while True:
            side *= 2
            top, left = row // side * side, column // side * side
            block = np.s_[top : top + side, left : left + side]
            if known[block].any():
                found[row, column] = np.rint(picture[block][known[block]].mean(axis=0))
                break
    return found


def test_unknown_texels_are_as_what_is_known_around_them() -> None:
    random = np.random.default_rng(0)
    for shape in ((64, 32), (37, 21)):
        picture = random.integers(0, 256, (*shape, 3)).astype(np.uint8)
        known = random.random(shape) < 0.02
        wanted = filled_slowly(picture, known)
        fill(picture, known)
        assert np.abs(picture.astype(int) - wanted).max() <= 1


def test_with_nothing_known_all_stays() -> None:
    picture = np.full((8, 8, 3), 7, np.uint8)
    fill(picture, np.zeros((8, 8), bool))
    assert (picture == 7).all()


def test_rows_looked_at_in_parts_make_no_seam() -> None:
    picture = np.zeros((1024, 8, 3), np.uint8)
    known = np.zeros((1024, 8), bool)
    picture[700, 3], known[700, 3] = (10, 20, 30), True
    fill(picture, known)
    assert (picture == [10, 20, 30]).all()
