"""Where a photo has the edge between two colours that are known.

Profiles run across an outline: P of them, with T samples `STEP_PX` apart, at 0 the outline.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.floating[Any]]
Bools = NDArray[np.bool_]

STEP_PX = 0.5
PROFILE_PX = 8.0
STEPS = np.arange(-PROFILE_PX, PROFILE_PX + 0.5 * STEP_PX, STEP_PX)
"""[T], px."""
_REACH_PX = 5.0
"""An edge farther away belongs to something else."""
_BEHIND_PX = 2.0
"""Behind the outline colours are believed from here: what is nearer may be its own blur."""
_MEAN_PX = 2.5
"""Beyond where it is believed, either side has the mean of so much of it."""
_CAP = 0.05
"""What one sample may cost: a highlight is no edge."""
_LEAST_CONTRAST, _WHOLE_CONTRAST = 0.004, 0.08
"""Mean squares of the difference of both sides: of less nothing is said, of more nothing better."""
_WORST_FIT = 0.15
"""Of the contrast: what is explained no better is not believed."""
_NEXT_PX = 2.0
_CLEAR = 0.6
"""The cost should rise so much of what the contrast makes of it, so far from the edge."""
_LEAST_SAMPLES = 2


def edge_between(
    photo: Floats, own: Floats, before: Bools, behind: Bools, begin: float
) -> tuple[Floats, Floats]:
    """Where along each profile the first colours give way to the others, and how sure that is.

    photo, own: [P, T, 3] in [0, 1], of the photo and of the model. before, behind: [P, T], which
    samples of the model are of what ends, and of what lies behind. begin: px before the outline
    from which on the model is believed. Returns px [P], and trust [P] in [0, 1], 0 for none.
    """
    before, behind = before & (begin <= -STEPS), behind & (STEPS >= _BEHIND_PX)
    front, num_front = _mean(own, before & (begin + _MEAN_PX >= -STEPS))
    back, num_back = _mean(own, behind & (STEPS <= _BEHIND_PX + _MEAN_PX))
    as_front = _cost(photo, np.where(before[..., None], own, front[:, None]))
    as_back = _cost(photo, np.where(behind[..., None], own, back[:, None]))
    gained = np.pad(np.cumsum(as_front - as_back, axis=1), ((0, 0), (1, 0)))
    total = gained + as_back.sum(axis=1, keepdims=True)
    places = np.append(STEPS, STEPS[-1] + STEP_PX) - 0.5 * STEP_PX
    within = np.abs(places) <= _REACH_PX + 0.5 * STEP_PX
    total, places = total[:, within], places[within]
    row, last = np.arange(len(total)), len(places) - 1
    least = total.argmin(axis=1)
    at = np.clip(least, 1, last - 1)
    left, middle, right = (total[row, at + shift] for shift in (-1, 0, 1))
    bend = np.maximum(left + right - 2.0 * middle, 1e-9)
    found = places[at] + STEP_PX * np.clip(0.5 * (left - right) / bend, -1.0, 1.0)
    apart = round(_NEXT_PX / STEP_PX)
    lower, upper = total[row, np.maximum(at - apart, 0)], total[row, np.minimum(at + apart, last)]
    contrast = ((front - back) ** 2).mean(axis=-1)
    fit = 1.0 - middle / len(STEPS) / (_WORST_FIT * contrast + 1e-9)
    clear = (np.minimum(lower, upper) - middle) / (_CLEAR * contrast + 1e-12)
    trust = np.clip(fit, 0.0, 1.0) * np.clip(clear, 0.0, 1.0)
    trust *= np.clip(contrast / _WHOLE_CONTRAST, 0.0, 1.0)
    good = (least == at) & (np.minimum(num_front, num_back) >= _LEAST_SAMPLES)
    return found, np.where(good & (contrast > _LEAST_CONTRAST), trust, 0.0)


def _mean(colors: Floats, kept: Bools) -> tuple[Floats, NDArray[np.int64]]:
    """The mean [P, 3] of those of colours [P, T, 3] that are kept [P, T], and their number [P]."""
    number = kept.sum(axis=1)
    total = np.einsum("pt,ptc->pc", kept.astype(colors.dtype), colors)
    return total / np.maximum(number, 1)[:, None], number


def _cost(photo: Floats, model: Floats) -> Floats:
    cost: Floats = np.minimum(((photo - model) ** 2).mean(axis=-1), _CAP)
    return cost
