"""Records on a real PostgreSQL."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from storage.db import Database
from storage.schema import upgrade


@pytest.fixture
def database(postgres_url: str) -> Iterator[Database]:
    """An empty database of the test's own, reached without a detour."""
    upgrade(postgres_url)
    made = Database(postgres_url)
    yield made
    made.dispose()
