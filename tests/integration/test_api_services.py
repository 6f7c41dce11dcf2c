"""The API on what a cluster uses: PostgreSQL, S3 and Redis; and as a process that is killed."""

from __future__ import annotations

import hashlib
import json
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest
import redis

from api.client.client import ApiProblem, Client
from api.client.transfer import Download
from storage.queue import QUEUE_CPU
from tests.services import RedisServer, S3Endpoint, free_port
from tests.unit.api.conftest import (
    KEY,
    NUM_ARTIFACTS,
    Service,
    finish_job,
    problem,
    serving,
    settings_for,
    zip_of_pictures,
)

pytestmark = pytest.mark.services

ROOT = Path(__file__).resolve().parents[2]
CONTENT = bytes(range(256)) * 8192
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def cluster(
    tmp_path: Path, postgres_url: str, s3_endpoint: S3Endpoint, redis_server: RedisServer
) -> Iterator[Service]:
    """The API on PostgreSQL, S3 and Redis."""
    settings = settings_for(
        tmp_path / "home",
        database_url=postgres_url,
        redis_url=redis_server.url,
        objects_url=f"s3://{s3_endpoint.bucket}/prefix",
        s3_endpoint_url=s3_endpoint.url,
        s3_access_key_id=s3_endpoint.access_key_id,
        s3_secret_access_key=s3_endpoint.secret_access_key,
    )
    with serving(settings) as service:
        yield service


def files_of(endpoint: S3Endpoint) -> list[Path]:
    return [path for path in endpoint.folder.rglob("*") if path.is_file()]


def test_whole_life_of_a_job_on_postgresql_and_s3(
    cluster: Service, s3_endpoint: S3Endpoint, redis_server: RedisServer, tmp_path: Path
) -> None:
    archive = tmp_path / "garden.zip"
    archive.write_bytes(zip_of_pictures())
    assert cluster.anyone.get("/readyz").status_code == 200
    with Client(str(cluster.http.base_url), KEY) as client:
        capture = client.upload(archive)
        (kept,) = files_of(s3_endpoint)
        assert kept.read_bytes() == archive.read_bytes()
        assert not list(cluster.services.settings.staging_dir.iterdir())
        job = client.create_job(capture.id, labels={"place": "garden"})
        assert [found.id for found in client.jobs(label="place=garden")] == [job.id]
        assert list(client.jobs(label="place=attic")) == []
        assert job.queue_position == 1
        with pytest.raises(ApiProblem, match="running"):
            client.delete_capture(capture.id)

        finish_job(cluster.services, job.id, lambda name: CONTENT)
        for artifact in client.artifacts(job.id):
            assert "X-Amz-Signature" in artifact.url
            answer = httpx.get(artifact.url)
            assert answer.content == CONTENT
            assert artifact.name in answer.headers["content-disposition"]
            assert answer.headers["content-type"] == artifact.media_type
        out = tmp_path / "out"
        assert len(client.download(job.id, out)) == NUM_ARTIFACTS
        assert all(path.read_bytes() == CONTENT for path in out.iterdir())

        client.delete_job(job.id)
        client.delete_capture(capture.id)
    assert files_of(s3_endpoint) == []


def test_download_from_s3_goes_on_where_it_broke_off(cluster: Service, tmp_path: Path) -> None:
    job = cluster.job()
    finish_job(cluster.services, job["id"], lambda name: CONTENT)
    answer = cluster.http.get(f"/v1/jobs/{job['id']}/artifacts/mesh.glb")
    assert answer.status_code == 307
    assert "X-Amz-Signature" in answer.headers["location"]
    head = cluster.http.head(f"/v1/jobs/{job['id']}/artifacts/mesh.glb")
    assert (head.status_code, head.headers["etag"]) == (200, f'"{DIGEST}"')
    with Client(str(cluster.http.base_url), KEY) as client:
        (artifact,) = (one for one in client.artifacts(job["id"]) if one.name == "mesh.glb")
        part = Download(artifact, tmp_path, None).part
        part.write_bytes(CONTENT[:1_000_000])
        seen: list[int] = []
        (path,) = client.download(
            job["id"],
            tmp_path,
            names=["mesh.glb"],
            progress=lambda name, done, total: seen.append(done),
        )
    assert path.read_bytes() == CONTENT
    assert seen[0] > 1_000_000, "it began anew"


def test_new_job_rings_the_bell_with_the_stage_id_alone(
    cluster: Service, redis_server: RedisServer
) -> None:
    job = cluster.job()
    with redis.Redis.from_url(redis_server.url) as connection:
        deadline = time.monotonic() + 10
        while not connection.llen(QUEUE_CPU):
            assert time.monotonic() < deadline
            time.sleep(0.05)
        (raw,) = connection.lrange(QUEUE_CPU, 0, -1)
    message = json.loads(raw)
    assert f"{job['id']}-ingest" in json.dumps(message)
    assert "garden" not in json.dumps(message)


