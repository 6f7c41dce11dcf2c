"""Stretches of a film without frames."""

from __future__ import annotations

import numpy as np
import pytest

from pipelines.captures.pauses import pauses_of, pauses_warning, without_pauses


def test_a_clock_without_pauses_is_even() -> None:
    even = np.arange(300) / 30.0
    times = even + np.where(even >= 4.0, 600.0, 0.0) + np.where(even >= 8.0, 50.0, 0.0)
    pauses = pauses_of(list(times))
    assert [length_s for _, length_s in pauses] == pytest.approx([600.0, 50.0])
    np.testing.assert_allclose([without_pauses(time, pauses) for time in times], even, atol=1e-5)
    assert "2 pauses without pictures, 650 s together" in pauses_warning(pauses)
    assert "a pause of 600 s without pictures, 4 s after" in pauses_warning(pauses[:1])


@pytest.mark.parametrize(
    "times",
    [
        [],
        [0.0],
        [0.0, 5.0],
        [*np.arange(30) / 30.0, *(1.0 + np.arange(10) / 5.0)],
        list(np.arange(100) * 7.0),
        [0.0, 1.0, 2.0, 9.0, 10.0, 11.0],
    ],
    ids=["none", "one", "two", "a rate that falls", "a time lapse", "a time lapse with a hole"],
)
def test_frames_far_apart_are_no_pause_where_all_are(times: list[float]) -> None:
    assert pauses_of(times) == ()


def test_the_longest_of_very_many_pauses_are_left_out() -> None:
    gaps = np.full(2000, 0.03)
    gaps[::20] = 2.0 + np.arange(100) / 10.0
    pauses = pauses_of([0.0, *np.cumsum(gaps)])
    assert len(pauses) == 50
    assert min(length_s for _, length_s in pauses) > 6.9
    assert list(pauses) == sorted(pauses)
