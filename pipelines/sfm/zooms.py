"""Films whose lens changes: a phone that goes over to its other camera, or is zoomed at once.

A clip is taken to have one lens. Where its focal length jumps, mapping finds a way to bend the
world until that is so: all frames are placed, most matches agree, and nothing is right. Between two
frames that follow each other the camera has hardly moved, so that what both show has one size, or
is larger by what the lens changed. Walking up to a thing makes it larger, too, but step by step.

Symbols: M matches of a pair.
"""

from __future__ import annotations

import itertools
import statistics
from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from pipelines.sfm.agreement import Matches

Floats = npt.NDArray[np.float64]

_JUMP, _CLEARLY = 0.2, 4.0
"""Logarithm of the scale from a frame to the next from which the lens may have changed, and how
many times what it is between the frames around."""
_AROUND = 3
"""Frames before and behind that tell how fast what is seen grows anyway."""
_FEWEST_MATCHES = 20
_LEAST_APART = 0.05
"""Of the widest distance among a picture's matches: nearer ones say little about scale."""
_SAME = 0.1
"""Logarithms of scales that differ by less are of one lens: it was gone back to."""


def lens_changes(matches: Matches, clips: Sequence[Sequence[int]]) -> list[tuple[list[int], float]]:
    """The images whose lens is another than that of the first ones of their clip: of each such lens
    its images, and how many times as long it is.

    matches: verified, of pairs that follow each other in a clip. clips: images in order of time.
    """
    found = []
    for clip in clips:
        steps = [_log_scale(matches.get((i, j))) for i, j in itertools.pairwise(clip)]
        lenses: list[tuple[float, list[int]]] = [(0.0, [clip[0]])] if len(clip) else []
        now = 0.0
        for number, image in enumerate(clip[1:]):
            if (step := _jump(steps, number)) is not None:
                now += step
                if not any(abs(now - known) < _SAME for known, _ in lenses):
                    lenses.append((now, []))
            known, images = min(lenses, key=lambda lens: abs(lens[0] - now))
            now = known
            images.append(image)
        found += [(images, float(np.exp(log_scale))) for log_scale, images in lenses[1:]]
    return found


def _jump(steps: Sequence[float | None], number: int) -> float | None:
    """The logarithm of the scale of one step, if it is that of a lens that changes; else None."""
    step = steps[number]
    if step is None or abs(step) < _JUMP:
        return None
    around = [
        abs(other)
        for at, other in enumerate(steps[max(number - _AROUND, 0) : number + _AROUND + 1])
        if at != min(number, _AROUND) and other is not None
    ]
    usual = statistics.median(around) if around else 0.0
    return step if abs(step) >= _CLEARLY * usual else None


def _log_scale(places: tuple[Floats, Floats] | None) -> float | None:
    """The logarithm of how many times as large as in the one picture the other shows things, by the
    distances between what is matched; None of too few matches. places: [M, 2] each, in pixels."""
    if places is None or len(places[0]) < _FEWEST_MATCHES:
        return None
    first, second = places
    logs = []
    widest = float(np.linalg.norm(np.ptp(first, axis=0)))
    for shift in (len(first) // 2, len(first) // 3, len(first) // 5):
        before = np.linalg.norm(first - np.roll(first, shift, axis=0), axis=1)
        after = np.linalg.norm(second - np.roll(second, shift, axis=0), axis=1)
        tells = (before > _LEAST_APART * widest) & (after > 0.0)
        logs.append(np.log(after[tells] / before[tells]))
    told = np.concatenate(logs)
    return float(np.median(told)) if len(told) >= _FEWEST_MATCHES else None
