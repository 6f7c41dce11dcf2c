"""Writers of one SQLite file are served in the order in which they came."""

from __future__ import annotations

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import pytest
from sqlalchemy import text
from sqlalchemy.exc import OperationalError

from storage.db import Database
from storage.turns import Turns
from tests.factories import make_job

APART_S = 0.05


@contextmanager
def somebody_in(turns: Turns) -> Iterator[threading.Event]:
    """A thread has its turn until the event is set, or the block ends."""
    begun, done = threading.Event(), threading.Event()

    def hold() -> None:
        with turns.one(10.0):
            begun.set()
            done.wait(10.0)

    thread = threading.Thread(target=hold)
    thread.start()
    begun.wait(10.0)
    try:
        yield done
    finally:
        done.set()
        thread.join()


def test_turns_come_in_order() -> None:
    turns, served = Turns(), list[int]()

    def take(place: int) -> None:
        with turns.one(10.0):
            served.append(place)

    with ThreadPoolExecutor(8) as pool, somebody_in(turns):
        for place in range(8):
            pool.submit(take, place)
            while len(turns._waiting) <= place:
                time.sleep(0.001)
    assert served == [*range(8)]


def test_who_gives_up_holds_up_nobody() -> None:
    turns = Turns()
    with somebody_in(turns):
        with pytest.raises(TimeoutError), turns.one(0.01):
            pass
        assert not turns._waiting
    with turns.one(0.0):
        pass


def test_one_at_a_time_also_where_waiting_ends_just_as_the_turn_comes() -> None:
    turns, inside, most = Turns(), list[int](), list[int]()

    def take(place: int) -> int:
        done = 0
        for _ in range(40):
            try:
                with turns.one(0.0005 * (place + 1)):
                    inside.append(place)
                    most.append(len(inside))
                    time.sleep(0.0005)
                    inside.pop()
                    done += 1
            except TimeoutError:
                continue
        return done

    with ThreadPoolExecutor(6) as pool:
        assert sum(pool.map(take, range(6))) == len(most)
    assert set(most) == {1}
    with turns.one(0.0):
        assert not turns._waiting


def test_sessions_that_write_are_served_in_the_order_they_came(database: Database) -> None:
    """SQLite by itself lets luck decide, and one of many writers waits until it gives up."""
    served: list[int] = []

    def write(place: int) -> None:
        with database.session_scope() as session:
            session.execute(text("SELECT 1"))
            served.append(place)
            time.sleep(0.01)

    with ThreadPoolExecutor(6) as pool, database.session_scope() as session:
        session.execute(text("SELECT 1"))
        for place in range(6):
            pool.submit(write, place)
            time.sleep(APART_S)
    assert served == [*range(6)]


def test_a_writer_whose_turn_does_not_come_is_told_as_sqlite_would(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.db.BUSY_TIMEOUT_S", 0.05)
    with ThreadPoolExecutor(1) as pool, database.session_scope() as session:
        session.execute(text("SELECT 1"))
        with pytest.raises(OperationalError):
            pool.submit(lambda: database.session_scope().__enter__()).result(10.0)


def test_a_file_that_another_process_writes_is_given_up_in_time(
    database: Database, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another connection stands for the process: it takes no turn here."""
    monkeypatch.setattr("storage.db.BUSY_TIMEOUT_S", 0.2)
    with (
        database.engine.connect() as other,
        other.begin(),
        pytest.raises(OperationalError, match="locked"),
        database.session_scope() as session,
    ):
        session.execute(text("SELECT 1"))
    with database.session_scope() as session:
        session.execute(text("SELECT 1"))


WRITER = """
import sys
from storage.db import Database
from tests.factories import make_job
with Database(sys.argv[1]).session_scope() as session:
    make_job(session)
"""


def test_another_process_gets_in_between_writers_that_never_pause(database: Database) -> None:
    """It waits no longer than for some of theirs, though they always queue."""
    done = threading.Event()

    def write() -> None:
        while not done.is_set():
            with database.session_scope() as session:
                make_job(session)

    url = database.engine.url.render_as_string()
    root = Path(__file__).resolve().parents[3]
    with ThreadPoolExecutor(4) as pool:
        writers = [pool.submit(write) for _ in range(4)]
        try:
            command = [sys.executable, "-c", WRITER, url]
            subprocess.run(command, cwd=root, check=True, timeout=300)
        finally:
            done.set()
        for writer in writers:
            writer.result(60.0)
