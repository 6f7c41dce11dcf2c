"""Keys of the API: noting their uses holds up nobody; they are replaced, listed, added, revoked."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path

import pytest
from sqlalchemy import select, update

from api import keys
from storage.db import Database, now
from storage.models import ApiKey
from tests.services import free_port
from tests.unit.api.conftest import KEY, Service, problem, serving, settings_for
from tests.unit.api.test_hanging import many, slowest

SOON_S = 4.0  # PostgreSQL gives up a lock after 6, SQLite after 30
MINUTES = timedelta(minutes=5)


@contextmanager
def others_writing(database: Database) -> Iterator[None]:
    """Another process has SQLite's file locked, or on PostgreSQL all keys."""
    with database.engine.connect() as connection, connection.begin():
        connection.execute(select(ApiKey.id).with_for_update())
        yield


def let_uses_be_due(service: Service) -> None:
    """As if the last call had been minutes ago."""
    database = service.services.database
    with database.session_scope() as session:
        session.execute(update(ApiKey).values(last_used_at=now(session) - MINUTES))
    service.services.key_uses._tried.clear()


def wait_for_a_note(database: Database) -> None:
    deadline = time.monotonic() + 30
    while True:
        with database.read_scope() as session:
            used = session.scalar(select(ApiKey.last_used_at))
            if used is not None and now(session) - used < MINUTES / 2:
                return
        assert time.monotonic() < deadline, "the use was not noted"
        time.sleep(0.02)


def test_the_use_of_a_key_is_noted(served: Service) -> None:
    let_uses_be_due(served)
    assert served.http.get("/v1/jobs").status_code == 200
    wait_for_a_note(served.services.database)


def test_reads_wait_for_no_writer_also_where_the_use_of_their_key_is_to_be_noted(
    served: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("storage.key_uses.AGAIN_S", 0.0)  # as often as can be
    database = served.services.database
    let_uses_be_due(served)
    with others_writing(database):
        assert slowest(served.http, "/v1/jobs", 4) < SOON_S
        with many(lambda: served.http.get("/v1/jobs"), 45) as answers:  # starlette has 40 threads
            assert served.anyone.get("/v1/objects/x").status_code == 403
        assert {answer.status_code for answer in answers} == {200}
    assert served.http.get("/v1/jobs").status_code == 200
    wait_for_a_note(database)


def test_another_key_in_the_settings_replaces_the_leaked_one_and_has_its_jobs(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    home = tmp_path / "home"
    leaked = {"Authorization": "Bearer old-and-leaked"}
    with serving(settings_for(home, bootstrap_api_key="old-and-leaked")) as service:
        service.http.headers.update(leaked)
        job = service.job()
    with serving(settings_for(home)) as service:
        problem(service.anyone.get("/v1/jobs", headers=leaked), 401, "unauthorized")
        assert service.http.get(f"/v1/jobs/{job['id']}").status_code == 200
        assert service.http.get(f"/v1/captures/{job['capture_id']}").status_code == 200
        assert "stays invalid" not in caplog.text
        with (
            caplog.at_level(logging.ERROR, "nerfworks.api"),
            serving(settings_for(home, bootstrap_api_key="old-and-leaked")) as stale,
        ):
            assert "stays invalid" in caplog.text
            for one in (service, stale):
                problem(one.anyone.get("/v1/jobs", headers=leaked), 401, "unauthorized")
                assert one.http.get("/v1/jobs").status_code == 200
    assert "old-and-leaked" not in caplog.text


@pytest.fixture
def commanded(served: Service, monkeypatch: pytest.MonkeyPatch) -> Service:
    """The command works on this service's database."""
    settings = served.services.settings
    monkeypatch.setenv("NERFWORKS_HOME", str(settings.home))
    monkeypatch.setenv("NERFWORKS_DATABASE_URL", settings.database_url)
    return served


def test_the_command_adds_lists_and_revokes_keys(
    commanded: Service, capsys: pytest.CaptureFixture[str]
) -> None:
    assert keys.main(["add", "a friend's laptop"]) == 0
    shown = capsys.readouterr()
    key = shown.out.strip()
    assert key.startswith("nw_")
    assert key not in shown.err
    header = {"Authorization": f"Bearer {key}"}
    assert commanded.anyone.get("/v1/jobs", headers=header).status_code == 200

    assert keys.main(["list"]) == 0
    listed = capsys.readouterr().out
    assert key not in listed
    assert KEY not in listed
    titles, *lines = listed.splitlines()
    assert titles.split() == ["ID", "CREATED", "LAST", "USED", "REVOKED", "NAME"]
    (line,) = (line for line in lines if line.endswith("a friend's laptop"))
    assert any(line.endswith("bootstrap") for line in lines)

    for _ in range(2):
        assert keys.main(["revoke", line.split()[0]]) == 0
        assert "a friend's laptop" in capsys.readouterr().out
    problem(commanded.anyone.get("/v1/jobs", headers=header), 401, "unauthorized")
    assert commanded.http.get("/v1/jobs").status_code == 200


def test_the_command_says_what_it_cannot_do(
    commanded: Service, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    assert keys.main(["revoke", "nobody"]) == 1
    assert "There is no API key nobody." in capsys.readouterr().err
    for name in ("bootstrap", " ", "x" * 101, "two\nlines"):
        with pytest.raises(SystemExit):
            keys.main(["add", name])
    capsys.readouterr()
    elsewhere = commanded.services.settings.home / "elsewhere"
    monkeypatch.setenv("NERFWORKS_HOME", str(elsewhere))
    monkeypatch.setenv("NERFWORKS_DATABASE_URL", "")
    assert keys.main(["list"]) == 1
    assert "NERFWORKS_HOME" in capsys.readouterr().err
    assert not elsewhere.exists()
    away = f"postgresql://nobody@127.0.0.1:{free_port()}/none"
    monkeypatch.setenv("NERFWORKS_DATABASE_URL", away)
    assert keys.main(["list"]) == 1
    assert "cannot be used" in capsys.readouterr().err
