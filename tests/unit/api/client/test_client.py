"""The client against a live server: uploads, waiting through restarts, downloads that resume."""

from __future__ import annotations

import hashlib
import json
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import httpx
import pytest

from api.client.client import (
    ApiProblem,
    ChecksumMismatch,
    Client,
    ConnectionFailed,
    FilesInTheWay,
    Job,
    JobFailed,
    NerfworksError,
    WaitTimedOut,
    find_service,
)
from api.client.models import Artifact
from api.client.transfer import Download, safe_target
from storage.jobs import request_cancel
from tests.services import free_port
from tests.unit.api.conftest import (
    KEY,
    NUM_ARTIFACTS,
    LiveServer,
    finish_job,
    settings_for,
    zip_of_pictures,
)

ROOT = Path(__file__).resolve().parents[4]
CONTENT = bytes(range(256)) * 4096
DIGEST = hashlib.sha256(CONTENT).hexdigest()


@pytest.fixture
def client(live: LiveServer) -> Iterator[Client]:
    with Client(live.url, KEY, retry_s=20) as made:
        yield made


@pytest.fixture
def archive(tmp_path: Path) -> Path:
    path = tmp_path / 'my "garden".zip'
    path.write_bytes(zip_of_pictures())
    return path


@pytest.fixture
def finished(live: LiveServer, client: Client, archive: Path) -> str:
    job = client.create_job(client.upload(archive).id)
    finish_job(live.services, job.id, lambda name: CONTENT)
    return job.id


def test_upload_reports_progress_and_keeps_the_name(client: Client, archive: Path) -> None:
    seen: list[tuple[int, int]] = []
    capture = client.upload(archive, lambda done, total: seen.append((done, total)))
    size = archive.stat().st_size
    assert seen[-1] == (size, size)
    assert capture.filename == archive.name
    assert capture.sha256 == hashlib.sha256(archive.read_bytes()).hexdigest()
    assert client.get_capture(capture.id) == capture
    assert list(client.captures()) == [capture]
    client.delete_capture(capture.id)
    assert list(client.captures()) == []


def test_refused_upload_is_a_problem_even_in_the_middle_of_sending(tmp_path: Path) -> None:
    large = tmp_path / "large.bin"
    with large.open("wb") as file:
        file.truncate(200 << 20)
    server = LiveServer(settings_for(tmp_path / "home", max_upload_bytes=1 << 20))
    server.start()
    try:
        with Client(server.url, KEY) as client, pytest.raises(ApiProblem) as caught:
            client.upload(large)
        assert (caught.value.status, caught.value.code) == (413, "too_large")
        with Client(server.url, "wrong") as client, pytest.raises(ApiProblem) as caught:
            client.upload(large)
        assert caught.value.code == "unauthorized"
        assert not list(server.settings.staging_dir.iterdir())
    finally:
        server.stop()


def test_missing_file_is_an_error_of_ours(client: Client, tmp_path: Path) -> None:
    with pytest.raises(NerfworksError, match="cannot be read"):
        client.upload(tmp_path / "nothing.mp4")


def test_problem_carries_code_hint_and_each_wrong_value(client: Client, archive: Path) -> None:
    capture = client.upload(archive)
    with pytest.raises(ApiProblem) as caught:
        client.create_job(capture.id, options={"train": {"max_stepz": 1}})
    assert (caught.value.status, caught.value.code) == (422, "options_invalid")
    assert caught.value.errors[0][0] == "train.max_stepz"
    assert caught.value.hint


def test_jobs_are_iterated_over_all_pages(client: Client, archive: Path) -> None:
    capture = client.upload(archive)
    ids = [client.create_job(capture.id, labels={"n": str(n)}).id for n in range(53)]
    assert [job.id for job in client.jobs()] == ids[::-1]
    assert [job.id for job in client.jobs(label="n=7")] == [ids[7]]
    assert client.cancel(ids[0]).state == "cancelled"
    assert [job.id for job in client.jobs(state="cancelled")] == [ids[0]]
    client.delete_job(ids[0])
    assert len(list(client.jobs())) == 52


