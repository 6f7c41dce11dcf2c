"""A call under one key is done once: replayed, refused, taken over, never doubled."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta

import pytest

from storage.db import Database
from storage.errors import IdempotencyReusedError, IdempotencyRunningError
from storage.idempotency import KEPT, KeptAnswer, claim, forget_old, keep, release, scope_of

T0 = datetime(2026, 1, 1, tzinfo=UTC)
ANSWER = KeptAnswer(201, '{"id": 1}', "/v1/things/1")
SCOPE = scope_of("caller", "POST /v1/things", "key")


def held(database: Database, after_s: float = 0.0, fingerprint: str = "f") -> str:
    """Claim the key and be the one who works."""
    when = T0 + timedelta(seconds=after_s)
    token = claim(database, SCOPE, fingerprint, hold_s=30.0, when=when)
    assert isinstance(token, str)
    return token


def kept(database: Database, token: str) -> None:
    with database.session_scope() as session:
        keep(session, SCOPE, token, ANSWER)


def test_the_same_call_gets_the_same_answer_and_another_one_none(either_database: Database) -> None:
    kept(either_database, held(either_database))
    assert claim(either_database, SCOPE, "f", when=T0) == ANSWER
    with pytest.raises(IdempotencyReusedError):
        claim(either_database, SCOPE, "g", when=T0)
    for other in (("else", "POST /v1/things", "key"), ("caller", "POST /v1/things", "yek")):
        assert isinstance(claim(either_database, scope_of(*other), "f", when=T0), str)


def test_while_one_works_others_wait_until_its_time_is_over(
    either_database: Database,
) -> None:
    first = held(either_database)
    for after_s in (0.0, 29.9):
        with pytest.raises(IdempotencyRunningError):
            held(either_database, after_s)
        with pytest.raises(IdempotencyReusedError):
            held(either_database, after_s, "g")
    second = held(either_database, 30.1)
    with pytest.raises(IdempotencyRunningError), either_database.session_scope() as session:
        keep(session, SCOPE, first, ANSWER)  # the first one comes back too late
    kept(either_database, second)
    assert claim(either_database, SCOPE, "f", when=T0) == ANSWER


def test_what_was_refused_may_be_sent_again(
    either_database: Database,
) -> None:
    token = held(either_database)
    with either_database.session_scope() as session:
        release(session, SCOPE, "of another")
    with pytest.raises(IdempotencyRunningError):
        held(either_database)
    with either_database.session_scope() as session:
        release(session, SCOPE, token)
    token = held(either_database, fingerprint="g")
    kept(either_database, token)
    with either_database.session_scope() as session:
        release(session, SCOPE, token)  # a COMMIT that was applied, its answer lost
    assert claim(either_database, SCOPE, "g", when=T0) == ANSWER


def test_an_answer_is_there_only_with_what_it_speaks_of(either_database: Database) -> None:
    token = held(either_database)

    def fail_after_keeping() -> None:
        with either_database.session_scope() as session:
            keep(session, SCOPE, token, ANSWER)
            raise RuntimeError("before the COMMIT")

    with pytest.raises(RuntimeError):
        fail_after_keeping()
    with pytest.raises(IdempotencyRunningError):
        claim(either_database, SCOPE, "f", when=T0)


def test_answers_are_forgotten_when_they_were_kept_long_enough(either_database: Database) -> None:
    kept(either_database, held(either_database))
    for when, still in ((T0 + KEPT, True), (T0 + KEPT + timedelta(seconds=1), False)):
        with either_database.session_scope() as session:
            forget_old(session, when)
        assert (claim(either_database, SCOPE, "f", when=T0) == ANSWER) is still


def test_of_many_at_once_one_works(either_database: Database) -> None:
    def attempt(_: int) -> str | KeptAnswer | None:
        try:
            return claim(either_database, SCOPE, "f", when=T0)
        except IdempotencyRunningError:
            return None

    with ThreadPoolExecutor(8) as pool:
        found = [*pool.map(attempt, range(24))]
    assert sum(isinstance(one, str) for one in found) == 1
    assert sum(one is None for one in found) == 23
