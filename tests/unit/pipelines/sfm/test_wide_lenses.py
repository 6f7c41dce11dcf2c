"""A fisheye is recognised by how many matches fit it, and by nothing else."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest

from pipelines.sfm.intrinsics import FISHEYE
from pipelines.sfm.wide_lenses import probing_pairs, recognised

WIDTH, HEIGHT = 800, 600


@dataclass
class Counted:
    """Matches that fit as `fits` says of a model and an angle of view across the long side."""

    plain: int
    fisheye: dict[float, int]
    size: tuple[int, int] = (WIDTH, HEIGHT)
    asked: int = 0

    def num_fitting(self, lens: str, focal_px: float | None) -> int:
        self.asked += 1
        if lens != FISHEYE or focal_px is None:
            return self.plain
        angle = math.degrees(WIDTH / focal_px)
        return self.fisheye[min(self.fisheye, key=lambda known: abs(known - angle))]


def test_the_angle_that_most_matches_fit_is_taken() -> None:
    fitting: dict[float, int] = {60: 910, 100: 930, 120: 950, 140: 990, 150: 1000, 160: 985}
    found = recognised(Counted(900, fitting), asked_for=False)
    assert found is not None
    assert found.angle_deg == 150.0
    assert found.focal_px == pytest.approx(WIDTH / math.radians(150))
    assert (found.num_fitting, found.num_plain) == (1000, 900)


@pytest.mark.parametrize(
    ("plain", "fisheye"),
    [
        (1000, {60: 1000, 150: 1010}),  # as much as noise
        (1000, {60: 1200, 80: 1190, 120: 1050, 150: 900}),  # narrow: plain terms describe it
        (10, {60: 10, 150: 150}),  # too few to say anything
    ],
)
def test_plain_lenses_stay_plain(plain: int, fisheye: dict[float, int]) -> None:
    assert recognised(Counted(plain, fisheye), asked_for=False) is None


def test_plain_films_cost_few_looks_and_a_fisheye_that_is_asked_for_is_one() -> None:
    plain = Counted(1000, {60: 1000})
    assert recognised(plain, asked_for=False) is None
    assert plain.asked == 4
    narrow = recognised(Counted(1000, {60: 900, 80: 990, 100: 900}), asked_for=True)
    assert narrow is not None
    assert narrow.angle_deg in (70.0, 80.0, 90.0)


def test_pairs_are_neighbours_spread_over_the_images() -> None:
    pairs = probing_pairs(range(100, 160))
    assert len(pairs) == 8
    assert all(j - i in (2, 4) and 100 <= i < j < 160 for i, j in pairs)
    assert np.ptp([i for i, _ in pairs]) > 40
    assert probing_pairs([0, 1]) == []
    assert probing_pairs([3, 4, 5]) == [(3, 5)]
