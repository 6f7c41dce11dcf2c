"""The migrations make what the models say, on an empty database and on a current one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from storage.db import make_engine
from storage.models import Base
from storage.schema import upgrade


def differences(url: str) -> list[Any]:
    """What alembic would still change, to make the database what the models say."""
    engine = make_engine(url)
    with engine.begin() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        found = compare_metadata(context, Base.metadata)
    engine.dispose()
    return found


def test_models_and_migrations_agree_on_sqlite(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'new' / 'a.db'}"
    upgrade(url)
    assert differences(url) == []
    upgrade(url)
    assert differences(url) == []


@pytest.mark.services
def test_models_and_migrations_agree_on_postgresql(postgres_url: str) -> None:
    upgrade(postgres_url)
    assert differences(postgres_url) == []


def test_several_processes_may_upgrade_at_once(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.db'}"
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(upgrade, [url] * 4))
    assert differences(url) == []


@pytest.mark.parametrize("url", ["sqlite://", "mysql://u@h/d"])
def test_databases_that_cannot_be_shared_or_are_not_known_are_refused(url: str) -> None:
    with pytest.raises((ValueError, ImportError)):
        make_engine(url)
