"""`kill -9` of the API at every named step of an upload, a job begun, its cancel and its deletion;
and the answer of every COMMIT lost, on both databases.

The caller sends the call again, under the same Idempotency-Key, to another API, as `api.client`
does by itself: it is done once, and after the sweep nothing else is left.
"""

from __future__ import annotations

import io
import secrets
import time
import zipfile
from collections.abc import Iterator
from contextlib import suppress
from functools import partial

import httpx
import pytest
from sqlalchemy import select

import api.idempotency
from api.captures.receiving import sweep
from storage.deletions import drain_deletions
from storage.idempotency import claim
from storage.keys import attempt_prefix, job_root
from storage.models import Capture, Job
from storage.objects_local import LocalObjectStore
from storage.tenants import DEFAULT_TENANT
from tests.faults import at_step
from tests.histories import check_can_go_on, check_history
from tests.integration.aftermath import check_only_what_is_named
from tests.integration.victims import HOLD_S, api_that_dies, wait_for_death
from tests.services import free_port
from tests.unit.api.conftest import (
    KEY,
    Service,
    run_stage,
    serving,
    settings_for,
    zip_of_pictures,
)

pytestmark = pytest.mark.services
AUTHORISED = {"Authorization": f"Bearer {KEY}"}
KILLS = (
    ("upload", "hold.commit"),
    ("upload", "hold.committed"),
    ("upload", "capture.bytes"),
    ("upload", "capture.put"),
    ("upload", "create.commit"),
    ("upload", "create.committed"),
    ("submit", "create.commit"),
    ("submit", "create.committed"),
    ("export", "create.commit"),
    ("export", "create.committed"),
    ("cancel", "cancel.commit"),
    ("cancel", "cancel.committed"),
    ("delete job", "delete.commit"),
    ("delete job", "delete.committed"),
    ("delete job", "erase.deleted"),
    ("delete job", "erase.commit"),
    ("delete job", "erase.committed"),
    ("delete capture", "delete.committed"),
)
LOSES = (
    ("upload", "hold.commit"),
    ("upload", "hold.committed"),
    ("upload", "create.commit"),
    ("upload", "create.committed"),
    ("submit", "hold.commit"),
    ("submit", "hold.committed"),
    ("submit", "create.commit"),
    ("submit", "create.committed"),
    ("export", "hold.committed"),
    ("export", "create.commit"),
    ("export", "create.committed"),
    ("delete export", "delete.commit"),
    ("delete export", "delete.committed"),
    ("retry", "create.commit"),
    ("retry", "create.committed"),
    ("cancel", "cancel.commit"),
    ("cancel", "cancel.committed"),
    ("delete job", "delete.commit"),
    ("delete job", "delete.committed"),
    ("delete capture", "delete.commit"),
    ("delete capture", "delete.committed"),
)


@pytest.fixture(scope="module", params=["sqlite", "postgresql"])
def service(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Service]:
    """The API that lives on."""
    home = tmp_path_factory.mktemp("api") / "home"
    is_far = request.param == "postgresql"
    url = request.getfixturevalue("postgres_module_url") if is_far else ""
    with serving(settings_for(home, database_url=url)) as made:
        # A connection for each call: an idle one may be closed just when it is taken again.
        made.http = httpx.Client(
            base_url=made.http.base_url,
            headers=AUTHORISED,
            timeout=60,
            limits=httpx.Limits(max_keepalive_connections=0),
        )
        with made.http:
            yield made


def new_zip() -> bytes:
    """Pictures that nobody has sent before: what is here already is not stored again."""
    packed = io.BytesIO(zip_of_pictures())
    with zipfile.ZipFile(packed, "a") as archive:
        archive.comment = secrets.token_hex(8).encode()
    return packed.getvalue()


