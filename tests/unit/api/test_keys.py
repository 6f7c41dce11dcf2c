"""Keys of the API: that their uses are noted holds up nobody."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta

import pytest
from sqlalchemy import select, update

from storage.db import Database, now
from storage.models import ApiKey
from tests.unit.api.conftest import Service
from tests.unit.api.test_hanging import many, slowest

SOON_S = 4.0  # PostgreSQL gives up a lock after 6, SQLite after 30
MINUTES = timedelta(minutes=5)


@contextmanager
def others_writing(database: Database) -> Iterator[None]:
    """Another process has SQLite's file locked, or on PostgreSQL all keys."""
    with database.engine.connect() as connection, connection.begin():
        connection.execute(select(ApiKey.id).with_for_update())
        yield


def let_uses_be_due(service: Service) -> None:
    """As if the last call had been minutes ago."""
    database = service.services.database
    with database.session_scope() as session:
        session.execute(update(ApiKey).values(last_used_at=now(session) - MINUTES))
    service.services.key_uses._tried.clear()


def wait_for_a_note(database: Database) -> None:
    deadline = time.monotonic() + 30
    while True:
        with database.read_scope() as session:
            used = session.scalar(select(ApiKey.last_used_at))
            if used is not None and now(session) - used < MINUTES / 2:
                return
        assert time.monotonic() < deadline, "the use was not noted"
        time.sleep(0.02)


def test_the_use_of_a_key_is_noted(served: Service) -> None:
    let_uses_be_due(served)
    assert served.http.get("/v1/jobs").status_code == 200
    wait_for_a_note(served.services.database)


def test_reads_wait_for_no_writer_also_where_the_use_of_their_key_is_to_be_noted(
    served: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.key_uses.AGAIN_S", 0.0)  # as often as can be
    database = served.services.database
    let_uses_be_due(served)
    with others_writing(database):
        assert slowest(served.http, "/v1/jobs", 4) < SOON_S
        with many(lambda: served.http.get("/v1/jobs"), 45) as answers:  # starlette has 40 threads
            assert served.anyone.get("/v1/objects/x").status_code == 403
        assert {answer.status_code for answer in answers} == {200}
    assert served.http.get("/v1/jobs").status_code == 200
    wait_for_a_note(database)
