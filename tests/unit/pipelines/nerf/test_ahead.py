"""Work begun ahead: same answers, in order, not too much of it at a time."""

from __future__ import annotations

import threading
import time

import pytest

from pipelines.nerf.ahead import ahead

on_threads = pytest.mark.parametrize("threads", [1, 3])


@on_threads
def test_results_come_in_the_order_of_their_items(threads: int) -> None:
    def slower_first(item: int) -> int:
        time.sleep(0.02 if item % 3 == 0 else 0.0)
        return item * item

    assert list(ahead(slower_first, range(20), threads)) == [item * item for item in range(20)]
    assert list(ahead(slower_first, [], threads)) == []


@on_threads
def test_no_more_is_begun_than_threads_and_one(threads: int) -> None:
    begun: list[int] = []
    for taken, _ in enumerate(ahead(begun.append, range(30), threads), start=1):
        time.sleep(0.005)
        assert len(begun) <= taken + threads


@on_threads
def test_what_is_raised_comes_in_its_turn_and_ends_the_rest(threads: int) -> None:
    begun: list[int] = []

    def odd_one_out(item: int) -> int:
        begun.append(item)
        if item == 4:
            raise ValueError("the fifth")
        return item

    seen: list[int] = []
    with pytest.raises(ValueError, match="the fifth"):
        seen.extend(ahead(odd_one_out, range(100), threads))
    assert seen == [0, 1, 2, 3]
    assert max(begun) < 10


def test_whoever_stops_asking_leaves_no_thread_behind() -> None:
    before = threading.active_count()
    results = ahead(lambda item: item, range(100), 2)
    assert next(results) == 0
    assert threading.active_count() > before
    results.close()
    assert threading.active_count() == before
