"""The migrations make what the models say, on an empty database and on a current one."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
import sqlalchemy as sa
from alembic import command
from alembic.autogenerate import compare_metadata
from alembic.config import Config
from alembic.migration import MigrationContext

from storage.claims import Claim, claim_next
from storage.db import Database, make_engine
from storage.leases import heartbeat, succeed_stage
from storage.models import Base, Capture, Job, PendingDeletion
from storage.queries import get_job, list_events
from storage.records import delete_capture, read_logs
from storage.runs import list_generations, list_runs
from storage.schema import _MIGRATIONS, upgrade
from tests.factories import make_capture


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
            "id": letter * 28,
            "filename": "walk.mp4",
            "kind": "video",
            "bytes": 3,
            "sha256": ("1" if letter == "f" else "0") * 64,
            "object_key": f"captures/{letter * 28}/content",
            "details": "{}",
            "created_at": "2026-01-01 00:00:00.250000",
            "deleted_at": "2026-01-02 00:00:00" if letter == "e" else None,
        }
        for letter in "cdef"  # d holds the same bytes as c; e is a tombstone of them
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
            "output_prefix": f"jobs/{letter * 28}/{name}/1-1/" if state == "succeeded" else None,
            "manifest": f'{{"fingerprint": "{"9" * 64}"}}' if state == "succeeded" else None,
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
            [
                ("first", "running" if letter == "a" else "ready", False),
                ("second", "ready", True),
                ("past", "succeeded", False),
            ]
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
    "log_lines": [
        {
            "job_id": "a" * 28,
            "stage": "first",
            "attempt": 1,
            "text": "it begins",
            "created_at": "2026-01-02 23:00:00",
        }
    ],
    "api_keys": [
        {
            "id": "9" * 28,
            "sha256": "2" * 64,
            "name": "laptop",
            "created_at": "2026-01-01 00:00:00",
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


def fill(url: str, revision: str, content: dict[str, list[dict[str, Any]]]) -> None:
    """Rows for a database of that revision."""
    upgrade(url, revision)
    engine = make_engine(url)
    with engine.begin() as connection:
        for table, rows in content.items():
            for row in rows:
                names = ", ".join(row)
                marks = ", ".join(f":{name}" for name in row)
                connection.execute(sa.text(f"INSERT INTO {table} ({names}) VALUES ({marks})"), row)
    engine.dispose()


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("pg", marks=pytest.mark.services)])
def test_a_database_of_the_first_revision_keeps_what_it_holds(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """And goes on: the claim that was running can be ended, the rest is served in order."""
    url = f"sqlite:///{tmp_path / 'a.db'}"
    if kind == "pg":
        url = request.getfixturevalue("postgres_url")
    fill(url, "0001", FIRST)
    upgrade(url)
    assert differences(url) == []
    database = Database(url)
    a, b = "a" * 28, "b" * 28
    with database.session_scope() as session:
        job = get_job(session, a)
        assert (job.generation, job.options) == (1, {"train": {"max_steps": 5}})
        assert [row.resource for row in job.stages] == ["cpu", "gpu", "cpu"]
        assert [row.fingerprint for row in job.stages] == [None, None, "9" * 64]
        assert [made.options for made in list_generations(session, a)] == [job.options]
        assert read_logs(session, a).lines == ["it begins"]
        assert len(list_events(session, a)) == 1
        held = Claim(f"{a}-first", a, "first", "w1", token=7, attempt=2)
        assert not heartbeat(session, held, 60.0).lost
        succeed_stage(session, held, manifest={"fingerprint": "8"}, output_prefix="p/")
        (run,) = list_runs(session, a)
        assert (run.outcome, run.output_prefix, run.fingerprint) == ("succeeded", "p/", "8")
    served = []
    for _ in range(3):
        with database.session_scope() as session:
            claim = claim_next(session, [["cpu", "gpu"]], "w", 60.0)
            assert claim is not None
            served.append(claim.stage_id)
            assert claim.root == f"jobs/{claim.job_id}/", "a job stays where it began"
    assert served == [f"{b}-first", f"{b}-second", f"{a}-second"]
    database.dispose()


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("pg", marks=pytest.mark.services)])
def test_old_bytes_stay_where_they_are_and_are_shared_from_now_on(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """Also where the same bytes lie twice: each capture keeps its own."""
    url = f"sqlite:///{tmp_path / 'a.db'}"
    if kind == "pg":
        url = request.getfixturevalue("postgres_url")
    fill(url, "0001", FIRST)
    upgrade(url)
    database = Database(url)
    c, d, e, f = (letter * 28 for letter in "cdef")
    content = "captures/{}/content".format
    with database.session_scope() as session:
        captures = {one: session.get_one(Capture, one) for one in (c, d, e, f)}
        assert {one: row.object_key for one, row in captures.items()} == {
            one: content(one) for one in captures
        }
        again = make_capture(session, sha256="0" * 64)
        assert again.object_key == content(c)
        assert captures[e].blob_id is None
        for row in session.scalars(sa.select(Job)):
            row.state = "cancelled"  # as if nothing ran on the capture
    gone = []
    for capture_id in (c, d, f, again.id):
        with database.session_scope() as session:
            delete_capture(session, capture_id)
        with database.read_scope() as session:
            gone.append({row.prefix for row in session.scalars(sa.select(PendingDeletion))})
    folder = "captures/{}/".format
    assert gone == [set(), {folder(d)}, {folder(d), folder(f)}, {folder(c), folder(d), folder(f)}]
    database.dispose()


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("pg", marks=pytest.mark.services)])
def test_what_ran_before_fingerprints_were_kept_gets_its_own(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    """From the revision before, with claims and a job that was retried."""
    url = f"sqlite:///{tmp_path / 'a.db'}"
    if kind == "pg":
        url = request.getfixturevalue("postgres_url")
    fill(url, "0001", FIRST)
    upgrade(url, "0004")
    run = {
        "job_id": "a" * 28,
        "stage": "past",
        "generation": 2,
        "attempt": 1,
        "owner": "w1",
        "started_at": "2026-01-02 00:00:00",
        "outcome": "succeeded",
        "checkpoints": 0,
    }
    queued = {"job_id": "a" * 28, "kind": "job.queued", "data": "{}", "actor": "x", "reason": ""}
    fill(
        url,
        "0004",
        {
            "stage_runs": [{**run, "token": 0}, {**run, "token": -1}],
            "events": [{**queued, "created_at": "2026-01-05 00:00:00"}],
        },
    )
    engine = make_engine(url)
    with engine.begin() as connection:
        connection.execute(sa.text("UPDATE jobs SET generation = 2 WHERE id LIKE 'a%'"))
    engine.dispose()
    upgrade(url)
    assert differences(url) == []
    database = Database(url)
    with database.read_scope() as session:
        runs = {run.token: run for run in list_runs(session, "a" * 28)}
        assert (runs[0].fingerprint, runs[-1].fingerprint) == ("9" * 64, None)
        assert runs[0].output_prefix == f"jobs/{'a' * 28}/past/1-1/"
        (present,) = list_generations(session, "a" * 28)
        assert present.generation == 2
        assert present.created_at == datetime(2026, 1, 5, tzinfo=UTC)
        owned = [name for name, table in Base.metadata.tables.items() if "tenant_id" in table.c]
        for name in owned:
            whose = set(session.scalars(sa.text(f"SELECT tenant_id FROM {name}")))
            assert whose == {"default"}, name
    database.dispose()


@pytest.mark.parametrize("kind", ["sqlite", pytest.param("pg", marks=pytest.mark.services)])
def test_reports_of_failures_move_to_a_place_of_their_own_and_back(
    kind: str, tmp_path: Path, request: pytest.FixtureRequest
) -> None:
    url = f"sqlite:///{tmp_path / 'a.db'}"
    if kind == "pg":
        url = request.getfixturevalue("postgres_url")
    fill(url, "0001", FIRST)
    upgrade(url, "0006")
    engine = make_engine(url)
    files = [{"path": "report.json", "bytes": 2, "sha256": "0" * 64}]
    failed = f"{'a' * 28}-first"
    with engine.begin() as connection:
        connection.execute(
            sa.text(
                "UPDATE stages SET state = 'failed', output_prefix = 'report/', "
                "manifest = :manifest WHERE id = :id"
            ),
            {"id": failed, "manifest": json.dumps({"files": files})},
        )
    upgrade(url)
    database = Database(url)
    with database.session_scope() as session:
        rows = {row.id: row for row in get_job(session, "a" * 28, manifests=True).stages}
        row = rows[failed]
        assert (row.report_prefix, row.report_files) == ("report/", files)
        assert (row.output_prefix, row.manifest) == (None, None)
        past = rows[f"{'a' * 28}-past"]
        assert (past.manifest, past.report_prefix) == ({"fingerprint": "9" * 64}, None)
        row.output_prefix, row.fingerprint = "kept/", "8"  # as of a retry that failed
    database.dispose()
    downgrade(url, "0006")
    with engine.connect() as connection:
        query = "SELECT id, output_prefix, manifest, fingerprint FROM stages WHERE job_id LIKE 'a%'"
        found = {row.id: row for row in connection.execute(sa.text(query))}
    manifest = found[failed].manifest
    assert (found[failed].output_prefix, found[failed].fingerprint) == ("report/", None)
    assert (json.loads(manifest) if isinstance(manifest, str) else manifest) == {"files": files}
    assert found[f"{'a' * 28}-past"].fingerprint == "9" * 64
    engine.dispose()


def downgrade(url: str, revision: str) -> None:
    """Bring the schema back to a revision."""
    engine, config = make_engine(url), Config()
    config.set_main_option("script_location", str(_MIGRATIONS))
    with engine.begin() as connection:
        config.attributes["connection"] = connection
        command.downgrade(config, revision)
    engine.dispose()


def test_whatever_belongs_to_somebody_says_to_whom() -> None:
    nobodys = {"workers", "pending_deletions", "idempotent_calls"}  # why, the models say
    tables = Base.metadata.tables
    assert {name for name, table in tables.items() if "tenant_id" not in table.c} == nobodys
    assert not any(
        table.c.tenant_id.nullable for table in tables.values() if "tenant_id" in table.c
    )


@pytest.mark.parametrize("url", ["sqlite://", "mysql://u@h/d"])
def test_databases_that_cannot_be_shared_or_are_not_known_are_refused(url: str) -> None:
    with pytest.raises((ValueError, ImportError)):
        make_engine(url)