def test_store_that_is_away_is_a_503_and_nothing_is_recorded(
    tmp_path: Path,
) -> None:
    settings = settings_for(
        tmp_path / "home",
        objects_url="s3://bucket-name/prefix",
        s3_endpoint_url=f"http://127.0.0.1:{free_port()}",
        s3_access_key_id="key",
        s3_secret_access_key="secret",
    )
    with serving(settings) as service:
        answer = service.http.post(
            "/v1/captures", files={"file": ("a.zip", zip_of_pictures())}, timeout=120
        )
        problem(answer, 503, "object_store_unavailable")
        assert service.http.get("/v1/captures").json()["items"] == []
        assert service.objects() == []


class ApiProcess:
    """`python -m api` on one port and one home, to be killed and started again."""

    def __init__(self, home: Path) -> None:
        self.home = home
        self.port = free_port()
        self.url = f"http://127.0.0.1:{self.port}"
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        environment = {
            **os.environ,
            "NERFWORKS_HOME": str(self.home),
            "NERFWORKS_DATABASE_URL": "",
            "NERFWORKS_OBJECTS_URL": "",
            "NERFWORKS_REDIS_URL": "redis://127.0.0.1:1/0",
            "NERFWORKS_BOOTSTRAP_API_KEY": KEY,
            "NERFWORKS_MIN_FREE_BYTES": "0",
        }
        self.process = subprocess.Popen(
            [sys.executable, "-m", "api", "--port", str(self.port)],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
        )

    def wait(self) -> None:
        deadline = time.monotonic() + 60
        while time.monotonic() < deadline:
            try:
                if httpx.get(f"{self.url}/livez").status_code == 200:
                    return
            except httpx.TransportError:
                time.sleep(0.1)
        raise AssertionError("the API does not answer")

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def peak_bytes(self) -> int:
        """The most memory that the process has held so far."""
        assert self.process is not None
        status = Path(f"/proc/{self.process.pid}/status").read_text("ascii")
        (line,) = (line for line in status.splitlines() if line.startswith("VmHWM"))
        return int(line.split()[1]) * 1024


@pytest.fixture
def process(tmp_path: Path) -> Iterator[ApiProcess]:
    """A running API process."""
    made = ApiProcess(tmp_path / "home")
    made.start()
    made.wait()
    yield made
    made.kill()


@pytest.mark.skipif(
    not Path("/proc/self/status").exists(),
    reason="what an upload takes of memory is NOT tested: there is no /proc to read it from",
)
def test_large_upload_takes_little_memory_on_both_sides(
    process: ApiProcess, tmp_path: Path
) -> None:
    large = tmp_path / "large.mp4"
    with large.open("wb") as file:
        file.write(b"\0\0\0\x18ftypisom\0\0\2\0isomiso2")
        file.truncate(300 << 20)
    program = (
        "import sys, resource; from nerfworks import Client\n"
        "before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss\n"
        "with Client(sys.argv[1], sys.argv[2]) as client:\n"
        "    print(client.upload(sys.argv[3]).bytes)\n"
        "print(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before)\n"
    )
    before = process.peak_bytes()
    done = subprocess.run(
        [sys.executable, "-c", program, process.url, KEY, str(large)],
        check=True,
        capture_output=True,
        text=True,
        cwd=ROOT,
    )
    sent, grown_kb = done.stdout.split()
    assert int(sent) == 300 << 20
    assert int(grown_kb) < 48 << 10
    assert process.peak_bytes() - before < 64 << 20


def test_client_waits_and_sends_again_while_the_api_is_killed(
    process: ApiProcess, tmp_path: Path
) -> None:
    archive = tmp_path / "large.mp4"
    with archive.open("wb") as file:
        file.write(b"\0\0\0\x18ftypisom\0\0\2\0isomiso2")
        file.truncate(64 << 20)
    killed = threading.Event()

    def kill_once(done: int, total: int) -> None:
        if not killed.is_set() and done > total // 2:
            killed.set()
            process.kill()
            assert list((process.home / "staging").iterdir()), "the upload was under way"
            process.start()

    with Client(process.url, KEY) as client:
        capture = client.upload(archive, kill_once)
        assert [one.id for one in client.captures()] == [capture.id]
        job = client.create_job(capture.id)
        process.kill()
        process.start()
        threading.Timer(1.0, lambda: httpx_cancel(process, job.id)).start()
        assert client.wait(job.id, timeout=60).state == "cancelled"
    assert list((process.home / "staging").iterdir()) == []


def httpx_cancel(process: ApiProcess, job_id: str) -> None:
    with Client(process.url, KEY) as client:
        client.cancel(job_id)
