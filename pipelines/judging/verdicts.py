"""Whether a job came out: verdicts from what was measured, with advice.

Of its surfaces two things tell, and neither alone: how much of held-out views the mesh covers, and
how much of what one view shows another sees through (`pipelines.nerf.judging.floaters`). Of the
model its pictures tell: where they are far from held-out photos, cameras may be placed wrongly,
and surfaces can hold together all the same. docs/evaluation.md has the jobs that the
limits were chosen on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

CODE = "geometry_poor"
HINT = (
    "Walk around the subject with more overlap, film plain surfaces with something textured in "
    "view, and give more light; a longer training (preset standard, on a GPU) helps, too."
)

MODEL_CODE = "model_poor"
MODEL_HINT = (
    "Look at the mesh. Where it is wrong, too, cameras were placed wrongly: nothing may move or "
    "change its light while you film, and what looks the same from several sides needs something "
    "beside it that tells them apart. Where it is right, pictures are too few or too far apart."
)


@dataclass(frozen=True)
class Limits:
    """Both in [0, 1]: the least coverage, the largest inconsistency of a job in order."""

    min_coverage: float
    max_depth_inconsistency: float


def geometry_warning(
    coverage: float | None, depth_inconsistency: float | None, limits: Limits
) -> dict[str, Any] | None:
    """A warning {code, message, hint, details}, or None where all that is known is in order."""
    problems = []
    if coverage is not None and coverage < limits.min_coverage:
        problems.append(
            f"the mesh covers {coverage:.0%} of what photos show (least: {limits.min_coverage:.0%})"
        )
    if depth_inconsistency is not None and depth_inconsistency > limits.max_depth_inconsistency:
        problems.append(
            f"views see through {depth_inconsistency:.1%} of each other's surfaces "
            f"(most: {limits.max_depth_inconsistency:.1%})"
        )
    if not problems:
        return None
    return {
        "code": CODE,
        "message": f"The surfaces do not hold together: {' and '.join(problems)}.",
        "hint": HINT,
        "details": {"coverage": coverage, "depth_inconsistency": depth_inconsistency},
    }


def model_warning(psnr: float | None, least: float) -> dict[str, Any] | None:
    """A warning where pictures of the model are not at all like held-out photos.

    psnr, least: dB; None where nothing was measured.
    """
    if psnr is None or psnr >= least:
        return None
    return {
        "code": MODEL_CODE,
        "message": f"Pictures of the model are unlike held-out photos: {psnr:.1f} dB "
        f"(least: {least:.1f}).",
        "hint": MODEL_HINT,
        "details": {"psnr": psnr},
    }
