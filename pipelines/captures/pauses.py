"""Stretches of a film without frames: a recording that stood still, or a time stamp far off.

Frames are chosen evenly over a film's time, so a pause of minutes in a film of seconds would leave
next to none of it. What is counted evenly is therefore the time without its pauses. Each is known
by a time within it and by how much of it is left out, so that who tells times a little otherwise
leaves out the same.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from itertools import pairwise
from statistics import median

LEAST_S = 1.0
"""Phones film at least ten frames in that time, also where their rate varies."""
LEAST_GAPS = 10.0
"""Times the usual time between frames, which in a time lapse is long."""
_MOST = 50
"""The longest: each is a term of what ffmpeg computes for each frame."""

Pause = tuple[float, float]
"""When, seconds, somewhere between the frames before and after it; how long it is, seconds, beyond
the usual time between frames."""


def pauses_of(times_s: Sequence[float]) -> tuple[Pause, ...]:
    """The pauses between frames, by when each frame is shown, increasing. In order of time."""
    gaps = [after - before for before, after in pairwise(times_s)]
    if not gaps:
        return ()
    usual_s = median(gaps)
    found = [
        (round(before + gap / 2.0, 6), round(gap - usual_s, 6))
        for before, gap in zip(times_s, gaps, strict=False)
        if gap > max(LEAST_S, LEAST_GAPS * usual_s)
    ]
    return tuple(sorted(sorted(found, key=lambda pause: -pause[1])[:_MOST]))


def without_pauses(time_s: float, pauses: Iterable[Pause]) -> float:
    """A time on a clock that stands still in the pauses."""
    return time_s - sum(length_s for at_s, length_s in pauses if time_s >= at_s)


def pauses_warning(pauses: Sequence[Pause]) -> str:
    """What the sender should know of them."""
    at_s, length_s = max(pauses, key=lambda pause: pause[1])
    if len(pauses) == 1:
        begins_s = at_s - length_s / 2.0
        return (
            f"The video has a pause of {length_s:.0f} s without pictures, {begins_s:.0f} s after "
            "its begin, which was left out."
        )
    whole_s = sum(length for _, length in pauses)
    return (
        f"The video has {len(pauses)} pauses without pictures, {whole_s:.0f} s together, which "
        "were left out."
    )
