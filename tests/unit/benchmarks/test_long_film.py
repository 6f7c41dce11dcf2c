"""The benchmark of long films counts pauses as people see them."""

from __future__ import annotations

from tests.benchmarks.long_film import Pauses


def test_a_pause_ends_with_a_larger_fraction_and_a_silence_with_any_word() -> None:
    pauses = Pauses(100.0, 100.0)
    pauses.report(101.0, 0.1, "image 1", None)
    pauses.report(103.0, 0.1, "image 1", None)
    pauses.report(104.0, 0.1, "image 1", 60.0)
    pauses.report(108.0, 0.1, "image 2", 50.0)
    pauses.report(109.0, 0.2, "image 2", 50.0)
    assert (pauses.pause_s, pauses.silence_s) == (8.0, 4.0)
    pauses.report(119.0, 0.15, "image 2", 50.0)
    assert (pauses.pause_s, pauses.silence_s) == (8.0, 10.0)
