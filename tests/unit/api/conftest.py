"""The real application on a real SQLite file and a real object folder; no mocks."""

from __future__ import annotations

import hashlib
import io
import json
import re
import threading
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import httpx
import pytest
import uvicorn
from PIL import Image

from api.app import create_app
from api.deps import Services
from api.settings import ApiSettings
from pipelines.manifest import fingerprint
from pipelines.options import ON_REQUEST
from pipelines.registry import STAGES, get_stage
from storage.claims import claim_stage
from storage.jobs import stage_id
from storage.keys import attempt_prefix
from storage.leases import succeed_stage
from storage.models import Job
from storage.queries import get_job
from tests.factories import root_of
from tests.services import free_port

KEY = "nw_test_key_for_the_unit_tests"
LEASE_S = 60.0


def zip_of_pictures(num: int = 3) -> bytes:
    """A .zip of tiny PNG pictures: the same bytes whenever it is made."""
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w") as archive:
        for index in range(num):
            picture = io.BytesIO()
            Image.new("RGB", (16, 12), (index * 20 % 256, 80, 120)).save(picture, "PNG")
            archive.writestr(zipfile.ZipInfo(f"photo_{index}.png"), picture.getvalue())
    return packed.getvalue()


def settings_for(home: Path, **changes: Any) -> ApiSettings:
    """Settings of a service of the test's own. Nothing listens at its broker's address."""
    values: dict[str, Any] = {
        "home": home,
        "redis_url": f"redis://127.0.0.1:{free_port()}/0",
        "bootstrap_api_key": KEY,
        "min_free_bytes": 0,
        "public_url": "http://127.0.0.1:8000",
        "database_url": "",
        "objects_url": "",
        **changes,
    }
    return ApiSettings(**values)


@dataclass
class Service:
    """A running application. http: authorised. anyone: without a key."""

    http: httpx.Client
    anyone: httpx.Client
    services: Services

    def upload(self, content: bytes | None = None, filename: str = "photos.zip") -> dict[str, Any]:
        """Send a capture, a .zip of pictures by default."""
        content = zip_of_pictures() if content is None else content
        answer = self.http.post("/v1/captures", files={"file": (filename, content)})
        assert answer.status_code == 201, answer.text
        made: dict[str, Any] = answer.json()
        return made

    def job(self, capture_id: str | None = None, **wanted: Any) -> dict[str, Any]:
        """Start a job."""
        body = {"capture_id": capture_id or self.upload()["id"], **wanted}
        answer = self.http.post("/v1/jobs", json=body)
        assert answer.status_code == 202, answer.text
        made: dict[str, Any] = answer.json()
        return made

    def objects(self) -> list[Path]:
        """Every file in the object store and the staging folder."""
        home = self.services.settings.home
        return [
            path
            for folder in (home / "objects", home / "staging")
            for path in folder.rglob("*")
            if path.is_file()
        ]


WARNING = {
    "code": "geometry_poor",
    "message": "The surfaces do not hold together.",
    "hint": "Film with more overlap.",
    "details": {},
}


def run_stage(services: Services, job_id: str, name: str, files: dict[str, bytes]) -> None:
    """Do what a worker does for one ready stage: claim, publish, succeed."""
    with services.database.session_scope() as session:
        claim = claim_stage(session, stage_id(job_id, name), "test", LEASE_S)
    assert claim is not None, f"{name} is not ready"
    prefix = attempt_prefix(root_of(job_id), name, claim.attempt, claim.token)
    entries = []
    for path, content in files.items():
        source = services.settings.home / "published"
        source.write_bytes(content)
        services.store.put_file(prefix + path, source)
        source.unlink()
        digest = hashlib.sha256(content).hexdigest()
        entries.append({"path": path, "bytes": len(content), "sha256": digest})
    summary = {"psnr": 25.5, "ssim": 0.9, "num_images": 7, "width": 480, "height": 270}
    assets = {
        "mesh": {"coverage": 0.72, "psnr": 21.5, "ssim": 0.7, "psnr_with_holes": 14.0},
        "cloud": {"coverage": 0.7, "psnr": 20.0, "ssim": 0.6, "psnr_with_holes": 13.0},
        "depth": None,
        "depth_agreement": None,
        "warnings": [WARNING],
        "per_view": [],
    }
    check = {"verdict": "usable", "reasons": ["Few."], "advice": ["More."], "findings": []}
    summaries = {"check": check, "evaluate": summary, "assess": assets}
    manifest = {"files": entries, "summary": summaries.get(name, {})}
    with services.database.session_scope() as session:
        job = get_job(session, job_id, manifests=True)
        parent = None if job.parent_id is None else get_job(session, job.parent_id, manifests=True)
        manifest |= made_from(job, parent, name, entries)
        succeed_stage(session, claim, manifest=manifest, output_prefix=prefix)


