"""Which pairs are matched."""

from __future__ import annotations

import numpy as np

from pipelines.sfm.pairs import (
    choose_matcher,
    exhaustive_pairs,
    pairs_through_others,
    planned_pairs,
    sequential_pairs,
    spaced_pairs,
)


def test_a_sequence_matches_neighbours_and_powers_of_two() -> None:
    pairs = sequential_pairs(100, overlap=3)
    assert [j for i, j in pairs if i == 0] == [1, 2, 3, 4, 8, 16, 32, 64]
    assert all(0 <= i < j < 100 for i, j in pairs)
    assert len(pairs) == len(set(pairs))


def test_spaced_pairs_join_the_ends_so_that_loops_close() -> None:
    pairs = spaced_pairs(300)
    assert (0, 299) in pairs
    assert len(pairs) < 700


def test_tiny_counts_have_all_their_pairs_and_no_more() -> None:
    assert spaced_pairs(1) == []
    assert sequential_pairs(1, 10) == []
    assert set(sequential_pairs(4, 10)) == set(exhaustive_pairs(4)) == set(spaced_pairs(4))


def test_auto_takes_neighbours_in_time_for_film_and_in_looks_for_many_photos() -> None:
    assert choose_matcher(20, "auto", is_video=True) == "exhaustive"
    assert choose_matcher(300, "auto", is_video=True) == "sequential"
    assert choose_matcher(20, "auto", is_video=False) == "exhaustive"
    assert choose_matcher(300, "auto", is_video=False) == "retrieval"


def test_a_matcher_asked_for_is_taken() -> None:
    assert choose_matcher(300, "exhaustive", is_video=True) == "exhaustive"
    assert choose_matcher(5, "retrieval", is_video=False) == "retrieval"


def test_planned_pairs_of_a_film_are_few_and_close_loops() -> None:
    assert planned_pairs(50, "exhaustive", 10) == exhaustive_pairs(50)
    pairs = planned_pairs(300, "sequential", 10)
    assert len(pairs) < 5000
    assert {(0, 1), (0, 299)} <= set(pairs)


def test_neighbours_in_time_are_of_one_clip() -> None:
    """With two clips of 20 only the evenly spaced ones pair the end of one with the next."""
    clips = [range(20), range(20, 40)]
    pairs = set(planned_pairs(40, "sequential", 3, clips))
    assert {(0, 1), (0, 3), (17, 19), (20, 21), (36, 39)} <= pairs
    joining = {(i, j) for i, j in pairs if i < 20 <= j}
    assert joining == {(i, j) for i, j in spaced_pairs(40) if i < 20 <= j}
    assert pairs < set(planned_pairs(40, "exhaustive", 3, clips))


def test_what_two_images_share_with_a_third_leads_from_one_to_the_other() -> None:
    """0 - 1 - 2, and 2 - 3 with too few matches to lead anywhere; 4 shares with 0 and 2."""
    verified = np.array([[0, 1, 30], [1, 2, 200], [2, 3, 29], [0, 4, 50], [2, 4, 31]], np.int64)
    matched = {(0, 1), (1, 2), (2, 3), (0, 4), (2, 4), (1, 4)}
    assert pairs_through_others(verified, matched) == [(0, 2)]
    assert pairs_through_others(verified, []) == [(0, 2), (1, 4)]
    assert pairs_through_others(np.zeros((0, 3), np.int64), matched) == []