def test_wait_returns_the_job_once_it_is_over(
    live: LiveServer, client: Client, archive: Path
) -> None:
    job = client.create_job(client.upload(archive).id)
    with pytest.raises(WaitTimedOut):
        client.wait(job.id, timeout=0.3)
    states: list[str] = []
    threading.Timer(0.5, lambda: finish_job(live.services, job.id, lambda name: b"x")).start()
    done = client.wait(job.id, on_update=lambda job: states.append(job.state), timeout=30)
    assert done.state == states[-1] == "succeeded"
    assert len(done.artifacts) == NUM_ARTIFACTS


@pytest.mark.parametrize("hangs", [True, False], ids=["hangs", "away"])
def test_a_wait_is_over_on_time_though_no_answer_comes(hangs: bool) -> None:
    with socket.create_server(("127.0.0.1", 0)) as mute:
        port = mute.getsockname()[1] if hangs else free_port()
        begun = time.monotonic()
        with Client(f"http://127.0.0.1:{port}", KEY) as client, pytest.raises(WaitTimedOut) as late:
            client.wait("some-job", timeout=1.0)
    assert 1.0 <= time.monotonic() - begun < 10.0
    assert late.value.job is None
    assert "some-job" in late.value.message
    assert isinstance(late.value.__cause__, ConnectionFailed)


def test_a_wait_whose_service_falls_silent_says_how_the_job_stood(
    client: Client, archive: Path
) -> None:
    job = client.create_job(client.upload(archive).id)
    with socket.create_server(("127.0.0.1", 0)) as mute:
        away = f"http://127.0.0.1:{mute.getsockname()[1]}"

        def fall_silent(_: Job) -> None:
            client._wire.http.base_url = httpx.URL(away)

        with pytest.raises(WaitTimedOut) as late:
            client.wait(job.id, on_update=fall_silent, timeout=2.0)
    assert late.value.job is not None
    assert late.value.job.state == "queued"


def test_wait_raises_for_a_job_that_did_not_succeed_where_asked(
    live: LiveServer, client: Client, archive: Path
) -> None:
    job = client.create_job(client.upload(archive).id)
    client.cancel(job.id)
    assert client.wait(job.id).state == "cancelled"
    with pytest.raises(JobFailed) as caught:
        client.wait(job.id, check=True)
    assert caught.value.job.id == job.id


def test_wait_rides_out_a_restart_of_the_service(
    live: LiveServer, client: Client, archive: Path
) -> None:
    job = client.create_job(client.upload(archive).id)
    looks: list[float] = []

    def restart() -> None:
        live.stop()
        time.sleep(1.0)
        live.start()
        with live.services.database.session_scope() as session:
            request_cancel(session, job.id)

    thread = threading.Timer(0.2, restart)
    thread.start()
    done = client.wait(job.id, on_update=lambda _: looks.append(time.monotonic()), timeout=60)
    thread.join()
    assert done.state == "cancelled"


def test_service_that_stays_away_is_a_connection_failure() -> None:
    started = time.monotonic()
    with (
        Client(f"http://127.0.0.1:{free_port()}", KEY, retry_s=0.5) as client,
        pytest.raises(ConnectionFailed, match="cannot be reached"),
    ):
        client.get_job("x")
    assert 0.4 < time.monotonic() - started < 10


@pytest.mark.parametrize("url", ["ftp://host", "not a url", "http://", "http://[::1"])
def test_address_that_cannot_be_one_is_refused_at_once(url: str) -> None:
    with pytest.raises(ConnectionFailed, match="no usable address"):
        Client(url, KEY)


def test_download_is_verified_whole_and_not_repeated(
    client: Client, finished: str, tmp_path: Path
) -> None:
    seen: dict[str, tuple[int, int]] = {}

    def progress(name: str, done: int, total: int) -> None:
        seen[name] = (done, total)

    out = tmp_path / "out"
    paths = client.download(finished, out, progress=progress)
    assert sorted(path.name for path in out.iterdir()) == sorted(path.name for path in paths)
    assert len(paths) == NUM_ARTIFACTS
    assert all(path.read_bytes() == CONTENT for path in paths)
    assert set(seen.values()) == {(len(CONTENT), len(CONTENT))}
    before = {path: path.stat().st_mtime_ns for path in paths}
    client.download(finished, out)
    assert {path: path.stat().st_mtime_ns for path in paths} == before
    paths[0].write_bytes(b"spoiled")
    client.download(finished, out, names=[paths[0].name], overwrite=True)
    assert paths[0].read_bytes() == CONTENT


