"""The toy stages, of which mesh has a short limit of time: for tests of that limit alone, or others
would meet it by accident on a machine that is busy."""

from __future__ import annotations

import dataclasses

from pipelines.stage import Stage
from tests.integration import toy_stages

STAGES = tuple(
    dataclasses.replace(stage, time_limit_s=4.0) if stage.name == "mesh" else stage
    for stage in toy_stages.STAGES
)


def get_stage(name: str) -> Stage:
    """The stage of that name."""
    return next(stage for stage in STAGES if stage.name == name)
