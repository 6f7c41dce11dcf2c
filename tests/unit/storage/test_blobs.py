"""Bytes that several captures are made of: kept once, counted, gone with the last."""

from __future__ import annotations

import random
from collections import Counter
from concurrent.futures import ThreadPoolExecutor

import pytest
from sqlalchemy import select, update
from sqlalchemy.exc import IntegrityError

from storage.blobs import find_blob, take_blob
from storage.db import Database
from storage.errors import BlobMissingError, ConflictError
from storage.models import Blob, Capture, PendingDeletion
from storage.records import delete_capture
from tests.factories import make_capture, make_job

SHA = "5" * 64


def new_capture(database: Database, sha256: str = SHA, tenant_id: str = "default") -> Capture:
    with database.session_scope() as session:
        return make_capture(session, sha256=sha256, tenant_id=tenant_id)


def drop(database: Database, capture: Capture) -> None:
    with database.session_scope() as session:
        delete_capture(session, capture.id)


def counts(database: Database) -> dict[str, int]:
    """References by key."""
    with database.read_scope() as session:
        return {row.object_key: row.refs for row in session.scalars(select(Blob))}


def to_go(database: Database) -> list[str]:
    with database.read_scope() as session:
        query = select(PendingDeletion.prefix).order_by(PendingDeletion.id)
        return [f"{prefix}content" for prefix in session.scalars(query)]


def test_the_same_bytes_are_one_blob_until_its_last_capture_goes(either_database: Database) -> None:
    database = either_database
    first, second = new_capture(database), new_capture(database)
    other = new_capture(database, "6" * 64)
    assert first.object_key == second.object_key != other.object_key
    assert counts(database) == {first.object_key: 2, other.object_key: 1}
    drop(database, first)
    assert (counts(database)[second.object_key], to_go(database)) == (1, [])
    drop(database, second)
    assert counts(database) == {other.object_key: 1}
    assert to_go(database) == [second.object_key]
    again = new_capture(database)
    assert again.object_key != second.object_key, "the old bytes may still be on their way out"
    assert to_go(database) == [second.object_key]


def test_tenants_do_not_share_bytes(either_database: Database) -> None:
    mine = new_capture(either_database)
    theirs = new_capture(either_database, tenant_id="another")
    assert theirs.object_key.startswith("tenants/another/blobs/")
    assert set(counts(either_database).values()) == {1}
    drop(either_database, mine)
    assert to_go(either_database) == [mine.object_key]
    with either_database.session_scope() as session:
        job = make_job(session, capture=theirs)
        assert {job.tenant_id, *(row.tenant_id for row in job.stages)} == {"another"}
        assert job.object_root == f"tenants/another/jobs/{job.id}/"


def test_who_relied_on_bytes_that_went_is_told(either_database: Database) -> None:
    database = either_database
    capture = new_capture(database)
    with database.read_scope() as session:
        found = find_blob(session, "default", SHA)
        assert found is not None
        assert found.object_key == capture.object_key
    with database.session_scope() as session:
        assert take_blob(session, "default", SHA, None) == (capture.blob_id, capture.object_key)
    assert counts(database) == {capture.object_key: 2}
    with database.session_scope() as session:
        session.execute(update(Blob).values(refs=1))
    drop(database, capture)
    with pytest.raises(BlobMissingError), database.session_scope() as session:
        take_blob(session, "default", SHA, None)


def test_the_database_keeps_a_blob_that_a_capture_needs(either_database: Database) -> None:
    """Also where a count were wrong."""
    database = either_database
    kept, dropped = new_capture(database), new_capture(database)
    with database.session_scope() as session:
        session.execute(update(Blob).values(refs=1))
    with pytest.raises(IntegrityError):
        drop(database, dropped)
    assert counts(database) == {kept.object_key: 1}
    assert to_go(database) == []


def test_counts_are_right_whoever_comes_and_goes_at_once(either_database: Database) -> None:
    """Every live capture's key has a blob, counted right, and no such key is to go."""
    database = either_database

    def come_and_go(seed: int) -> None:
        chance, mine = random.Random(seed), list[Capture]()
        for _ in range(12):
            if mine and chance.random() < 0.5:
                drop(database, mine.pop())
            else:
                mine.append(new_capture(database, chance.choice("78") * 64))

    with ThreadPoolExecutor(4) as pool:
        list(pool.map(come_and_go, range(4)))
    with database.read_scope() as session:
        live = session.scalars(select(Capture).where(Capture.deleted_at.is_(None))).all()
    assert counts(database) == Counter(capture.object_key for capture in live)
    gone = to_go(database)
    assert len(gone) == len(set(gone))
    assert not set(gone) & set(counts(database))


def test_a_capture_that_comes_while_the_last_one_goes_keeps_its_bytes(
    either_database: Database,
) -> None:
    """The deletion waits for who is taking the blob, and then leaves it."""
    database = either_database
    last = new_capture(database, SHA)
    with ThreadPoolExecutor(1) as pool:
        with database.session_scope() as session:
            new = make_capture(session, sha256=SHA)
            deletion = pool.submit(drop, database, last)
            with pytest.raises(TimeoutError):
                deletion.result(0.3)
        deletion.result(10)
    assert counts(database) == {new.object_key: 1}
    assert to_go(database) == []
    with database.session_scope() as session:
        make_job(session, capture=new)
    with pytest.raises(ConflictError):
        drop(database, new)
