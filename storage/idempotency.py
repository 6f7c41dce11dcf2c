"""Calls that create something, done once however often they are sent.

A caller names a call by a key of its own. The first one to come holds the key while it works, and
keeps its answer in the very transaction that creates the record: either both are there or neither,
whatever dies in between. Later ones with the same key get the same answer.

    claim -> a token: work, then `keep` in the transaction of the record, or `release`
          -> a KeptAnswer: the call was done before
    raises IdempotencyRunningError (another one holds the key), IdempotencyReusedError (the key was
    used for something else)

A holder that died keeps others out for `hold_s` at most. It cannot come back late: `keep` is
refused where somebody else holds the key by then.
"""

from __future__ import annotations

import hashlib
import secrets
from dataclasses import dataclass
from datetime import datetime, timedelta

from sqlalchemy import delete, update
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from storage.db import Database, now
from storage.errors import IdempotencyReusedError, IdempotencyRunningError
from storage.models import IdempotentCall

HOLD_S = 30.0
KEPT = timedelta(hours=48)


@dataclass(frozen=True)
class KeptAnswer:
    """What a call was answered. body: JSON text. location: of what it made, or ""."""

    status: int
    body: str
    location: str


def scope_of(*parts: str) -> str:
    """Who calls what, under which key, as one id."""
    return hashlib.sha256("\0".join(parts).encode("utf-8", "replace")).hexdigest()


def claim(
    database: Database,
    scope: str,
    fingerprint: str,
    hold_s: float = HOLD_S,
    when: datetime | None = None,
) -> str | KeptAnswer:
    """Hold a key: a token; or the answer that was kept under it. Commits at once.

    fingerprint: of what is asked. Raises IdempotencyRunningError, IdempotencyReusedError.
    """
    token = secrets.token_hex(8)
    try:
        with database.session_scope(step="hold") as session:
            moment = when or now(session)
            row = session.get(IdempotentCall, scope, with_for_update=True)
            if row is None:
                row = IdempotentCall(id=scope, created_at=moment)
                session.add(row)
            elif row.fingerprint != fingerprint:
                raise IdempotencyReusedError("This key was used for another request.")
            elif row.status is not None:
                return KeptAnswer(row.status, row.body, row.location)
            elif row.held_until > moment:
                raise IdempotencyRunningError("A request with this key is at work.")
            row.fingerprint, row.token = fingerprint, token
            row.held_until = moment + timedelta(seconds=hold_s)
            session.flush()
    except IntegrityError as error:  # another one was first, on PostgreSQL, at the same moment
        raise IdempotencyRunningError("A request with this key is at work.") from error
    return token


def keep(session: Session, scope: str, token: str, answer: KeptAnswer) -> None:
    """Keep the answer, in the transaction that makes what it speaks of.

    Raises IdempotencyRunningError where this holder took so long that another one has the key.
    """
    kept = session.execute(
        update(IdempotentCall)
        .where(
            IdempotentCall.id == scope,
            IdempotentCall.token == token,
            IdempotentCall.status.is_(None),
        )
        .values(status=answer.status, body=answer.body, location=answer.location)
        .returning(IdempotentCall.id)
    )
    if kept.first() is None:
        raise IdempotencyRunningError("Another request with this key is at work by now.")


def release(session: Session, scope: str, token: str) -> None:
    """Give the key back: nothing was made. Does nothing where an answer was kept after all."""
    session.execute(
        delete(IdempotentCall).where(
            IdempotentCall.id == scope,
            IdempotentCall.token == token,
            IdempotentCall.status.is_(None),
        )
    )


def forget_old(session: Session, when: datetime | None = None) -> None:
    """Drop the answers that were kept long enough."""
    edge = (when or now(session)) - KEPT
    session.execute(delete(IdempotentCall).where(IdempotentCall.created_at < edge))
