"""What is outside may hang: accept, take what is sent, never answer. Nobody waits for it long."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import redis
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from storage.bell import MAX_PENDING, Bell
from storage.breaker import Breaker
from storage.db import Database
from storage.deletions import Drainer, drain_deletions
from storage.errors import ObjectStoreError
from storage.jobs import stage_id
from storage.models import PendingDeletion, StageRow
from storage.objects_local import LocalObjectStore
from storage.open_objects import open_object_store
from storage.settings import StorageSettings
from tests.factories import make_database, make_job
from tests.services import Gate, RedisServer, behind_gate

MakeGate = Callable[..., Gate]


def test_a_breaker_pauses_ever_longer_until_something_succeeds() -> None:
    moment = [0.0]
    breaker = Breaker(1.0, 5.0, clock=lambda: moment[0])
    assert not breaker.is_open
    for pause_s in (1.0, 2.0, 4.0, 5.0, 5.0):
        assert breaker.failed() == pause_s
        moment[0] += pause_s - 0.01
        assert breaker.is_open
        moment[0] += 0.02
        assert not breaker.is_open
    breaker.succeeded()
    assert not breaker.is_open
    assert breaker.failed() == 1.0


def test_nobody_who_rings_waits_for_a_broker_that_hangs(tmp_path: Path, gate: MakeGate) -> None:
    database = make_database(tmp_path)
    with database.session_scope() as session:
        wanted = stage_id(make_job(session).id, "first")
    bell = Bell(f"redis://127.0.0.1:{gate().port}/0", database, timeout_s=0.3)
    begun = time.monotonic()
    for number in range(200):
        bell.ring([wanted, *(f"{number}-{other}" for other in range(100))])
    assert time.monotonic() - begun < 1.0
    assert len(bell._pending) <= MAX_PENDING
    assert bell.flush(10), "the thread that sends did not give up"
    bell.close()
    with database.read_scope() as session:
        row = session.get(StageRow, wanted)
        assert row is not None
        assert row.rung_at is None, "a message that nobody took counts as sent"


@pytest.mark.services
def test_the_bell_rings_again_once_the_broker_answers_again(
    tmp_path: Path, gate: MakeGate, redis_server: RedisServer
) -> None:
    database = make_database(tmp_path)
    with database.session_scope() as session:
        ids = [stage_id(make_job(session).id, "first") for _ in range(3)]
    way = gate(lambda: socket.create_connection(("127.0.0.1", redis_server.port)))
    url = redis_server.url.replace(f":{redis_server.port}", f":{way.port}")
    bell = Bell(url, database, timeout_s=0.3)
    direct = redis.Redis.from_url(redis_server.url)

    def num_messages() -> int:
        length: Any = direct.llen("cpu")
        return int(length)

    bell.ring(ids[:1])
    assert bell.flush(10)
    assert num_messages() == 1
    way.hang()
    bell.ring(ids[1:2])
    assert bell.flush(10)
    way.open()
    deadline = time.monotonic() + 15
    while num_messages() < 3 and time.monotonic() < deadline:  # the breaker may still be open
        bell.ring(ids[2:])
        bell.flush(5)
        time.sleep(0.1)
    assert num_messages() >= 2
    with database.read_scope() as session:
        row = session.get(StageRow, ids[2])
        assert row is not None
        assert row.rung_at is not None
    bell.close()


@pytest.mark.services
def test_a_database_that_hangs_is_given_up_and_found_again(
    postgres_url: str, gate: MakeGate
) -> None:
    url, way = behind_gate(postgres_url, gate)
    database = Database(url, deadline_s=1.0)
    with database.session_scope() as session:
        session.execute(text("CREATE TABLE t (n int)"))
        session.execute(text("INSERT INTO t VALUES (1)"))

    def hang_in(what: str) -> None:
        with database.session_scope() as session:
            session.execute(text("INSERT INTO t VALUES (2)"))
            way.hang()
            if what == "a read":
                session.execute(text("SELECT count(*) FROM t"))

    for hangs_in in ("a read", "a commit"):
        begun = time.monotonic()
        with pytest.raises(OperationalError):
            hang_in(hangs_in)
        assert time.monotonic() - begun < 8, f"{hangs_in} waited for a database that hangs"
        way.open()
        with database.read_scope() as session:
            assert session.scalar(text("SELECT count(*) FROM t WHERE n = 1")) == 1
    way.hang()  # now without a connection at hand: the pool's own question, or a new one, hangs
    begun = time.monotonic()
    with pytest.raises(OperationalError):
        database.ping()
    assert time.monotonic() - begun < 12
    database.dispose()


@pytest.mark.services
def test_the_database_itself_ends_what_takes_too_long(postgres_url: str) -> None:
    database = Database(postgres_url, deadline_s=2.0)
    with database.session_scope() as session:
        session.execute(text("CREATE TABLE t (n int)"))

    def run(statement: str) -> None:
        with database.session_scope() as session:
            session.execute(text(statement))

    begun = time.monotonic()
    with pytest.raises(OperationalError, match="statement timeout"):
        run("SELECT pg_sleep(20)")
    with database.session_scope() as holder:
        holder.execute(text("LOCK TABLE t"))
        with pytest.raises(OperationalError, match="lock timeout"):
            run("INSERT INTO t VALUES (1)")
    assert time.monotonic() - begun < 6
    database.dispose()


def test_an_s3_that_hangs_is_an_error_within_its_time(tmp_path: Path, gate: MakeGate) -> None:
    store = open_object_store(
        StorageSettings(
            home=tmp_path,
            objects_url="s3://bucket/prefix",
            s3_endpoint_url=f"http://127.0.0.1:{gate().port}",
            s3_access_key_id="a",
            s3_secret_access_key="b",
            s3_timeout_s=0.4,
        )
    )
    calls: tuple[Callable[[], Any], ...] = (
        store.ping,
        lambda: store.stat("a"),
        lambda: store.delete("a"),
        lambda: store.delete_prefix("a/"),
        lambda: [*store.list("a/")],
    )
    for call in calls:
        begun = time.monotonic()
        with pytest.raises(ObjectStoreError):
            call()
        assert time.monotonic() - begun < 3


def undeletable(store: LocalObjectStore, name: str) -> PendingDeletion:
    """A prefix that the store cannot remove: a file lies where its folder would."""
    (store.root / "jobs").mkdir(parents=True, exist_ok=True)
    (store.root / "jobs" / name).write_bytes(b"in the way")
    with pytest.raises(ObjectStoreError):
        store.delete_prefix(f"jobs/{name}/")
    return PendingDeletion(prefix=f"jobs/{name}/")


def test_bytes_that_cannot_be_deleted_hold_up_no_others(tmp_path: Path) -> None:
    database = make_database(tmp_path)
    store = LocalObjectStore(tmp_path / "objects", public_url="", signing_key=b"")
    source = tmp_path / "source"
    source.write_bytes(b"x")
    with database.session_scope() as session:
        when = make_job(session).created_at
        for number in range(7):
            if number == 6:
                store.put_file("jobs/good/a", source)
                row = PendingDeletion(prefix="jobs/good/")
            else:
                row = undeletable(store, f"bad{number}")
            row.created_at = when
            session.add(row)
            session.flush()
    drained = sum(drain_deletions(database, store, limit=3) for _ in range(3))
    assert drained == 1
    assert not store.exists("jobs/good/a")
    with database.read_scope() as session:
        left = {row.prefix for row in session.query(PendingDeletion)}
    assert left == {f"jobs/bad{number}/" for number in range(6)}, "what failed is still to do"


def test_whoever_deletes_waits_for_the_store_only_so_long(tmp_path: Path, gate: MakeGate) -> None:
    database = make_database(tmp_path)
    settings = StorageSettings(
        home=tmp_path,
        objects_url="s3://bucket",
        s3_endpoint_url=f"http://127.0.0.1:{gate().port}",
        s3_access_key_id="a",
        s3_secret_access_key="b",
        s3_timeout_s=20,
    )
    with database.session_scope() as session:
        when = make_job(session).created_at
        session.add(PendingDeletion(prefix="jobs/a/", created_at=when))
    hung = Drainer(database, open_object_store(settings))
    begun = time.monotonic()
    assert hung.drain(0.2) is False
    hung.close(0.1)
    assert time.monotonic() - begun < 3
    whole = Drainer(database, LocalObjectStore(tmp_path, public_url="", signing_key=b""))
    assert whole.drain(10) is True
    whole.close(1)
    with database.read_scope() as session:
        assert session.query(PendingDeletion).count() == 0


def test_the_broker_is_there_before_anybody_rings(tmp_path: Path) -> None:
    bell = Bell("redis://127.0.0.1:1/0", make_database(tmp_path))
    assert bell._opened is None
    bell.prepare(0.01)
    deadline = time.monotonic() + 30
    while bell._opened is None:
        assert time.monotonic() < deadline
        time.sleep(0.01)
    bell.close()


def test_a_bell_that_is_closed_opens_no_broker(tmp_path: Path) -> None:
    bell = Bell("redis://127.0.0.1:1/0", make_database(tmp_path))
    bell.prepare(0.3)
    bell.close()
    assert bell._preparing is not None
    bell._preparing.join(10)
    assert not bell._preparing.is_alive()
    assert bell._opened is None
