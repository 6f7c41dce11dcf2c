"""A model of a thing that looks the same from two sides, where nothing leads from side to side."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.sfm.folds import suspected_folds
from pipelines.sfm.mending import Mapping, Sides, mended
from pipelines.sfm.report import Attempt, Outcome, path_warnings
from pipelines.sfm.rungs import RUNGS
from pipelines.sfm.source import Source
from pipelines.sfm.tears import PairSet
from pipelines.tools.colmap_results import PairStatistics, SparseModel
from tests.unit.pipelines.sfm.test_tears import (
    NUM,
    Floats,
    Matches,
    folded,
    model_of,
    seen_from,
    true_poses,
)

HALF = NUM // 2
PLACED = tuple(i for i in range(NUM) if 3 <= i % HALF < HALF - 3)
"""Of a way around a thing, without what lies between its front and its back: 18 of each."""
Counts = dict[tuple[int, int], int]


def of_two_sides(alike: int = 20, usual: int = 150) -> tuple[Matches, Counts]:
    """What pairs share, some of it and how many there are: neighbours much, background and all;
    pictures of opposite sides a little that looks the same on both."""
    rng = np.random.default_rng(5)
    poses, half = true_poses(), np.diag([-1.0, -1.0, 1.0])
    matches: Matches = {}
    counts: Counts = {}
    for i in range(NUM):
        for j in range(i + 1, NUM):
            apart = min(j - i, NUM - j + i)
            opposite = abs(j - i - HALF)
            angles = np.arctan2(poses[i, 1, 3], poses[i, 0, 3]) + rng.uniform(-0.4, 0.4, 40)
            points = np.stack(
                [0.4 * np.cos(angles), 0.4 * np.sin(angles), rng.uniform(0, 1, 40)], axis=1
            )
            if apart <= 6:
                matches[i, j] = seen_from(poses[i], points), seen_from(poses[j], points)
                counts[i, j] = round(usual / apart)
            elif opposite <= 3:
                matches[i, j] = seen_from(poses[i], points), seen_from(poses[j], points @ half.T)
                counts[i, j] = alike
    return matches, counts


def placed(poses: Floats, images: tuple[int, ...] = PLACED) -> SparseModel:
    """A model with points on the thing that they go around."""
    angles = np.linspace(0.0, 2.0 * np.pi, 200)
    points = np.stack([0.4 * np.cos(angles), 0.4 * np.sin(angles), angles / 7.0], axis=1)
    return replace(model_of(poses[list(images)], images), points=points)


def across(counts: Counts, images: tuple[int, ...] = PLACED) -> PairSet:
    """The pairs of a front and a back."""
    return frozenset(
        (i, j) for i, j in counts if i in images and j in images and (i < HALF) != (j < HALF)
    )


def test_sides_that_lie_over_each_other_are_told_by_what_should_match() -> None:
    matches, counts = of_two_sides()
    assert suspected_folds(placed(folded(true_poses())), matches, counts) == [across(counts)]


def test_a_model_that_is_right_is_not_suspected() -> None:
    """All round; two sides with nothing between them; and one side, photographed twice over."""
    matches, counts = of_two_sides()
    assert suspected_folds(placed(true_poses(), tuple(range(NUM))), matches, counts) == []
    assert suspected_folds(placed(true_poses()), matches, counts) == []
    matches, counts = of_two_sides(alike=100)
    assert suspected_folds(placed(folded(true_poses())), matches, counts) == []


def test_photos_that_stand_far_apart_all_round_are_no_sides() -> None:
    """None of them is near another, so that nothing says what should match."""
    matches, counts = of_two_sides()
    apart = range(0, NUM, 2)
    shown = {pair: matches[pair] for pair in matches if pair[0] in apart and pair[1] in apart}
    assert len(shown) > NUM
    assert suspected_folds(placed(true_poses(), tuple(apart)), shown, counts) == []


def test_close_ups_beside_pictures_of_the_whole_are_no_other_side() -> None:
    """They share little with them, as they show a part; and so do stretches that hardly overlap."""
    matches, counts = of_two_sides()
    near = folded(true_poses())
    near[HALF:, :, 3] = 0.45 * (near[HALF:, :, 3] - [0.0, 0.0, 0.45]) + [0.0, 0.0, 0.45]
    assert suspected_folds(placed(near), matches, counts) == []
    beside = folded(true_poses())
    turn = np.radians(120.0)
    about = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    beside[HALF:] = about @ beside[HALF:]
    assert suspected_folds(placed(beside), matches, counts) == []


@dataclass
class Matched:
    """What is asked of a `Reconstructor` beside mapping."""

    matches: Matches
    counts: Counts

    def verified(self, _most_pairs: int | None, _most_matches: int) -> Matches:
        return self.matches

    def statistics(self) -> PairStatistics:
        rows = np.asarray([(i, j, num) for (i, j), num in self.counts.items()], np.int64)
        return replace(PairStatistics.nothing(NUM), verified=rows)

    def without_pairs(self, pairs: Any) -> Matched:
        left = {pair: found for pair, found in self.matches.items() if pair not in set(pairs)}
        return Matched(left, {pair: self.counts[pair] for pair in left})


def mapping_of(
    unfolded: Callable[[], list[SparseModel]], matched: Matched, sides: Sides = ()
) -> Mapping:
    """Of a mapper that folds what opposite sides share, and else finds something."""
    wrong = across(matched.counts)

    def mapped(by: Any) -> list[SparseModel]:
        return [placed(folded(true_poses()))] if wrong & by.counts.keys() else unfolded()

    logger = logging.getLogger("test")
    clips = [range(NUM)]
    return mended(matched, mapped, clips, is_film=False, logger=logger, sides=sides)  # type: ignore[arg-type]


def test_a_side_finds_its_own_place_where_other_pictures_lead_there() -> None:
    matched = Matched(*of_two_sides())
    mapping = mapping_of(lambda: [model_of(true_poses())], matched)
    assert len(mapping.models[0].indices) == NUM
    assert mapping.left_out == across(matched.counts)
    assert mapping.sides == ()


def test_one_side_is_taken_where_nothing_leads_to_the_other() -> None:
    sides = [tuple(i for i in PLACED if (i < HALF) == is_front) for is_front in (True, False)]
    matched = Matched(*of_two_sides())
    mapping = mapping_of(lambda: [placed(true_poses(), side) for side in sides], matched)
    assert [model.indices for model in mapping.models] == sides
    assert mapping.sides == tuple(map(frozenset, sides))
    attempt = Attempt(RUNGS[0], "retrieval", tuple(mapping.models), 1.0, is_one_side=True)
    files = tuple(f"{i}.jpg" for i in range(NUM))
    source = Source(Path(), files, (None,) * NUM, is_video=False)
    (warning,) = path_warnings(Outcome((attempt,), PairStatistics.nothing(NUM)), source)
    assert warning["code"] == "sides_alike"
    assert "18 of 48 pictures" in warning["message"]


def test_sides_that_were_told_apart_stay_apart_until_other_pictures_join_them() -> None:
    """Though they match better now than any two sides should."""
    matched = Matched(*of_two_sides(alike=100))
    assert mapping_of(list, matched).models[0].indices == PLACED, "the trap"
    sides = tuple(frozenset(i for i in PLACED if (i < HALF) == front) for front in (True, False))
    apart = mapping_of(lambda: [placed(true_poses(), tuple(sorted(sides[0])))], matched, sides)
    assert apart.sides == sides
    assert apart.left_out == across(matched.counts)
    joined = mapping_of(lambda: [model_of(true_poses())], matched, sides)
    assert joined.sides == ()
    assert len(joined.models[0].indices) == NUM


@pytest.mark.parametrize("num_left", [0, 4])
def test_what_falls_to_pieces_without_those_pairs_stays_as_it_was(num_left: int) -> None:
    matched = Matched(*of_two_sides())
    pieces = [placed(true_poses(), PLACED[:num_left])] if num_left else []
    mapping = mapping_of(lambda: pieces, matched)
    assert mapping.models[0].indices == PLACED
    assert (mapping.left_out, mapping.sides) == (frozenset(), ())
