"""The toy stages without their short limits of time, for tests of something else."""

from __future__ import annotations

import dataclasses

from pipelines.stage import Stage
from tests.integration import toy_stages

STAGES = tuple(
    dataclasses.replace(stage, time_limit_s=600.0, stall_s=600.0) for stage in toy_stages.STAGES
)


def get_stage(name: str) -> Stage:
    """The stage of that name."""
    return next(stage for stage in STAGES if stage.name == name)