def made_from(
    job: Job, parent: Job | None, name: str, entries: list[dict[str, Any]]
) -> dict[str, Any]:
    """What the manifest of a stage says of its inputs, as `pipelines.manifest` writes it."""
    stage = get_stage(name)
    made = {row.name: row.manifest for row in (parent or job).stages if row.manifest}
    inputs = {read: made[read] for read in stage.reads if read in made}
    if not stage.after:
        inputs["input"] = {"content": job.capture_id}
    return {
        "fingerprint": fingerprint(stage, job.options[name], inputs, seed=job.seed),
        "content": hashlib.sha256(json.dumps(entries).encode()).hexdigest(),
        "inputs": {read: found["content"] for read, found in inputs.items()},
    }


NUM_ARTIFACTS = sum(len(stage.artifacts) for stage in STAGES if stage.name not in ON_REQUEST)
"""What a finished job has that asked for no export on request."""


def finish_job(services: Services, job_id: str, content_of: Callable[[str], bytes]) -> None:
    """Run all stages of a job; each artifact holds what `content_of` gives for its name."""
    for stage in STAGES:
        with services.database.read_scope() as session:
            rows = {row.name: row.state for row in get_job(session, job_id).stages}
        if rows[stage.name] != "skipped":
            files = {artifact.path: content_of(artifact.name) for artifact in stage.artifacts}
            run_stage(services, job_id, stage.name, files)


class LiveServer:
    """A uvicorn on a port of its own, which can be stopped and started again."""

    def __init__(self, settings: ApiSettings) -> None:
        self.settings = settings
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self._server: uvicorn.Server | None = None
        self._thread: threading.Thread | None = None
        self.services: Services

    def start(self) -> None:
        app = create_app(self.settings)
        config = uvicorn.Config(
            app, port=self.port, log_config=None, access_log=False, timeout_graceful_shutdown=1
        )
        self._server = uvicorn.Server(config)
        self._thread = threading.Thread(target=self._server.run, daemon=True)
        self._thread.start()
        deadline = time.monotonic() + 20
        while not self._server.started:
            assert time.monotonic() < deadline
            assert self._thread.is_alive()
            time.sleep(0.02)
        self.services = app.state.services

    def stop(self) -> None:
        assert self._server is not None
        assert self._thread is not None
        self._server.should_exit = True
        self._thread.join(10)


@contextmanager
def serving(settings: ApiSettings) -> Iterator[Service]:
    """A live application, and clients of it."""
    server = LiveServer(settings)
    server.start()
    authorised = {"Authorization": f"Bearer {KEY}"}
    try:
        with (
            httpx.Client(base_url=server.url, headers=authorised, timeout=30) as http,
            httpx.Client(base_url=server.url, timeout=30) as anyone,
        ):
            yield Service(http, anyone, server.services)
    finally:
        server.stop()


@pytest.fixture
def service(tmp_path: Path) -> Iterator[Service]:
    """A fresh service."""
    with serving(settings_for(tmp_path / "home")) as made:
        yield made


@pytest.fixture(
    scope="module", params=["sqlite", pytest.param("postgresql", marks=pytest.mark.services)]
)
def served(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Service]:
    """A service on either database, one for all tests of a file."""
    url = "" if request.param == "sqlite" else request.getfixturevalue("postgres_module_url")
    home = tmp_path_factory.mktemp("home")
    with serving(settings_for(home, database_url=url, check_timeout_s=0.2)) as made:
        yield made


@pytest.fixture
def live(tmp_path: Path) -> Iterator[LiveServer]:
    """A live server."""
    server = LiveServer(settings_for(tmp_path / "home"))
    server.start()
    yield server
    server.stop()


@cache
def documented() -> dict[str, Any]:
    """The OpenAPI document."""
    return create_app(ApiSettings()).openapi()


def check_documented(method: str, path: str, status: int, code: str) -> None:
    """Assert that OpenAPI names this code among the answers of this call."""
    for template, calls in documented()["paths"].items():
        pattern = re.sub(r"\{[^}]*\}", "[^/]+", template)
        call = calls.get(method.lower().replace("head", "get"))
        if call is not None and re.fullmatch(pattern, path):
            answers = call["responses"]
            assert str(status) in answers, f"{method} {template} may not answer {status}"
            schema = answers[str(status)]["content"]["application/problem+json"]["schema"]
            listed = schema["allOf"][1]["properties"]["code"]["enum"] if "allOf" in schema else []
            assert code in listed, f"{method} {template} says nothing of {code}"
            return


def problem(answer: httpx.Response, status: int, code: str) -> dict[str, Any]:
    """Assert that the answer is the one shape of an error; returns it."""
    assert answer.status_code == status, answer.text
    assert answer.headers["content-type"] == "application/problem+json"
    assert answer.headers["x-request-id"]
    found: dict[str, Any] = answer.json()
    assert set(found) == {
        *("type", "title", "status", "detail", "instance", "code", "hint", "errors")
    }
    assert found["status"] == status
    assert found["code"] == code, found
    assert found["type"] == f"urn:nerfworks:problem:{code}"
    assert found["detail"]
    assert found["hint"]
    assert found["instance"] == answer.request.url.path
    assert "Traceback" not in answer.text
    check_documented(answer.request.method, answer.request.url.path, status, code)
    return found
