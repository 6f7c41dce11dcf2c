"""`Idempotency-Key`: however often a call is sent, it makes one thing."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import httpx
import pytest

from api.client.client import Client
from api.client.models import ApiProblem
from api.deps import Caller
from api.idempotency import Once
from api.jobs.schemas import JobRequest
from storage.api_keys import create_api_key
from storage.idempotency import claim, release, scope_of
from storage.models import ApiKey
from tests.unit.api.conftest import KEY, LiveServer, Service, problem, zip_of_pictures

ONCE = {"Idempotency-Key": "a-key-of-mine"}


def num_of(service: Service, what: str) -> int:
    return len(service.http.get(f"/v1/{what}").json()["items"])


def test_a_job_is_made_once_and_answered_twice(service: Service) -> None:
    body = {"capture_id": service.upload()["id"], "labels": {"a": "b"}}
    first = service.http.post("/v1/jobs", json=body, headers=ONCE)
    service.http.post(f"/v1/jobs/{first.json()['id']}/cancel")
    again = service.http.post("/v1/jobs", json=body, headers=ONCE)
    assert (again.status_code, again.content) == (first.status_code, first.content)
    assert again.headers["location"] == first.headers["location"]
    assert again.headers["idempotent-replayed"] == "true"
    assert "idempotent-replayed" not in first.headers
    assert num_of(service, "jobs") == 1
    other = service.http.post("/v1/jobs", json={**body, "labels": {}}, headers=ONCE)
    problem(other, 422, "idempotency_key_reused")
    with service.services.database.session_scope() as session:
        _, friend = create_api_key(session, "a friend")
    theirs = {**ONCE, "Authorization": f"Bearer {friend}"}
    assert service.anyone.post("/v1/jobs", json=body, headers=theirs).status_code == 202
    assert service.http.post("/v1/jobs", json=body).status_code == 202
    assert num_of(service, "jobs") == 3


def test_a_capture_is_kept_once_and_its_bytes_too(service: Service) -> None:
    def send(content: bytes, filename: str = "a.zip") -> httpx.Response:
        files = {"file": (filename, content)}
        return service.http.post("/v1/captures", files=files, headers=ONCE)

    first, again = (send(zip_of_pictures(2)) for _ in range(2))
    assert (first.status_code, again.content) == (201, first.content)
    assert again.headers["idempotent-replayed"] == "true"
    problem(send(zip_of_pictures(3)), 422, "idempotency_key_reused")
    problem(send(zip_of_pictures(2), "b.zip"), 422, "idempotency_key_reused")
    assert num_of(service, "captures") == 1
    assert len(service.objects()) == 1


def test_a_refused_call_leaves_its_key_free(service: Service) -> None:
    body = {"capture_id": service.upload()["id"]}
    wrong = service.http.post("/v1/jobs", json={**body, "preset": "nope"}, headers=ONCE)
    problem(wrong, 422, "preset_unknown")
    assert service.http.post("/v1/jobs", json=body, headers=ONCE).status_code == 202


def test_while_the_first_is_at_work_the_second_is_told_to_wait(service: Service) -> None:
    with service.services.database.read_scope() as session:
        key = session.query(ApiKey).one()
        caller = Caller(key.id, key.tenant_id)
    body = {"capture_id": service.upload()["id"]}
    call = "POST /v1/jobs"
    once = Once.of(caller, call, ONCE["Idempotency-Key"], JobRequest(**body).model_dump_json())
    scope = scope_of(caller.id, call, ONCE["Idempotency-Key"])
    token = claim(service.services.database, scope, once.fingerprint)
    assert isinstance(token, str)
    answer = service.http.post("/v1/jobs", json=body, headers=ONCE)
    problem(answer, 409, "idempotency_key_running")
    assert answer.headers["retry-after"] == "1"
    with service.services.database.session_scope() as session:
        release(session, scope, token)
    assert service.http.post("/v1/jobs", json=body, headers=ONCE).status_code == 202


@pytest.mark.parametrize("key", ["", "a b", "ä", "x" * 256])
def test_a_key_that_is_none_is_refused(service: Service, key: str) -> None:
    answer = service.http.post(
        "/v1/jobs",
        json={"capture_id": "0" * 28},
        headers=[(b"idempotency-key", key.encode("latin-1"))],
    )
    problem(answer, 422, "request_invalid")


def test_the_same_call_sent_many_times_at_once_makes_one_job(service: Service) -> None:
    body = {"capture_id": service.upload()["id"]}

    def send(_: int) -> httpx.Response:
        return service.http.post("/v1/jobs", json=body, headers=ONCE)

    with ThreadPoolExecutor(8) as pool:
        answers = [*pool.map(send, range(16))]
    assert {answer.status_code for answer in answers} <= {202, 409}
    assert len({answer.json()["id"] for answer in answers if answer.status_code == 202}) == 1
    for answer in answers:
        if answer.status_code == 409:
            problem(answer, 409, "idempotency_key_running")
            assert answer.headers["retry-after"] == "1"
    assert num_of(service, "jobs") == 1


@contextmanager
def losing_answers(live: LiveServer, num: int) -> Iterator[str]:
    """The URL of a proxy that passes calls on and loses the first answers to POSTs."""
    left = [num]

    class Proxy(BaseHTTPRequestHandler):
        def _pass_on(self) -> None:
            content = self.rfile.read(int(self.headers.get("Content-Length") or 0))
            headers = {name: text for name, text in self.headers.items() if name != "Host"}
            answer = httpx.request(
                self.command, live.url + self.path, content=content, headers=headers, timeout=30
            )
            if self.command == "POST" and left[0]:
                left[0] -= 1
                if left[0] % 2:
                    self.connection.close()  # it breaks off without an answer
                    return
                self.send_response(502)
                self.send_header("Content-Length", "0")
                self.end_headers()
                return
            self.send_response(answer.status_code)
            for name, text in answer.headers.items():
                self.send_header(name, text)
            self.end_headers()
            self.wfile.write(answer.content)

        do_GET = do_POST = _pass_on  # noqa: N815

        def log_message(self, *_: object) -> None:
            """Say nothing."""

    server = ThreadingHTTPServer(("127.0.0.1", 0), Proxy)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        yield f"http://127.0.0.1:{server.server_address[1]}"
    finally:
        server.shutdown()
        server.server_close()


def test_the_client_makes_one_thing_though_its_answers_are_lost(
    live: LiveServer, tmp_path: Path
) -> None:
    archive = tmp_path / "a.zip"
    archive.write_bytes(zip_of_pictures())
    with losing_answers(live, 3) as url, Client(url, KEY, retry_s=20) as client:
        capture = client.upload(archive)
    with losing_answers(live, 3) as url, Client(url, KEY, retry_s=20) as client:
        job = client.create_job(capture.id)
        assert [one.id for one in client.jobs()] == [job.id]
        assert [one.id for one in client.captures()] == [capture.id]
        again = client.create_job(capture.id, idempotency_key="mine")
        assert client.create_job(capture.id, idempotency_key="mine") == again
        with pytest.raises(ApiProblem, match="another request"):
            client.create_job(capture.id, preset="draft", idempotency_key="mine")
