"""One part that hangs (accepts, takes what is sent, never answers) does not stop the API.

The bounds are generous, for a loaded machine; `python -m tests.benchmarks.hung_broker` measures.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx
import pytest

from api.deps import MAX_CREATIONS
from api.jobs import service as jobs
from storage.claims import claim_stage
from storage.db import Database
from storage.jobs import StageSeed, stage_id
from storage.keys import attempt_prefix
from storage.leases import succeed_stage
from tests.factories import make_job, root_of
from tests.services import Gate, behind_gate
from tests.unit.api.conftest import KEY, LEASE_S, problem, serving, settings_for

MakeGate = Callable[..., Gate]


def slowest(http: httpx.Client, path: str, num: int = 10, status: int = 200) -> float:
    """Seconds of the slowest of so many calls."""
    worst = 0.0
    for _ in range(num):
        begun = time.monotonic()
        assert http.get(path).status_code == status
        worst = max(worst, time.monotonic() - begun)
    return worst


@contextmanager
def many(call: Callable[[], httpx.Response], num: int) -> Iterator[list[httpx.Response]]:
    """So many calls side by side while the block runs; their answers after it."""
    answers: list[httpx.Response] = []
    started = threading.Semaphore(0)

    def one() -> httpx.Response:
        started.release()
        return call()

    with ThreadPoolExecutor(num) as pool:
        calls = [pool.submit(one) for _ in range(num)]
        for _ in range(num):
            started.acquire()
        yield answers
        answers += [found.result() for found in calls]


def test_a_broker_that_hangs_slows_no_call(tmp_path: Path, gate: MakeGate) -> None:
    settings = settings_for(tmp_path / "home", redis_url=f"redis://127.0.0.1:{gate().port}/0")
    with serving(settings) as service:
        job = service.job()
        body = {"capture_id": job["capture_id"]}
        with many(lambda: service.http.post("/v1/jobs", json=body), 60) as answers:
            assert slowest(service.http, f"/v1/jobs/{job['id']}") < 4
            assert slowest(service.anyone, "/livez") < 2
        assert {answer.status_code for answer in answers} == {202}
        refused = problem(service.anyone.get("/readyz"), 503, "not_ready")
        assert [wrong["path"] for wrong in refused["errors"]] == ["broker"]


def test_calls_that_create_wait_for_their_turn_and_those_that_read_do_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """More wait than there are threads for calls, and a read still gets one."""
    gate = threading.Event()
    made = jobs.create

    def slow(*given: Any) -> Any:
        assert gate.wait(300)
        return made(*given)

    def post() -> httpx.Response:
        return service.http.post("/v1/jobs", json={"capture_id": capture}, timeout=300)

    with serving(settings_for(tmp_path / "home")) as service:
        job = service.job()
        capture = job["capture_id"]
        monkeypatch.setattr("api.jobs.service.create", slow)
        monkeypatch.setattr("api.deps.CREATE_TURN_S", 300.0)
        with many(post, 45) as answers:  # starlette has 40 threads
            try:
                assert service.anyone.get("/livez").status_code == 200
                assert service.http.get(f"/v1/jobs/{job['id']}").status_code == 200
            finally:
                gate.set()
        assert {answer.status_code for answer in answers} == {202}
        monkeypatch.setattr("api.deps.CREATE_TURN_S", 0.1)
        gate.clear()
        with many(post, MAX_CREATIONS) as answers:
            try:
                while not service.services.creations.locked():
                    time.sleep(0.01)
                refused = post()
                problem(refused, 503, "database_unavailable")
            finally:
                gate.set()
        assert {answer.status_code for answer in answers} == {202}


@pytest.mark.services
def test_a_database_that_hangs_is_a_503_in_time_and_the_process_lives(
    tmp_path: Path, gate: MakeGate, postgres_url: str
) -> None:
    url, way = behind_gate(postgres_url, gate)
    patient = settings_for(tmp_path / "home", database_url=url)
    with serving(patient) as service:  # a busy machine may be slow within a transaction
        job = service.job()
    settings = settings_for(tmp_path / "home", database_url=url, database_timeout_s=1.0)
    with serving(settings) as service:
        path = f"/v1/jobs/{job['id']}"
        way.hang()
        begun = time.monotonic()
        with many(lambda: service.http.get(path), 24) as answers:
            assert slowest(service.anyone, "/livez") < 2
            assert slowest(service.anyone, "/readyz", 1, status=503) < 8
        assert time.monotonic() - begun < 25
        for answer in answers:
            problem(answer, 503, "database_unavailable")
        way.open()
        deadline = time.monotonic() + 10
        while service.http.get(path).status_code != 200:
            assert time.monotonic() < deadline, "the API did not find its database again"


def publish_without_bytes(database: Database, job_id: str) -> None:
    """Record what a stage published, as if the store had taken it."""
    with database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, "draft"), "test", LEASE_S)
        assert claim is not None
        prefix = attempt_prefix(root_of(job_id), "draft", claim.attempt, claim.token)
        entries = [{"path": "draft.glb", "bytes": 3, "sha256": "0" * 64}]
        manifest = {"files": entries, "summary": {}}
        succeed_stage(session, claim, manifest=manifest, output_prefix=prefix)


def test_an_object_store_that_hangs_stops_only_those_who_ask_it(
    tmp_path: Path, gate: MakeGate
) -> None:
    settings = settings_for(
        tmp_path / "home",
        objects_url="s3://bucket/prefix",
        s3_endpoint_url=f"http://127.0.0.1:{gate().port}",
        s3_access_key_id="a",
        s3_secret_access_key="b",
        s3_timeout_s=4.0,
        check_timeout_s=0.5,
    )
    with serving(settings) as service:
        with service.services.database.session_scope() as session:
            stages = [StageSeed("draft", ())]
            kept, dropped = (make_job(session, stages).id for _ in range(2))
        publish_without_bytes(service.services.database, kept)
        path = f"/v1/jobs/{kept}"
        with many(lambda: service.http.head(f"{path}/artifacts/draft.glb"), 60) as answers:
            assert slowest(service.http, path) < 4
            assert slowest(service.anyone, "/livez") < 2
            begun = time.monotonic()
            assert service.http.delete(f"/v1/jobs/{dropped}").status_code == 204
            assert time.monotonic() - begun < 6
        assert {answer.status_code for answer in answers} == {503}
        refused = problem(service.anyone.get("/readyz"), 503, "not_ready")
        assert [wrong["path"] for wrong in refused["errors"]] == ["broker", "object_store"]
        assert KEY not in str(refused)
