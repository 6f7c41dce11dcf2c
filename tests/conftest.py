"""Fixtures for every test: real servers (`tests/services.py`)."""

from __future__ import annotations

import os
import signal

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
