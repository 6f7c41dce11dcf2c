"""PostgreSQL with a deadline on everything: connecting, each statement, locks, idle transactions.

The server ends statements by itself (`statement_timeout`); one that hangs, or a network that
swallows packets, does not, so the client stops waiting too: the connection is then closed, for
nobody knows what became of its transaction, and sqlalchemy's OperationalError says so.
"""

from __future__ import annotations

import select
import time
from collections.abc import Generator
from typing import Any, TypeVar

import psycopg
from psycopg import sql
from sqlalchemy import Engine, event
from sqlalchemy.exc import InvalidatePoolError

Result = TypeVar("Result")

CONNECT_S = 5
GRACE_S = 3.0
"""The server's own time limit strikes so much earlier than ours."""
FRESH_S = 1.0
"""A connection that was answered so lately is looked at, but not asked, before it is used again."""
KEEPALIVE: dict[str, int] = {
    "keepalives": 1,
    "keepalives_idle": 15,
    "keepalives_interval": 5,
    "keepalives_count": 3,
    "tcp_user_timeout": 20_000,  # milliseconds
}


class BoundedConnection(psycopg.Connection[Any]):
    """A connection that is given up when one exchange with the server takes too long."""

    deadline_s = 0.0
    answered_at = 0.0

    def wait(self, gen: Generator[Any, Any, Result], *arguments: Any, **options: Any) -> Result:
        """As psycopg's, which all statements, commits and roll-backs go through, but bounded."""
        if not self.deadline_s:
            return super().wait(gen, *arguments, **options)
        return super().wait(self._bounded(gen), *arguments, **options)

    def check(self) -> None:
        """To be called before an idle connection is used again. Raises psycopg's errors.

        A server that ended it has said so, which can be seen here; one that cannot be reached any
        more has not, so a connection that was idle for a while costs an exchange.
        """
        news = select.poll()
        news.register(self.fileno(), select.POLLIN)
        if time.monotonic() - self.answered_at < FRESH_S and not news.poll(0):
            return
        patience_s, self.deadline_s = self.deadline_s, min(CONNECT_S, self.deadline_s)
        self.autocommit = True
        self.execute("SELECT 1")
        self.autocommit = False
        self.deadline_s = patience_s

    def _bounded(self, gen: Generator[Any, Any, Result]) -> Generator[Any, Any, Result]:
        """Passes everything on, also the wake-ups without news that psycopg sends each 0.1 s."""
        give_up_at = time.monotonic() + self.deadline_s
        try:
            wanted = next(gen)
            while True:
                ready = yield wanted
                if not ready and time.monotonic() > give_up_at:
                    self.pgconn.finish()
                    raise psycopg.OperationalError(
                        f"the database gave no answer within {self.deadline_s:.0f} s; "
                        "what became of the transaction is not known"
                    )
                if ready:
                    self.answered_at = time.monotonic()
                wanted = gen.send(ready)
        except StopIteration as end:
            result: Result = end.value
            return result


def bound(engine: Engine, deadline_s: float) -> None:
    """Have all connections of an engine bounded. deadline_s: for one statement, in seconds."""

    connect_s = max(2, min(CONNECT_S, round(deadline_s)))  # libpq takes no less than 2

    def connect(dialect: Any, record: Any, arguments: list[Any], options: dict[str, Any]) -> Any:
        del dialect, record
        given = {"connect_timeout": connect_s, **KEEPALIVE, **options}
        connection = BoundedConnection.connect(*arguments, **given)
        connection.deadline_s, connection.answered_at = deadline_s, time.monotonic()
        server_s = max(deadline_s - GRACE_S, deadline_s / 2)
        for name, seconds in (
            ("statement_timeout", server_s),
            ("lock_timeout", server_s / 2),
            # Of a client that was cut off, or frozen, between two statements: its rows stay locked
            # so long. Well below a lease, or the worker whose row it is could not extend it.
            ("idle_in_transaction_session_timeout", deadline_s),
        ):
            connection.execute(
                sql.SQL("SET {} = {}").format(sql.Identifier(name), round(1000 * seconds))
            )
        connection.commit()
        return connection

    def check(connection: BoundedConnection, record: Any, proxy: Any) -> None:
        del record, proxy
        try:
            connection.check()
        except psycopg.Error as error:
            if connection.closed:
                raise InvalidatePoolError from error  # as old as this one, none is to be trusted
            raise

    event.listen(engine, "do_connect", connect)
    event.listen(engine, "checkout", check)
