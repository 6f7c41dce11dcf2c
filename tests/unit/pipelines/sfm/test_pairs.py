"""Which pairs are matched."""

from __future__ import annotations

from pipelines.sfm.pairs import exhaustive_pairs, plan_pairs, sequential_pairs, spaced_pairs


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


def test_auto_takes_all_pairs_for_photos_and_neighbours_for_film() -> None:
    assert plan_pairs(50, "auto", 10, is_video=False) == ("exhaustive", exhaustive_pairs(50))
    name, pairs = plan_pairs(300, "auto", 10, is_video=True)
    assert name == "sequential"
    assert len(pairs) < 5000
    assert {(0, 1), (0, 299)} <= set(pairs)
    assert plan_pairs(1000, "auto", 10, is_video=False)[0] == "sequential"
    assert plan_pairs(20, "auto", 10, is_video=True)[0] == "exhaustive"


def test_a_matcher_asked_for_is_taken() -> None:
    assert plan_pairs(300, "exhaustive", 10, is_video=True)[0] == "exhaustive"
    assert plan_pairs(5, "sequential", 1, is_video=False)[0] == "sequential"
