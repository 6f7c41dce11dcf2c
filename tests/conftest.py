"""Fixtures for every test: real servers (`tests/services.py`); which tests share a process."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

import pytest
from xdist.scheduler import LoadFileScheduling  # type: ignore[import-untyped]

# Before anything loads torch: OpenMP's threads must sleep while they wait, as in every process of
# the service, or two cores are busy waiting for each other.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

# A shell that starts the tests in its background has them ignore Ctrl-C, and programs that they
# start inherit that; some tests press it.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

from tests.services import (
    gate,
    postgres_module_url,
    postgres_server,
    postgres_url,
    redis_server,
    s3_endpoint,
)

__all__ = [
    "gate",
    "postgres_module_url",
    "postgres_server",
    "postgres_url",
    "redis_server",
    "s3_endpoint",
]


RUN_NO_JOB = {"test_chaos.py", "test_launcher.py"}
"""Files of e2e that start services and wait for them, but run no job to its end that computes."""


class Scheduling(LoadFileScheduling):  # type: ignore[misc]
    """Tests of a file share a process, for its fixtures; so do all of e2e that run jobs.

    Those share a film and compiled kernels, and a job uses every core: two at once would only be in
    each other's way.
    """

    def _split_scope(self, nodeid: str) -> str:
        file = Path(super()._split_scope(nodeid))
        return "jobs" if "e2e" in file.parts and file.name not in RUN_NO_JOB else str(file)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Scheduling | None:
    """The above in place of xdist's own `--dist loadfile`."""
    return Scheduling(config, log) if config.getoption("dist") == "loadfile" else None
