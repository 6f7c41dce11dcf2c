"""Why a picture has no pose, as far as it was measured, and the stretches that share a cause.

A cause is only named where a measurement stands behind it. Blur comes before few features and few
matches, which it brings about; what is plain shows no blur.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Literal

from pipelines.filming.shots import MIN_FEATURES, MIN_MATCHES, Shot, Take

Cause = Literal[
    "moved_too_fast",
    "blurred",
    "too_few_features",
    "broken_apart",
    "clip_apart",
    "no_overlap",
    "does_not_fit",
]

FAST = 0.35
"""Long sides of the picture per second: at 1/60 s this smears by 0.6 % of it, and in three seconds
nothing of a view is left."""
_STREAKED = 1.5
"""Blur that goes one way by this much comes from motion, where no speed could be measured."""

_OF_A_CLIP = ("broken_apart", "no_overlap", "does_not_fit")
"""What is so of each frame of a clip that shows nothing of the others."""

Span = tuple[int, int]
"""The first and the last of neighbouring pictures."""


def is_fast(shot: Shot) -> bool:
    """Whether the picture moved fast, as its film shows, or as its blur does."""
    if shot.speed is not None:
        return shot.speed >= FAST
    return shot.look is not None and shot.look.is_blurred and shot.look.streak >= _STREAKED


def cause_of(shot: Shot, *, is_film: bool) -> Cause | None:
    """Why a picture was not placed; None for one that was, or where nobody looked."""
    if shot.is_placed is not False or shot.num_features is None:
        return None
    fast = is_film and is_fast(shot)
    if shot.look is not None and shot.look.is_blurred:
        return "moved_too_fast" if fast else "blurred"
    if shot.num_features < MIN_FEATURES:
        return "too_few_features"
    if shot.group is not None:
        return "broken_apart"
    if (shot.best_inliers or 0) < MIN_MATCHES:
        return "moved_too_fast" if fast else "no_overlap"
    return "does_not_fit"


def causes_of(take: Take) -> list[Cause | None]:
    """The cause for each picture of a capture.

    A camera that only turned places no picture, whatever else is so; and where matching was not
    begun, few features alone are known.
    """
    code = (take.error or {}).get("code")
    if code == "no_parallax":
        return [None] * len(take.shots)
    found = [cause_of(shot, is_film=take.is_film) for shot in take.shots]
    for index, cause in enumerate(found):
        clip = take.clip_of(index)
        if clip is not None and clip.is_apart and cause in _OF_A_CLIP:
            found[index] = "clip_apart"
    if code == "no_features":
        early = ("moved_too_fast", "blurred", "too_few_features")
        return [
            cause if cause in early and (shot.num_features or 0) < MIN_FEATURES else None
            for shot, cause in zip(take.shots, found, strict=True)
        ]
    return found


def spans(take: Take, indices: Iterable[int]) -> list[Span]:
    """Runs of neighbouring pictures; one picture between two of them does not part them, the end
    of a clip does."""
    found: list[Span] = []
    for index in sorted(indices):
        beside = found and index - found[-1][1] <= 2
        if beside and take.shots[index].clip == take.shots[found[-1][1]].clip:
            found[-1] = (found[-1][0], index)
        else:
            found.append((index, index))
    return found
