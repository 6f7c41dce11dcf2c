"""Uses of keys are noted in the background: soon given up, seldom tried, never waited for."""

from __future__ import annotations

import logging
import time
from datetime import datetime

import pytest

from storage.api_keys import create_api_key
from storage.db import Database
from storage.key_uses import KeyUses
from storage.models import ApiKey


def make_key(database: Database) -> str:
    with database.session_scope() as session:
        return create_api_key(session, "laptop")[0].id


def last_used(database: Database, key_id: str) -> datetime | None:
    with database.read_scope() as session:
        return session.get_one(ApiKey, key_id).last_used_at


def test_what_was_noted_is_there_after_the_end_and_nothing_is_taken_then(
    either_database: Database,
) -> None:
    keys = [make_key(either_database) for _ in range(3)]
    uses = KeyUses(either_database)
    for key in keys[:2]:
        uses.note(key)
    uses.close(30.0)
    uses.note(keys[2])
    assert [last_used(either_database, key) is not None for key in keys] == [True, True, False]
    assert uses._thread is not None
    assert not uses._thread.is_alive()


def test_a_key_is_tried_once_a_minute_and_a_lock_is_soon_given_up(
    database: Database, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr("storage.key_uses.PATIENCE_S", 0.1)
    key, uses = make_key(database), KeyUses(database)
    with caplog.at_level(logging.WARNING, "nerfworks.storage"):
        with database.engine.connect() as other, other.begin():
            for _ in range(20):
                uses.note(key)
            deadline = time.monotonic() + 20  # of 30 that others wait
            while not caplog.messages:
                assert time.monotonic() < deadline
                time.sleep(0.01)
        for _ in range(20):
            uses.note(key)
        assert not uses._pending, "that the note is lost is forgotten for a minute"
        monkeypatch.setattr("storage.key_uses.AGAIN_S", 0.0)
        uses.note(key)
        uses.close(30.0)
    assert len(caplog.messages) == 1
    assert "locked" in caplog.text
    assert last_used(database, key) is not None


def test_a_writer_of_this_process_is_not_waited_for_either(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.key_uses.PATIENCE_S", 0.1)
    key, uses = make_key(database), KeyUses(database)
    with database.session_scope():
        uses.note(key)
        uses.close(20.0)
        assert uses._thread is not None
        assert not uses._thread.is_alive()
    assert last_used(database, key) is None


@pytest.mark.services
def test_a_row_that_is_locked_is_passed_over(postgres_store: Database) -> None:
    first, second = make_key(postgres_store), make_key(postgres_store)
    uses = KeyUses(postgres_store)
    with postgres_store.session_scope() as session:
        session.get_one(ApiKey, first, with_for_update=True)
        uses.note(first)
        uses.note(second)
        uses.close(5.0)
        assert uses._thread is not None
        assert not uses._thread.is_alive()
        assert last_used(postgres_store, second) is not None
    assert last_used(postgres_store, first) is None


def test_what_waits_is_bounded(database: Database, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("storage.key_uses.MAX_PENDING", 2)
    uses = KeyUses(database)
    with database.session_scope():
        for number in range(10):
            uses.note(str(number))
        assert len(uses._pending) <= 2
    uses.close(20.0)
