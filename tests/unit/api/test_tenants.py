"""Two tenants of one service: neither sees, stops, deletes or names what is the other's."""

from __future__ import annotations

import json
import re
import threading
from collections.abc import Iterator
from typing import Any

import httpx
import pytest
import sqlalchemy as sa

from storage.api_keys import create_api_key
from storage.models import Base
from tests.unit.api.conftest import Service, finish_job, zip_of_pictures


@pytest.fixture(scope="module")
def other(served: Service) -> Iterator[httpx.Client]:
    """A caller of another tenant."""
    with served.services.database.session_scope() as session:
        _, key = create_api_key(session, "other", "another")
    with httpx.Client(
        base_url=served.http.base_url, headers={"Authorization": f"Bearer {key}"}, timeout=30
    ) as client:
        yield client


@pytest.fixture(scope="module")
def theirs(served: Service) -> dict[str, str]:
    """Of the first tenant: a capture, a finished job on it with an export, and one that waits."""
    done = served.job(preset="preview", labels={"whose": "mine"})
    finish_job(served.services, done["id"], lambda _: b"content")
    export = served.http.post(f"/v1/jobs/{done['id']}/exports", json={"kind": "mesh"}).json()
    waiting = served.job(done["capture_id"], preset="preview")
    return {
        "capture": done["capture_id"],
        "job": done["id"],
        "export": export["id"],
        "waiting": waiting["id"],
    }


def addressed(ids: dict[str, str]) -> list[tuple[str, str, Any]]:
    """Every call that names a capture or a job: method, address, body."""
    calls: list[tuple[str, str, Any]] = [
        ("GET", f"/v1/captures/{ids['capture']}", None),
        ("POST", f"/v1/captures/{ids['capture']}/check", {}),
        ("DELETE", f"/v1/captures/{ids['capture']}", None),
        ("POST", "/v1/jobs", {"capture_id": ids["capture"]}),
    ]
    for job in (ids["job"], ids["export"], ids["waiting"]):
        calls += [
            ("GET", f"/v1/jobs/{job}", None),
            ("GET", f"/v1/jobs/{job}/events", None),
            ("GET", f"/v1/jobs/{job}/logs", None),
            ("GET", f"/v1/jobs/{job}/artifacts", None),
            ("GET", f"/v1/jobs/{job}/artifacts/mesh.glb", None),
            ("HEAD", f"/v1/jobs/{job}/artifacts/mesh.glb", None),
            ("GET", f"/v1/jobs/{job}/exports", None),
            ("POST", f"/v1/jobs/{job}/exports", {"kind": "mesh"}),
            ("POST", f"/v1/jobs/{job}/retry", {}),
            ("POST", f"/v1/jobs/{job}/cancel", None),
            ("DELETE", f"/v1/jobs/{job}", None),
        ]
    return calls


def to_nobody(text: str) -> str:
    """The same of an id that nothing has."""
    return re.sub("[0-9a-f]{28}", "0" * 28, text)


def snapshot(service: Service) -> dict[str, list[Any]]:
    """All rows of all tables, but for when a key was used and what bore an idempotency key."""
    kept = [table for table in Base.metadata.sorted_tables if "api" not in table.name]
    with service.services.database.engine.connect() as connection:
        return {
            table.name: sorted(map(repr, connection.execute(sa.select(table)).all()))
            for table in kept
        }


def test_what_is_anothers_is_not_there(
    served: Service, other: httpx.Client, theirs: dict[str, str]
) -> None:
    before, bytes_before = snapshot(served), served.objects()
    for method, path, body in addressed(theirs):
        answer = other.request(method, path, json=body)
        assert answer.status_code == 404, (method, path, answer.text)
        never = other.request(method, to_nobody(path), json=json.loads(to_nobody(json.dumps(body))))
        assert to_nobody(answer.text) == never.text, "it can be told from what never was"
    assert snapshot(served) == before
    assert served.objects() == bytes_before


