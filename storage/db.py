"""Engine, sessions, column types and the clock.

Sessions commit at the edge: a caller opens `Database.session_scope()` once per unit of work and the
functions of this room never commit. On SQLite a writing session starts with BEGIN IMMEDIATE, so
that two writers queue up instead of failing half-way: those of one process in the order in which
they came (`storage.turns`), processes by asking often. On PostgreSQL rows are locked where needed.

The clock of leases is the database's: `now(session)` asks PostgreSQL, so that machines with clocks
apart agree, and reads this machine's clock for SQLite, which only one machine can share. All times
are UTC.
"""

from __future__ import annotations

import copy
import math
import sqlite3
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from sqlalchemy import (
    JSON,
    DateTime,
    Dialect,
    Engine,
    Select,
    String,
    TypeDecorator,
    create_engine,
    event,
    func,
    make_url,
    select,
)
from sqlalchemy.dialects.postgresql import JSONB
from sqlalchemy.engine import Connection
from sqlalchemy.exc import DBAPIError, InterfaceError, OperationalError, SQLAlchemyError
from sqlalchemy.exc import TimeoutError as PoolTimeoutError
from sqlalchemy.orm import Session, sessionmaker

from storage.steps import reached
from storage.tenants import keep_to, watch
from storage.turns import Turns

BUSY_TIMEOUT_S = 30.0
ASK_AGAIN_MS = 10
STATEMENT_S = 15.0
POOL_S = 10.0
ACTOR = "actor"
"""Key of `Session.info`: who changes something in this session. Events carry the name."""
_ENDED = ("25P03", "25P04")  # idle within a transaction, or in one, for too long
_PATIENCE = "nerfworks_patience_s"


def clean_text(text: str, limit: int | None = None) -> str:
    """Text that every database takes: no NUL, no lone surrogates, at most `limit` characters."""
    clean = text.replace("\x00", "").encode("utf-8", "replace").decode("utf-8")
    return clean if limit is None else clean[:limit]


