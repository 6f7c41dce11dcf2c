"""`Idempotency-Key` on calls that create something: sent twice, done once.

The same key and request get the same answer again, marked `Idempotent-Replayed: true`; the key with
another request is a 422; while the first one is at work, a 409 that says when to ask again. Refused
requests leave nothing behind: they may be sent anew with the same key.
"""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated

from fastapi import Header
from pydantic import BaseModel
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session
from starlette.responses import Response

from api.deps import Caller, Services, actor_of
from storage.idempotency import KeptAnswer, claim, keep, release, scope_of

IdempotencyKey = Annotated[
    str | None,
    Header(
        alias="Idempotency-Key",
        min_length=1,
        max_length=255,
        pattern=r"^[\x21-\x7e]*$",
        description="Any text of the caller's own: a call that is repeated with it is done once.",
    ),
]


@dataclass(frozen=True)
class Once:
    """One call. key: None where the caller gave none."""

    caller: Caller
    call: str
    key: str | None
    fingerprint: str

    @classmethod
    def of(cls, caller: Caller, call: str, key: str | None, *content: str) -> Once:
        """A call with what it asks for: the same content, the same request."""
        digest = hashlib.sha256("\0".join(content).encode("utf-8", "replace")).hexdigest()
        return cls(caller, call, key, digest)


@dataclass(frozen=True)
class Done:
    """The answer, and whether it is that of an earlier call."""

    response: Response
    is_replayed: bool


def _response(answer: KeptAnswer, is_replayed: bool) -> Done:
    headers = {"Location": answer.location, "Cache-Control": "no-store"}
    if is_replayed:
        headers["Idempotent-Replayed"] = "true"
    made = Response(answer.body, answer.status, headers, media_type="application/json")
    return Done(made, is_replayed)


def do_once(
    services: Services,
    once: Once,
    status: int,
    create: Callable[[Session], tuple[BaseModel, str]],
) -> Done:
    """Create something, unless that was done before.

    create: does it in the session that it is given, and returns what to answer and its address.
    Raises what `create` raises, IdempotencyRunningError, IdempotencyReusedError.
    """

    def answer_in(session: Session) -> KeptAnswer:
        view, location = create(session)
        return KeptAnswer(status, view.model_dump_json(), location)

    if once.key is None:
        with services.database.session_scope(actor_of(once.caller), step="create") as session:
            answer = answer_in(session)
        return _response(answer, is_replayed=False)
    scope = scope_of(once.caller.id, once.call, once.key)
    held = claim(services.database, scope, once.fingerprint)
    if isinstance(held, KeptAnswer):
        return _response(held, is_replayed=True)
    try:
        with services.database.session_scope(actor_of(once.caller), step="create") as session:
            answer = answer_in(session)
            keep(session, scope, held, answer)
    except BaseException:
        # Where a COMMIT's outcome is not known, this removes nothing that was kept.
        with contextlib.suppress(SQLAlchemyError), services.database.session_scope() as session:
            release(session, scope, held)
        raise
    return _response(answer, is_replayed=False)
