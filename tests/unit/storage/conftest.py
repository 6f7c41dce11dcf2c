"""Fresh databases for each test."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from storage.db import Database
from storage.schema import upgrade
from tests.factories import empty, make_database
from tests.services import fresh_database


@pytest.fixture
def database(tmp_path: Path) -> Iterator[Database]:
    made = make_database(tmp_path)
    yield made
    made.dispose()


@pytest.fixture(scope="session")
def postgres_store(postgres_server: Any) -> Iterator[Database]:
    """One migrated PostgreSQL database for all tests: `either_database` empties it."""
    with fresh_database(postgres_server) as url:
        upgrade(url)
        made = Database(url)
        yield made
        made.dispose()


@pytest.fixture(params=["sqlite", pytest.param("postgresql", marks=pytest.mark.services)])
def either_database(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Database]:
    """The test runs on both databases."""
    if request.param == "sqlite":
        made = make_database(tmp_path)
        yield made
        made.dispose()
        return
    made = request.getfixturevalue("postgres_store")
    yield made
    empty(made)