def test_lists_hold_ones_own(served: Service, other: httpx.Client, theirs: dict[str, str]) -> None:
    for path in ("/v1/captures", "/v1/jobs", "/v1/jobs?label=whose", "/v1/jobs?state=succeeded"):
        assert served.http.get(path).json()["items"], path
        assert other.get(path).json()["items"] == [], path
    first = served.http.get("/v1/jobs", params={"limit": 1}).json()
    assert first["next_cursor"]
    assert other.get("/v1/jobs", params={"cursor": first["next_cursor"]}).json()["items"] == []


def test_the_same_bytes_and_the_same_idempotency_key_are_each_ones_own(
    served: Service, other: httpx.Client, theirs: dict[str, str]
) -> None:
    once = {"Idempotency-Key": "everybodys-key"}
    content = zip_of_pictures(4)
    made = []
    for client in (served.http, other):
        upload = client.post("/v1/captures", files={"file": ("photos.zip", content)}, headers=once)
        assert upload.status_code == 201, upload.text
        assert "idempotent-replayed" not in upload.headers
        body = {"capture_id": upload.json()["id"], "preset": "preview"}
        job = client.post("/v1/jobs", json=body, headers=once)
        assert job.status_code == 202, job.text
        again = client.post("/v1/jobs", json=body, headers=once)
        assert again.headers["idempotent-replayed"] == "true"
        made.append((upload.json()["id"], job.json()["id"]))
    assert len({*made[0], *made[1]}) == 4
    (mine, my_job), (yours, your_job) = made
    assert other.delete(f"/v1/jobs/{your_job}").status_code == 204
    assert other.delete(f"/v1/captures/{yours}").status_code == 204
    assert served.http.get(f"/v1/captures/{mine}").status_code == 200
    finish_job(served.services, my_job, lambda _: b"content")  # its bytes are still there
    with served.services.database.engine.connect() as connection:
        keys = connection.scalars(sa.text("SELECT object_key FROM blobs")).all()
    assert keys
    assert not any(key.startswith("tenants/another/") for key in keys)
    objects = served.services.settings.home / "objects"
    assert not [path for path in (objects / "tenants/another").rglob("*") if path.is_file()]
    assert all((objects / key).is_file() for key in keys)


def test_every_statement_of_a_caller_names_its_tenant(
    served: Service, theirs: dict[str, str]
) -> None:
    """Whatever a call asks the database, of every operation that there is, succeeding ones too."""
    mine = served.job(preset="preview")
    finish_job(served.services, mine["id"], lambda _: b"content")
    export = served.http.post(f"/v1/jobs/{mine['id']}/exports", json={"kind": "mesh"}).json()
    waiting = served.job(mine["capture_id"], preset="preview")
    ids = {"capture": mine["capture_id"], "job": mine["id"]}
    ids |= {"export": export["id"], "waiting": waiting["id"]}
    tables = Base.metadata.tables
    owned = "|".join(
        name for name in tables if "tenant_id" in tables[name].c and name != "api_keys"
    )
    asked: list[str] = []

    def note(_c: Any, _cursor: Any, statement: str, *_: Any) -> None:
        if threading.current_thread().name not in ("bell", "drainer"):  # they serve all tenants
            asked.append(statement)

    engine = served.services.database.engine
    sa.event.listen(engine, "before_cursor_execute", note)
    try:
        last = [call for call in addressed(ids) if call[0] == "DELETE"]
        calls = [call for call in addressed(ids) if call[0] != "DELETE"] + [*reversed(last)]
        done = {
            served.http.request(method, path, json=body).status_code for method, path, body in calls
        }
        served.http.get("/v1/jobs?state=failed&label=a")
        served.http.get("/v1/captures")
        served.upload()
    finally:
        sa.event.remove(engine, "before_cursor_execute", note)
    assert {200, 202, 204} <= done
    reads = [one for one in asked if re.search(rf"\b(FROM|UPDATE|JOIN) ({owned})\b", one)]
    assert len(reads) > 100
    bare = {one for one in reads if "tenant_id =" not in one and "count(*)" not in one}
    assert not bare, bare
