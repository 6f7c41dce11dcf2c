"""The migrations make what the models say, on an empty database and on a current one."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic.autogenerate import compare_metadata
from alembic.migration import MigrationContext

from storage.claims import Claim, claim_next
from storage.db import Database, make_engine
from storage.leases import heartbeat, succeed_stage
from storage.models import Base
from storage.queries import get_job, list_events
from storage.runs import list_runs
from storage.schema import upgrade


def differences(url: str) -> list[Any]:
    """What alembic would still change, to make the database what the models say."""
    engine = make_engine(url)
    with engine.begin() as connection:
        context = MigrationContext.configure(connection, opts={"compare_type": True})
        found = compare_metadata(context, Base.metadata)
    engine.dispose()
    return found


def test_models_and_migrations_agree_on_sqlite(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'new' / 'a.db'}"
    upgrade(url)
    assert differences(url) == []
    upgrade(url)
    assert differences(url) == []


@pytest.mark.services
def test_models_and_migrations_agree_on_postgresql(postgres_url: str) -> None:
    upgrade(postgres_url)
    assert differences(postgres_url) == []


def test_several_processes_may_upgrade_at_once(tmp_path: Path) -> None:
    url = f"sqlite:///{tmp_path / 'a.db'}"
    with ThreadPoolExecutor(4) as pool:
        list(pool.map(upgrade, [url] * 4))
    assert differences(url) == []


FIRST: dict[str, list[dict[str, Any]]] = {
    "captures": [
        {
            "id": "c" * 28,
            "filename": "walk.mp4",
            "kind": "video",
            "bytes": 3,
            "sha256": "0" * 64,
            "object_key": "k",
            "details": "{}",
            "created_at": "2026-01-01 00:00:00.250000",
        }
    ],
    "jobs": [
        {
            "id": letter * 28,
            "capture_id": "c" * 28,
            "state": "running",
            "preset": "preview",
            "preset_reason": "",
            "options": '{"train": {"max_steps": 5}}',
            "labels": "{}",
            "seed": 0,
            "created_at": f"2026-01-0{day} 00:00:00.250000",
        }
        for letter, day in (("b", 1), ("a", 2))
    ],
    "stages": [
        {
            "id": f"{letter * 28}-{name}",
            "job_id": letter * 28,
            "name": name,
            "seq": seq,
            "after": "[]",
            "state": state,
            "needs_gpu": gpu,
            "attempt": 2 if state == "running" else 0,
            "max_attempts": 3,
            "crashes": 1 if state == "running" else 0,
            "lease_token": 7 if state == "running" else 0,
            "lease_owner": "w1" if state == "running" else None,
            "lease_until": "2026-01-03 00:00:00" if state == "running" else None,
            "heartbeat_at": "2026-01-02 23:59:00" if state == "running" else None,
            "started_at": "2026-01-02 23:00:00" if state == "running" else None,
            "ready_at": "2026-01-02 22:00:00",
            "progress": 0.5,
            "message": "",
        }
        for letter in ("a", "b")
        for seq, (name, state, gpu) in enumerate(
            [("first", "running" if letter == "a" else "ready", False), ("second", "ready", True)]
        )
    ],
    "events": [
        {
            "job_id": "a" * 28,
            "kind": "job.queued",
            "data": "{}",
            "created_at": "2026-01-02 00:00:00",
        }
    ],
    "workers": [
        {
            "id": "w1",
            "hostname": "h",
            "pid": 1,
            "queues": "[]",
            "slots": 1,
            "has_gpu": True,
            "started_at": "2026-01-02 00:00:00",
            "seen_at": "2026-01-02 00:00:00",
        }
    ],
}


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("pg", marks=pytest.mark.services)])
def test_a_database_of_the_first_revision_keeps_what_it_holds(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """And goes on: the claim that was running can be ended, the rest is served in order."""
    url = f"sqlite:///{tmp_path / 'a.db'}"
    if kind == "pg":
        url = request.getfixturevalue("postgres_url")
    upgrade(url, "0001")
    engine = make_engine(url)
    with engine.begin() as connection:
        for table, rows in FIRST.items():
            for row in rows:
                names = ", ".join(row)
                marks = ", ".join(f":{name}" for name in row)
                connection.execute(sa.text(f"INSERT INTO {table} ({names}) VALUES ({marks})"), row)
    engine.dispose()
    upgrade(url)
    assert differences(url) == []
    database = Database(url)
    a, b = "a" * 28, "b" * 28
    with database.session_scope() as session:
        job = get_job(session, a)
        assert (job.generation, job.options) == (1, {"train": {"max_steps": 5}})
        assert [row.resource for row in job.stages] == ["cpu", "gpu"]
        assert len(list_events(session, a)) == 1
        held = Claim(f"{a}-first", a, "first", "w1", token=7, attempt=2)
        assert not heartbeat(session, held, 60.0).lost
        succeed_stage(session, held, manifest={"summary": {}}, output_prefix="p/")
        assert [run.outcome for run in list_runs(session, a)] == ["succeeded"]
    served = []
    for _ in range(3):
        with database.session_scope() as session:
            claim = claim_next(session, [["cpu", "gpu"]], "w", 60.0)
            assert claim is not None
            served.append(claim.stage_id)
    assert served == [f"{b}-first", f"{b}-second", f"{a}-second"]
    database.dispose()


@pytest.mark.parametrize("url", ["sqlite://", "mysql://u@h/d"])
def test_databases_that_cannot_be_shared_or_are_not_known_are_refused(url: str) -> None:
    with pytest.raises((ValueError, ImportError)):
        make_engine(url)
