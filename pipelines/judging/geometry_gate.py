"""Whether a job's surfaces hold together: a verdict from what was measured, with advice.

Two things tell, and neither alone: how much of held-out views the mesh covers, and how much of what
one view shows another sees through (`pipelines.nerf.judging.floaters`). docs/evaluation.md has the
jobs that the limits were chosen on.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

CODE = "geometry_poor"
HINT = (
    "Walk around the subject with more overlap, film plain surfaces with something textured in "
    "view, and give more light; a longer training (preset standard, on a GPU) helps, too."
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
