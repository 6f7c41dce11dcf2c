"""Fixtures for every test: real servers (`tests/services.py`)."""

from __future__ import annotations

from tests.services import postgres_server, postgres_url, redis_server, s3_endpoint

__all__ = ["postgres_server", "postgres_url", "redis_server", "s3_endpoint"]
