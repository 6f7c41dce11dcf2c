"""Bringing a database to the newest schema (`storage/migrations`).

Run from code, so that it works from an installed wheel: no alembic.ini is needed.
"""

from __future__ import annotations

from pathlib import Path

from alembic import command
from alembic.config import Config
from sqlalchemy import text

from storage.db import make_engine

_LOCK = 0x6E657266  # any number of our own: one upgrade at a time on PostgreSQL
UPGRADE_S = 900.0  # a migration may rewrite a large table
_MIGRATIONS = Path(__file__).parent / "migrations"


def upgrade(database_url: str, revision: str = "head") -> None:
    """Bring the schema to a revision, the newest. Safe to call from several processes at once."""
    engine = make_engine(database_url, UPGRADE_S)
    try:
        with engine.begin() as connection:  # BEGIN IMMEDIATE on SQLite: others wait
            if connection.dialect.name == "postgresql":
                connection.execute(text("SELECT pg_advisory_xact_lock(:key)"), {"key": _LOCK})
            config = Config()
            config.set_main_option("script_location", str(_MIGRATIONS).replace("%", "%%"))
            config.attributes["connection"] = connection
            command.upgrade(config, revision)
    finally:
        engine.dispose()
