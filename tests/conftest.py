"""Fixtures for every test: real servers (`tests/services.py`)."""

from __future__ import annotations

import os

# Before anything loads torch: OpenMP's threads must sleep while they wait, as in every process of
# the service, or two cores are busy waiting for each other.
os.environ.setdefault("OMP_WAIT_POLICY", "passive")

from tests.services import postgres_server, postgres_url, redis_server, s3_endpoint

__all__ = ["postgres_server", "postgres_url", "redis_server", "s3_endpoint"]