def clean_json(value: Any) -> Any:
    """JSON that every database takes: clean text; NaN and infinities become null."""
    if isinstance(value, str):
        return clean_text(value)
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, dict):
        return {clean_text(str(key)): clean_json(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [clean_json(item) for item in value]
    return value


class CleanJson(TypeDecorator[Any]):
    """JSON (JSONB on PostgreSQL) that cannot be refused for what it holds."""

    impl = JSON
    cache_ok = True

    def __init__(self, none_as_null: bool = False) -> None:
        super().__init__(none_as_null=none_as_null)
        self.none_as_null = none_as_null

    def load_dialect_impl(self, dialect: Dialect) -> Any:
        """JSONB where there is one."""
        kind = JSONB if dialect.name == "postgresql" else JSON
        return dialect.type_descriptor(kind(none_as_null=self.none_as_null))

    def process_bind_param(self, value: Any, dialect: Dialect) -> Any:
        """Clean on the way in."""
        return clean_json(value)

    def coerce_compared_value(self, op: Any, value: Any) -> Any:
        """Index and compare as JSON does."""
        return self.impl_instance.coerce_compared_value(op, value)


class CleanText(TypeDecorator[str]):
    """Bounded text: longer values are cut, characters that a database refuses are dropped."""

    impl = String
    cache_ok = True

    def __init__(self, length: int) -> None:
        super().__init__(length)
        self.limit = length

    def process_bind_param(self, value: str | None, dialect: Dialect) -> str | None:
        """Clean on the way in."""
        return None if value is None else clean_text(value, self.limit)


class UtcDateTime(TypeDecorator[datetime]):
    """An aware UTC time on both databases; SQLite holds it without the zone."""

    impl = DateTime(timezone=True)
    cache_ok = True

    def process_bind_param(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Aware in; naive UTC for SQLite."""
        if value is None:
            return None
        if value.tzinfo is None:
            raise ValueError("times in the database must carry a zone")
        value = value.astimezone(UTC)
        return value.replace(tzinfo=None) if dialect.name == "sqlite" else value

    def process_result_value(self, value: datetime | None, dialect: Dialect) -> datetime | None:
        """Aware UTC out."""
        if value is None:
            return None
        return value.replace(tzinfo=UTC) if value.tzinfo is None else value.astimezone(UTC)


def now(session: Session) -> datetime:
    """The clock that leases go by: PostgreSQL's own, or this machine's for SQLite."""
    if session.get_bind().dialect.name == "postgresql":
        moment: datetime = session.execute(select(func.clock_timestamp())).scalar_one()
        return moment.astimezone(UTC)
    return datetime.now(UTC)


def first_and_now(session: Session, query: Select[Any]) -> tuple[Any, datetime] | None:
    """The first that a query finds, with the time by `now`: in one exchange, not two."""
    if session.get_bind().dialect.name != "postgresql":
        found = session.scalars(query.limit(1)).first()
        return None if found is None else (found, now(session))
    moment = func.clock_timestamp(type_=UtcDateTime())
    both = session.execute(query.add_columns(moment).limit(1)).first()
    return None if both is None else (both[0], both[1])


def is_away(error: SQLAlchemyError) -> bool:
    """Whether the database cannot be reached, has no time, or ended the connection: it may answer
    later.

    PostgreSQL ends one whose client was too slow within a transaction, as a machine that slept is,
    with an error that the driver takes for an internal one.
    """
    if isinstance(error, OperationalError | InterfaceError | PoolTimeoutError):
        return True
    return isinstance(error, DBAPIError) and (
        error.connection_invalidated or getattr(error.orig, "sqlstate", None) in _ENDED
    )


def is_locked(error: DBAPIError) -> bool:
    """Whether PostgreSQL refused a statement because another has a row locked."""
    return getattr(error.orig, "sqlstate", None) == "55P03"


def is_full(error: DBAPIError) -> bool:
    """Whether a statement was refused because the disk of the database is full."""
    if isinstance(error.orig, sqlite3.Error):
        return getattr(error.orig, "sqlite_errorcode", 0) & 0xFF == sqlite3.SQLITE_FULL
    return getattr(error.orig, "sqlstate", None) == "53100"


def name_actor(session: Session, actor: str) -> None:
    """Say who changes something in this session, unless that was said before."""
    session.info.setdefault(ACTOR, actor)


def _prepare_sqlite(connection: Any, _record: Any) -> None:
    connection.isolation_level = None  # we say BEGIN ourselves, see _begin_sqlite
    connection.execute(f"PRAGMA busy_timeout = {int(BUSY_TIMEOUT_S * 1000)}")
    deadline = time.monotonic() + BUSY_TIMEOUT_S
    while True:
        try:
            connection.execute("PRAGMA journal_mode = WAL")
            break
        except sqlite3.OperationalError:  # two first starts at once: this one does not wait itself
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)
    connection.execute("PRAGMA synchronous = NORMAL")
    connection.execute("PRAGMA foreign_keys = ON")


def _begin_sqlite(connection: Connection) -> None:
    reading = connection.get_execution_options().get("nerfworks_read_only", False)
    if reading:
        connection.exec_driver_sql("BEGIN")
    else:
        _begin_writing(connection)


def _begin_writing(connection: Connection) -> None:
    """Begin as soon as no other process writes. Raises OperationalError where that takes too long.

    SQLite itself asks ever more rarely the longer it waits, so that who came last goes first.
    """
    raw: Any = connection.connection.driver_connection
    patience_s = connection.get_execution_options().get(_PATIENCE, BUSY_TIMEOUT_S)
    deadline = time.monotonic() + patience_s
    raw.execute(f"PRAGMA busy_timeout = {ASK_AGAIN_MS}")
    try:
        while time.monotonic() < deadline:
            try:
                raw.execute("BEGIN IMMEDIATE")
            except sqlite3.OperationalError as error:
                if error.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:
                    break
            else:
                return
        connection.exec_driver_sql("BEGIN IMMEDIATE")  # fails in SQLAlchemy's words
    finally:
        raw.execute(f"PRAGMA busy_timeout = {int(BUSY_TIMEOUT_S * 1000)}")


def make_engine(url: str, deadline_s: float = STATEMENT_S) -> Engine:
    """An engine for `sqlite:///...` or `postgresql...`; makes the folder of an SQLite file.

    deadline_s: for one statement on PostgreSQL (`storage.postgres`), in seconds.

    A plain `postgresql://` URL is read as `postgresql+psycopg://`. Raises ValueError for others.
    """
    parsed = make_url(url)
    if parsed.drivername in ("postgresql", "postgres"):
        parsed = parsed.set(drivername="postgresql+psycopg")
    if parsed.get_backend_name() == "sqlite":
        if not parsed.database or parsed.database == ":memory:":
            raise ValueError("SQLite needs a file: sqlite:///path/to/file.db")
        Path(parsed.database).parent.mkdir(parents=True, exist_ok=True)
        engine = create_engine(parsed, connect_args={"timeout": BUSY_TIMEOUT_S})
        event.listen(engine, "connect", _prepare_sqlite)
        event.listen(engine, "begin", _begin_sqlite)
        return engine
    if parsed.drivername != "postgresql+psycopg":
        raise ValueError(f"no database of kind {parsed.drivername}: use sqlite or postgresql")
    from storage.postgres import bound  # its driver takes a while to import

    engine = create_engine(parsed, pool_size=5, max_overflow=15, pool_timeout=POOL_S)
    bound(engine, deadline_s)
    return engine


class Database:
    """The records of one service. Safe to share between threads; sessions are not."""

    def __init__(self, url: str, deadline_s: float = STATEMENT_S) -> None:
        """deadline_s: for one statement on PostgreSQL, in seconds."""
        self.engine = make_engine(url, deadline_s)
        self._turns = Turns() if self.engine.dialect.name == "sqlite" else None
        self._write = sessionmaker(self.engine, expire_on_commit=False)
        reading: dict[str, Any] = {"nerfworks_read_only": True}
        if self.engine.dialect.name == "postgresql":
            # Each statement sees what is committed when it begins, in a transaction or not: so
            # those who only read are spared the exchanges that begin one and end it.
            reading["isolation_level"] = "AUTOCOMMIT"
        self._read = sessionmaker(self.engine.execution_options(**reading), expire_on_commit=False)
        watch(self._write)
        watch(self._read)
        self._tenant_id: str | None = None

    def of_tenant(self, tenant_id: str) -> Database:
        """The same database for one tenant, whose sessions see its rows alone."""
        narrowed = copy.copy(self)
        narrowed._tenant_id = tenant_id
        return narrowed

    @contextmanager
    def session_scope(
        self,
        actor: str | None = None,
        *,
        step: str | None = None,
        patience_s: float | None = None,
    ) -> Iterator[Session]:
        """A session that may write. Commits when the block ends, rolls back when it raises.

        actor: who changes something, for the record. step: the operation in `storage.steps` that
        this transaction is. patience_s: how long those who write SQLite's file may keep this one
        waiting, once in this process and once in others; None for BUSY_TIMEOUT_S.
        """
        turn_s = BUSY_TIMEOUT_S if patience_s is None else patience_s
        with self._turn(turn_s), self._write.begin() as session:
            if patience_s is not None:
                session.connection(execution_options={_PATIENCE: patience_s})
            self._narrow(session)
            if actor is not None:
                name_actor(session, actor)
            yield session
            if step is not None:
                reached(f"{step}.commit")
        if step is not None:
            reached(f"{step}.committed")

    @contextmanager
    def _turn(self, patience_s: float) -> Iterator[None]:
        """Around a session that may write. Raises OperationalError where others take too long."""
        with ExitStack() as held:
            if self._turns is not None:
                try:
                    held.enter_context(self._turns.one(patience_s))
                except TimeoutError as error:
                    raise OperationalError("BEGIN IMMEDIATE", {}, error) from error
            yield

    @contextmanager
    def read_scope(self) -> Iterator[Session]:
        """A session that only reads; on SQLite it never waits for writers.

        What it loaded can be used after the block.
        """
        with self._read() as session:
            self._narrow(session)
            yield session

    def _narrow(self, session: Session) -> None:
        if self._tenant_id is not None:
            keep_to(session, self._tenant_id)

    def ping(self) -> None:
        """Raise sqlalchemy's error where the database does not answer."""
        with self.read_scope() as session:
            session.execute(select(1))

    def dispose(self) -> None:
        """Close all connections."""
        self.engine.dispose()