def test_files_of_two_jobs_are_not_mixed_in_one_folder(
    client: Client, live: LiveServer, finished: str, archive: Path, tmp_path: Path
) -> None:
    other = client.create_job(client.upload(archive).id).id
    finish_job(live.services, other, lambda name: b"other " + name.encode())
    out = tmp_path / "out"
    first = client.download(finished, out, names=["mesh.glb"])
    with pytest.raises(FilesInTheWay, match=r"mesh\.glb") as caught:
        client.download(other, out)
    assert "another folder" in caught.value.hint
    assert [path.name for path in out.iterdir()] == ["mesh.glb"], "nothing was downloaded"
    assert first[0].read_bytes() == CONTENT
    client.download(other, out, names=["preview.jpg"])
    assert len(client.download(other, out, overwrite=True)) == NUM_ARTIFACTS
    assert first[0].read_bytes() == b"other mesh.glb"


def test_download_of_an_unknown_name_says_what_there_is(
    client: Client, finished: str, tmp_path: Path
) -> None:
    with pytest.raises(NerfworksError, match=r"mesh\.glb"):
        client.download(finished, tmp_path / "out", names=["mesh.nothing"])


class _Slow(BaseHTTPRequestHandler):
    """Breaks the first upload off, late; is busy when it is sent again."""

    uploads: list[int]

    def do_POST(self) -> None:
        cls = type(self)
        cls.uploads.append(len(self.rfile.read(int(self.headers["Content-Length"]))))
        self.close_connection = True
        if len(cls.uploads) == 1:
            time.sleep(0.4)
            return
        body = b'{"code": "busy", "detail": "Not now."}'
        self.send_response(503)
        self.send_header("Content-Length", str(len(body)))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *args: Any) -> None:
        del args


@pytest.mark.parametrize(("retry_s", "most"), [(0.3, 5), (0.0, 1)])
def test_an_upload_that_took_longer_than_one_waits_is_sent_again_all_the_same(
    archive: Path, retry_s: float, most: int
) -> None:
    """It broke off after 0.4 s; then the service is busy for good."""
    uploads: list[int] = []
    handler = type("Handler", (_Slow,), {"uploads": uploads})
    server = HTTPServer(("127.0.0.1", 0), handler)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    try:
        url = f"http://127.0.0.1:{server.server_port}"
        with (
            Client(url, KEY, retry_s=retry_s) as client,
            pytest.raises((ApiProblem, ConnectionFailed)) as caught,
        ):
            client.upload(archive)
    finally:
        server.shutdown()
        server.server_close()
    assert isinstance(caught.value, ApiProblem if retry_s else ConnectionFailed)
    assert (2 if retry_s else 1) <= len(uploads) <= most
    assert len(set(uploads)) == 1, "each time whole"


class _Unreliable(BaseHTTPRequestHandler):
    """Breaks the connection after some bytes of each answer; `mode` says how it treats ranges."""

    mode = "ranges"
    ranges: list[str | None]
    body = CONTENT

    def do_GET(self) -> None:
        cls = type(self)
        if self.path.endswith("/artifacts"):
            entry = {"name": "mesh.glb", "media_type": "x/y", "url": "", "opens_with": ""}
            entry |= {"bytes": len(CONTENT), "sha256": DIGEST}  # type: ignore[dict-item]
            self._answer(200, json.dumps({"items": [entry]}).encode())
            return
        header = self.headers.get("Range")
        cls.ranges.append(header)
        start = int(header[6:-1]) if header else 0
        whole = header is None or self.mode == "none"
        body = cls.body if whole else cls.body[start:]
        extra = {}
        status = 200
        if not whole and self.mode == "ranges":
            status = 206
            extra = {"Content-Range": f"bytes {start}-{len(CONTENT) - 1}/{len(CONTENT)}"}
        limit = 300_000 if len(cls.ranges) < 3 else len(body)
        self._answer(status, body, extra, limit)

    def _answer(
        self, status: int, body: bytes, extra: dict[str, str] | None = None, limit: int = 10**9
    ) -> None:
        self.send_response(status)
        for name, value in {**(extra or {}), "Content-Length": str(len(body))}.items():
            self.send_header(name, value)
        self.end_headers()
        self.wfile.write(body[:limit])
        self.close_connection = True

    def log_message(self, *args: Any) -> None:
        del args