class Call:
    """A call that may be sent again, and what must have come of it in the end."""

    def __init__(self, what: str, service: Service) -> None:
        self.what = what
        self.service = service
        self.filename = f"{secrets.token_hex(4)}.zip"
        self.content = new_zip()
        self.headers = {"Idempotency-Key": secrets.token_hex(8)}
        self.capture = "" if what == "upload" else self.upload()
        self.job = ""
        if what in ("export", "delete export"):
            parent = service.job(self.capture)
            self.parent = parent["id"]
            for stage in parent["stages"]:
                if stage["state"] != "skipped":
                    run_stage(service.services, self.parent, stage["name"], {"a": b"made"})
        if what == "delete export":
            self.job = service.http.post(self.exports, json={"kind": "mesh"}).json()["id"]
            run_stage(service.services, self.job, "mesh", {"mesh.glb": b"made anew"})
            self.root = job_root(DEFAULT_TENANT, self.job)
            assert list(service.services.store.list(self.root))
        if what in ("cancel", "delete job", "retry"):
            self.job = service.job(self.capture)["id"]
            self.root = job_root(DEFAULT_TENANT, self.job)
            made = service.services.settings.home / "made"
            made.write_text("some result")
            self.result = f"{attempt_prefix(self.root, 'ingest', 1, 1)}made"
            service.services.store.put_file(self.result, made)
        if what == "retry":
            assert service.http.post(f"/v1/jobs/{self.job}/cancel").status_code == 202

    @property
    def exports(self) -> str:
        """Where the exports of the finished job are."""
        return f"/v1/jobs/{self.parent}/exports"

    def upload(self) -> str:
        found: str = self.service.upload(self.content, self.filename)["id"]
        return found

    def send(self, http: httpx.Client) -> httpx.Response:
        post = partial(http.post, headers=self.headers)
        if self.what == "upload":
            return post("/v1/captures", files={"file": (self.filename, self.content)})
        if self.what == "submit":
            return post("/v1/jobs", json={"capture_id": self.capture})
        if self.what == "cancel":
            return post(f"/v1/jobs/{self.job}/cancel")
        if self.what == "retry":
            return post(f"/v1/jobs/{self.job}/retry")
        if self.what == "export":
            return post(self.exports, json={"kind": "mesh"})
        if self.what in ("delete job", "delete export"):
            return http.delete(f"/v1/jobs/{self.job}")
        return http.delete(f"/v1/captures/{self.capture}")

    def send_until_done(self, http: httpx.Client) -> httpx.Response:
        """As a patient caller does."""
        deadline = time.monotonic() + 30
        while True:
            answer = self.send(http)
            if answer.status_code not in (409, 503):
                return answer
            assert time.monotonic() < deadline, answer.text
            time.sleep(0.05)

    def check(self, answer: httpx.Response, done_before: bool) -> None:
        """done_before: whether an earlier sending of the call had been recorded."""
        services = self.service.services
        expected = {"upload": 201, "submit": 202, "export": 202, "cancel": 202, "retry": 202}
        status = expected.get(self.what, 404 if done_before else 204)
        assert answer.status_code == status, answer.text
        if self.what in ("upload", "submit", "export", "retry"):
            assert answer.headers.get("Idempotent-Replayed") == ("true" if done_before else None)
        with services.database.read_scope() as session:
            named = select(Capture).where(Capture.filename == self.filename)
            (capture,) = session.scalars(named).all()
            jobs = session.scalars(
                select(Job).where(Job.capture_id == capture.id).order_by(Job.created_at)
            ).all()
            for job in jobs:
                check_history(session, job.id)
                check_can_go_on(session, job.id)
        assert (capture.deleted_at is not None) == (self.what == "delete capture")
        found = [(job.state, job.generation) for job in jobs]
        wanted = {
            "submit": [("queued", 1)],
            "export": [("succeeded", 1), ("queued", 1)],
            "delete export": [("succeeded", 1)],
            "cancel": [("cancelled", 1)],
            "retry": [("queued", 2)],
        }
        assert found == wanted.get(self.what, [])
        if self.what == "upload":
            assert answer.json()["id"] == capture.id
            read = b"".join(services.store.read(capture.object_key))
            assert read == self.content
        if self.what == "submit":
            assert answer.json()["id"] == jobs[0].id
        assert isinstance(services.store, LocalObjectStore)
        while drain_deletions(services.database, services.store):
            pass
        if self.what == "export":
            made = {job.id: job for job in jobs}[answer.json()["id"]]
            assert (made.parent_id, made.state) == (self.parent, "queued")
        if self.what in ("delete job", "delete export"):
            assert not list(services.store.list(self.root))
        check_only_what_is_named(services.database, services.store)
        sweep(services.settings.staging_dir)  # an API does so when it starts
        assert not list(services.settings.staging_dir.iterdir())


@pytest.mark.parametrize(("what", "step"), KILLS)
def test_an_api_dies(service: Service, what: str, step: str) -> None:
    call, port = Call(what, service), free_port()
    settings = service.services.settings
    log = settings.home.parent / "victim.log"
    victim = api_that_dies(settings, log, port, step)
    with httpx.Client(base_url=f"http://127.0.0.1:{port}", headers=AUTHORISED, timeout=60) as http:
        deadline = time.monotonic() + 30
        while True:
            with suppress(httpx.ConnectError):
                http.get("/livez")
                break
            assert time.monotonic() < deadline
            time.sleep(0.02)
        with pytest.raises(httpx.TransportError):
            call.send(http)
    wait_for_death(victim, log)
    recorded = ("create.committed", "cancel.committed", "delete.committed")
    done = step in recorded or step.startswith("erase")
    call.check(call.send_until_done(service.http), done)


@pytest.mark.parametrize(("what", "step"), LOSES)
def test_the_answer_to_a_commit_is_lost(
    service: Service, what: str, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(api.idempotency, "claim", partial(claim, hold_s=HOLD_S))
    call = Call(what, service)
    with at_step(step) as happened:
        answer = call.send(service.http)
    assert happened.is_set()
    assert answer.status_code == 503, answer.text
    assert "Retry-After" in answer.headers
    call.check(
        call.send_until_done(service.http), step.endswith("committed") and "hold" not in step
    )
