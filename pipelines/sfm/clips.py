"""Which clips of a film hang together: how many of each one's frames are placed, what ties them.

A clip is apart where hardly any of its frames is in the model that was taken, though others are:
it shows another place, or nothing that another clip shows too.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from pipelines.sfm.report import MIN_INLIERS, Outcome
from pipelines.sfm.source import Source

MOST_PLACED = 0.1
"""Share of its frames up to which a clip is apart; one that fits by chance joins nothing."""


def clips_of(outcome: Outcome, source: Source) -> list[dict[str, Any]]:
    """For each clip of several: name, num_images, num_registered, is_apart, most_shared (verified
    matches of one of its frames with the best frame of another clip). Nothing for one clip.
    """
    stretches = source.stretches
    if len(stretches) < 2:
        return []
    model = outcome.chosen.best
    placed = set() if model is None else set(model.indices)
    clip_of = [number for number, stretch in enumerate(stretches) for _ in stretch]
    shared = [0] * len(stretches)
    for first, second, num in outcome.statistics.verified.tolist():
        a, b = clip_of[first], clip_of[second]
        if a != b:
            shared[a], shared[b] = max(shared[a], num), max(shared[b], num)
    found = []
    for number, stretch in enumerate(stretches):
        num_placed = sum(index in placed for index in stretch)
        found.append(
            {
                "name": source.clip_name(stretch[0]),
                "num_images": len(stretch),
                "num_registered": num_placed,
                "is_apart": bool(placed) and num_placed <= MOST_PLACED * len(stretch),
                "most_shared": shared[number],
            }
        )
    return found


def clip_warnings(clips: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """A warning for each clip that is apart: the job goes on without it."""
    return [
        {
            "code": "clip_apart",
            "message": f"Clip {number} ({clip['name']}) does not join the others and is left out: "
            f"{clip['num_registered']} of its {clip['num_images']} frames are placed with them, "
            + _why(clip),
            "hint": "Film so that each clip shows a part of what another one shows, from nearly "
            "the same place; send what shows another place as a capture of its own.",
            "details": clip,
        }
        for number, clip in enumerate(clips, start=1)
        if clip["is_apart"]
    ]


def _why(clip: dict[str, Any]) -> str:
    shared = clip["most_shared"]
    if shared == 0:
        return "and no frame shows anything that a frame of another clip shows."
    if shared < MIN_INLIERS:
        return f"and no frame shares more than {shared} details with one of another clip."
    return f"though a frame shares {shared} details with one of another clip."