@pytest.fixture
def unreliable() -> Iterator[tuple[str, type[_Unreliable]]]:
    handler = type("Handler", (_Unreliable,), {"ranges": []})
    server = HTTPServer(("127.0.0.1", 0), handler)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    yield f"http://127.0.0.1:{server.server_port}", handler
    server.shutdown()
    thread.join(10)
    server.server_close()


@pytest.mark.parametrize("mode", ["ranges", "ranges as 200", "none"])
def test_download_goes_on_after_the_connection_broke(
    unreliable: tuple[str, type[_Unreliable]], tmp_path: Path, mode: str
) -> None:
    url, handler = unreliable
    handler.mode = mode
    with Client(url, KEY, retry_s=20) as client:
        (path,) = client.download("job", tmp_path)
    assert path.read_bytes() == CONTENT
    assert handler.ranges[0] is None
    assert handler.ranges[1] == "bytes=300000-"
    assert len(handler.ranges) == 3
    assert [entry.name for entry in tmp_path.iterdir()] == ["mesh.glb"]


def test_download_goes_on_from_what_an_earlier_program_left(
    unreliable: tuple[str, type[_Unreliable]], tmp_path: Path
) -> None:
    url, handler = unreliable
    artifact = Artifact(
        name="mesh.glb", media_type="x/y", bytes=len(CONTENT), sha256=DIGEST, url=""
    )
    part = Download(artifact, tmp_path, None).part
    part.write_bytes(CONTENT[:1_000_000])
    with Client(url, KEY) as client:
        (path,) = client.download("job", tmp_path)
    assert path.read_bytes() == CONTENT
    assert handler.ranges == ["bytes=1000000-"]


def test_damaged_start_is_noticed_and_fetched_anew(
    unreliable: tuple[str, type[_Unreliable]], tmp_path: Path
) -> None:
    url, _ = unreliable
    artifact = Artifact(
        name="mesh.glb", media_type="x/y", bytes=len(CONTENT), sha256=DIGEST, url=""
    )
    Download(artifact, tmp_path, None).part.write_bytes(b"?" * 1_000_000)
    with Client(url, KEY) as client:
        (path,) = client.download("job", tmp_path)
    assert path.read_bytes() == CONTENT


def test_bytes_that_are_not_the_promised_ones_never_appear(
    unreliable: tuple[str, type[_Unreliable]], tmp_path: Path
) -> None:
    url, handler = unreliable
    handler.body = CONTENT[:-1] + b"!"
    with Client(url, KEY) as client, pytest.raises(ChecksumMismatch, match=r"mesh\.glb"):
        client.download("job", tmp_path)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", ["../mesh.glb", "/etc/passwd", "..", "", "a\\b", "a\0b"])
def test_artifact_names_that_leave_the_folder_are_refused(tmp_path: Path, name: str) -> None:
    with pytest.raises(NerfworksError, match="unsafe name"):
        safe_target(tmp_path, name)


def test_service_is_found_by_argument_environment_or_folder(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("NERFWORKS_URL", "NERFWORKS_API_KEY", "NERFWORKS_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConnectionFailed, match="No service"):
        find_service()
    (tmp_path / ".nerfworks").mkdir()
    file = tmp_path / ".nerfworks" / "service.json"
    file.write_text(json.dumps({"url": "http://here:1", "api_key": "k1", "pid": 1}))
    assert find_service() == ("http://here:1", "k1")
    assert find_service("http://here:1/") == ("http://here:1", "k1")
    assert find_service("http://elsewhere:2") == ("http://elsewhere:2", "")
    monkeypatch.setenv("NERFWORKS_URL", "http://env:3")
    assert find_service() == ("http://env:3", "")
    monkeypatch.setenv("NERFWORKS_API_KEY", "k3")
    assert find_service() == ("http://env:3", "k3")
    assert find_service("http://arg:4", "k4") == ("http://arg:4", "k4")


def test_client_loads_no_server_code() -> None:
    program = (
        "import sys, nerfworks; print(*sorted({name.split('.')[0] for name in sys.modules} & "
        "{'fastapi', 'starlette', 'sqlalchemy', 'celery', 'boto3', 'storage', 'pipelines', "
        "'worker', 'torch', 'numpy'}))"
    )
    loaded = subprocess.run(
        [sys.executable, "-c", program], check=True, capture_output=True, text=True, cwd=ROOT
    )
    assert loaded.stdout.split() == []
