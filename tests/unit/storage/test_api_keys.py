"""The key of the settings replaces the one before, and none that was replaced comes back."""

from __future__ import annotations

import itertools
from concurrent.futures import ThreadPoolExecutor
from datetime import timedelta

import pytest

from storage.api_keys import (
    BOOTSTRAP,
    create_api_key,
    ensure_api_key,
    find_api_key,
    list_api_keys,
    revoke_api_key,
    take_bootstrap_key,
)
from storage.db import Database, now


def start(database: Database, key: str) -> bool:
    """Whether the key of the settings is valid after a process started with it."""
    with database.session_scope() as session:
        return take_bootstrap_key(session, key).revoked_at is None


def valid(database: Database, *keys: str) -> list[str]:
    with database.read_scope() as session:
        return [key for key in keys if find_api_key(session, key) is not None]


def test_another_key_in_the_settings_replaces_the_first_and_no_other(
    either_database: Database,
) -> None:
    with either_database.session_scope() as session:
        _, friend = create_api_key(session, "a friend")
    assert start(either_database, "leaked")
    assert start(either_database, "leaked")
    assert valid(either_database, "leaked", friend) == ["leaked", friend]
    assert start(either_database, "new")
    assert valid(either_database, "leaked", "new", friend) == ["new", friend]


def test_no_order_of_starts_brings_a_replaced_key_back(either_database: Database) -> None:
    start(either_database, "leaked")
    start(either_database, "new")
    for key in ("leaked", "new", "leaked", "leaked", "new"):
        assert start(either_database, key) == (key == "new")
        assert valid(either_database, "leaked", "new") == ["new"]
    start(either_database, "newer")
    for key in ("new", "leaked", "newer", "new"):
        start(either_database, key)
        assert valid(either_database, "leaked", "new", "newer") == ["newer"]
    with either_database.read_scope() as session:
        assert len(list_api_keys(session)) == 3


@pytest.mark.parametrize("order", [*itertools.permutations(["oldest", "leaked", "new"])])
def test_of_several_that_were_valid_before_that_of_the_settings_holds(
    database: Database, order: tuple[str, ...]
) -> None:
    """Earlier versions revoked none."""
    with database.session_scope() as session:
        for age, key in enumerate(("new", "leaked", "oldest")):
            record = ensure_api_key(session, key, BOOTSTRAP)
            record.created_at = now(session) - timedelta(days=age)
    for key in order:
        assert start(database, key) == (key == order[0])
        assert valid(database, "oldest", "leaked", "new") == [order[0]]


def test_processes_that_start_at_once_leave_one_valid_key(either_database: Database) -> None:
    start(either_database, "leaked")
    with ThreadPoolExecutor(8) as pool:
        [*pool.map(lambda key: start(either_database, key), ["leaked", "new"] * 8)]
    assert valid(either_database, "leaked", "new") == ["new"]


def test_first_starts_at_once_make_one_key(either_database: Database) -> None:
    with ThreadPoolExecutor(8) as pool:
        assert all(pool.map(lambda key: start(either_database, key), ["first"] * 8))
    with either_database.read_scope() as session:
        assert len(list_api_keys(session)) == 1


def test_a_key_that_was_added_by_hand_may_become_that_of_the_settings(database: Database) -> None:
    with database.session_scope() as session:
        _, key = create_api_key(session, "laptop")
    assert start(database, "leaked")
    assert start(database, key)
    assert valid(database, "leaked", key) == [key]
    assert start(database, "newer")
    assert valid(database, "leaked", key, "newer") == ["newer"]


def test_a_key_of_the_settings_that_was_revoked_stays_so(database: Database) -> None:
    start(database, "leaked")
    with database.session_scope() as session:
        (record,) = list_api_keys(session)
        revoke_api_key(session, record.id)
    assert not start(database, "leaked")
    assert valid(database, "leaked") == []


def test_the_new_key_is_the_tenants_of_the_one_it_replaces(database: Database) -> None:
    with database.session_scope() as session:
        ensure_api_key(session, "leaked", BOOTSTRAP, "another")
    with database.session_scope() as session:
        assert take_bootstrap_key(session, "new").tenant_id == "another"
