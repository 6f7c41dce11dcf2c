"""Uploads: what is taken, what is refused, and that nothing of the refused is left."""

from __future__ import annotations

import asyncio
import fcntl
import hashlib
import io
import json
import socket
import subprocess
import sys
import time
import tracemalloc
import zipfile
from collections.abc import AsyncIterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import httpx
import pytest

from api.captures.receiving import (
    Body,
    Limits,
    clean_filename,
    receive,
    staging_file,
    sweep,
)
from api.problems import ApiError
from storage.models import Capture
from storage.objects import ObjectStat
from storage.objects_local import LocalObjectStore
from tests.unit.api.conftest import (
    KEY,
    LiveServer,
    Service,
    problem,
    serving,
    settings_for,
    zip_of_pictures,
)

BOUNDARY = "frontier"
FORM = {"Content-Type": f"multipart/form-data; boundary={BOUNDARY}"}


def form(*parts: tuple[str, bytes], closed: bool = True) -> bytes:
    body = b"".join(
        b"--frontier\r\n" + disposition.encode() + b"\r\n\r\n" + content + b"\r\n"
        for disposition, content in parts
    )
    return body + (b"--frontier--\r\n" if closed else b"")


def disposition(name: str, filename: str = "") -> str:
    extra = f'; filename="{filename}"' if filename else ""
    return f'Content-Disposition: form-data; name="{name}"{extra}'


def test_upload_answers_what_the_bytes_are(service: Service) -> None:
    content = zip_of_pictures()
    answer = service.http.post("/v1/captures", files={"file": ("misnamed.mp4", content)})
    assert answer.status_code == 201
    made = answer.json()
    assert answer.headers["location"] == f"/v1/captures/{made['id']}"
    assert made["kind"] == "images"
    assert made["filename"] == "misnamed.mp4"
    assert made["bytes"] == len(content)
    assert made["sha256"] == hashlib.sha256(content).hexdigest()
    assert made["details"]["num_images"] == 3
    assert service.http.get(f"/v1/captures/{made['id']}").json() == made
    (kept,) = service.objects()
    assert kept.read_bytes() == content


def test_captures_are_listed_newest_first_in_pages(service: Service) -> None:
    ids = [service.upload()["id"] for _ in range(5)]
    seen, cursor = [], None
    for _ in range(3):
        page = service.http.get(
            "/v1/captures", params={"limit": 2, **({"cursor": cursor} if cursor else {})}
        ).json()
        seen += [item["id"] for item in page["items"]]
        cursor = page["next_cursor"]
    assert cursor is None
    assert seen == ids[::-1]


def test_deleted_capture_is_gone_with_its_bytes(service: Service) -> None:
    made = service.upload()
    assert service.http.delete(f"/v1/captures/{made['id']}").status_code == 204
    assert service.objects() == []
    problem(service.http.get(f"/v1/captures/{made['id']}"), 404, "capture_not_found")
    problem(service.http.delete(f"/v1/captures/{made['id']}"), 404, "capture_not_found")
    assert service.http.get("/v1/captures").json()["items"] == []


def test_the_same_file_twice_is_stored_once_and_goes_with_the_last_capture(
    service: Service,
) -> None:
    content = zip_of_pictures()
    first, second = service.upload(content), service.upload(content, "again.zip")
    assert first["id"] != second["id"]
    assert second["filename"] == "again.zip"
    (kept,) = service.objects()
    assert service.http.delete(f"/v1/captures/{first['id']}").status_code == 204
    assert service.objects() == [kept]
    job = service.job(second["id"])
    with service.services.database.read_scope() as session:
        capture = session.get_one(Capture, job["capture_id"])
        assert b"".join(service.services.store.read(capture.object_key)) == content
    service.http.post(f"/v1/jobs/{job['id']}/cancel")
    assert service.http.delete(f"/v1/captures/{second['id']}").status_code == 204
    assert service.objects() == []
    service.upload(content)
    assert len(service.objects()) == 1


@pytest.mark.parametrize("left", [None, b"", b"half"])
def test_bytes_that_the_store_lost_come_back_with_the_next_upload(
    service: Service, left: bytes | None
) -> None:
    content = zip_of_pictures()
    service.upload(content)
    (lost,) = service.objects()
    lost.unlink() if left is None else lost.write_bytes(left)
    service.upload(content)
    assert service.objects() == [lost]
    assert lost.read_bytes() == content


def test_an_upload_whose_twin_is_deleted_meanwhile_is_stored_all_the_same(
    service: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Found when the upload begins to be kept, gone when it is recorded."""
    content = zip_of_pictures()
    twin = service.upload(content)
    look = LocalObjectStore.stat

    def look_and_delete(store: LocalObjectStore, key: str) -> ObjectStat:
        found = look(store, key)
        assert service.http.delete(f"/v1/captures/{twin['id']}").status_code == 204
        return found

    monkeypatch.setattr(LocalObjectStore, "stat", look_and_delete)
    service.upload(content)
    (kept,) = service.objects()
    assert kept.read_bytes() == content


def test_four_uploads_of_one_file_at_once_leave_one_copy(service: Service) -> None:
    content = zip_of_pictures()
    with ThreadPoolExecutor(4) as pool:
        ids = {made["id"] for made in pool.map(service.upload, [content] * 4)}
    assert len(ids) == 4
    assert len(service.objects()) == 1
    for made in ids:
        assert service.http.delete(f"/v1/captures/{made}").status_code == 204
    assert service.objects() == []


def test_capture_with_an_unfinished_job_is_not_deleted(service: Service) -> None:
    job = service.job()
    path = f"/v1/captures/{job['capture_id']}"
    problem(service.http.delete(path), 409, "conflict")
    assert len(service.objects()) == 1
    service.http.post(f"/v1/jobs/{job['id']}/cancel")
    assert service.http.delete(path).status_code == 204


def hostile_zip(name: str, content: bytes = b"x") -> bytes:
    packed = io.BytesIO()
    with zipfile.ZipFile(packed, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr(name, content)
    return packed.getvalue()


@pytest.mark.parametrize(
    ("content", "status", "code"),
    [
        (b"", 422, "empty_file"),
        (b"just some text", 415, "unknown_type"),
        (hostile_zip("notes.txt"), 422, "no_images"),
        (hostile_zip("../escape.png"), 422, "archive_unsafe"),
        (hostile_zip("/etc/escape.png"), 422, "archive_unsafe"),
        (hostile_zip("bomb.png", bytes(30 << 20)), 413, "archive_bomb"),
    ],
)
def test_useless_file_is_refused_and_leaves_nothing(
    service: Service, content: bytes, status: int, code: str
) -> None:
    answer = service.http.post("/v1/captures", files={"file": ("capture.zip", content)})
    problem(answer, status, code)
    assert service.objects() == []
    assert service.http.get("/v1/captures").json()["items"] == []


@pytest.mark.parametrize(
    ("body", "status", "code"),
    [
        (form((disposition("other"), b"x")), 422, "file_missing"),
        (
            form((disposition("file", "a"), b"x"), (disposition("file", "b"), b"y")),
            422,
            "file_repeated",
        ),
        (form((disposition("file", "a"), b"x"), closed=False), 422, "upload_truncated"),
        (b"this is no form", 422, "multipart_malformed"),
        (b"", 422, "file_missing"),
        (form((disposition("note"), bytes(70_000))), 422, "multipart_malformed"),
        (form(*[(disposition("note"), b"x")] * 20), 422, "multipart_malformed"),
    ],
)
def test_wrong_form_is_refused(service: Service, body: bytes, status: int, code: str) -> None:
    problem(service.http.post("/v1/captures", content=body, headers=FORM), status, code)
    assert service.objects() == []


@pytest.mark.parametrize(
    "content_type", ["application/json", "multipart/form-data", "application/octet-stream"]
)
def test_body_that_is_no_form_is_refused(service: Service, content_type: str) -> None:
    answer = service.http.post(
        "/v1/captures", content=b"{}", headers={"Content-Type": content_type}
    )
    problem(answer, 415, "unsupported_type")


def test_upload_over_the_limit_is_refused_by_its_length_and_while_it_streams(
    tmp_path: Path,
) -> None:
    body = form((disposition("file", "a.zip"), bytes(3 << 20)))

    def pieces() -> Any:
        yield from (body[at : at + 65536] for at in range(0, len(body), 65536))

    with serving(settings_for(tmp_path, max_upload_bytes=1 << 20)) as service:
        problem(service.http.post("/v1/captures", content=body, headers=FORM), 413, "too_large")
        answer = service.http.post("/v1/captures", content=pieces(), headers=FORM)
        assert "content-length" not in answer.request.headers
        problem(answer, 413, "too_large")
        assert service.objects() == []


def test_upload_is_refused_where_the_disk_has_too_little_left(tmp_path: Path) -> None:
    with serving(settings_for(tmp_path, min_free_bytes=2**60)) as service:
        answer = service.http.post("/v1/captures", files={"file": ("a.zip", zip_of_pictures())})
        problem(answer, 507, "disk_full")
        assert service.objects() == []


def test_broken_off_upload_leaves_nothing(live: LiveServer) -> None:
    staging = live.settings.staging_dir
    head = (
        "POST /v1/captures HTTP/1.1\r\nHost: test\r\nContent-Length: 9000000\r\n"
        f"Authorization: Bearer {KEY}\r\nContent-Type: {FORM['Content-Type']}\r\n\r\n"
    )
    body = form((disposition("file", "a.zip"), bytes(4 << 20)), closed=False)
    with socket.create_connection(("127.0.0.1", live.port)) as connection:
        connection.sendall(head.encode() + body)
        wait_until(lambda: any(path.stat().st_size for path in staging.iterdir()))
    wait_until(lambda: not any(staging.iterdir()))
    assert not list((live.settings.home / "objects").rglob("*/content"))


def wait_until(question: Any) -> None:
    deadline = time.monotonic() + 10
    while not question():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_start_removes_what_a_killed_process_left_but_not_a_running_upload(tmp_path: Path) -> None:
    with staging_file(tmp_path) as (held, file):
        file.write(b"still coming")
        orphan = tmp_path / "0123.upload"
        orphan.write_bytes(b"left behind")
        assert sweep(tmp_path) == 1
        assert held.exists()
        assert not orphan.exists()
    assert not held.exists()


def test_a_sweep_that_comes_before_the_lock_costs_no_upload(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Another API starts in the same home at the worst moment."""
    swept = []

    def lock_late(file: Any, how: int) -> None:
        monkeypatch.undo()
        swept.append(sweep(tmp_path))
        fcntl.flock(file, how)

    monkeypatch.setattr("api.captures.receiving.fcntl.flock", lock_late)
    with staging_file(tmp_path) as (held, file):
        file.write(b"comes in")
        assert held.read_bytes() == b"comes in"
    assert swept == [1]
    assert not any(tmp_path.iterdir())


KILLED = """
import fcntl, os, sys
from pathlib import Path
from api.captures import receiving
how = sys.argv[2]
if how == "before the lock":
    fcntl.flock = lambda *_: os._exit(9)
with receiving.staging_file(Path(sys.argv[1])) as (path, file):
    file.write(b"half")
    os._exit(9)
"""


@pytest.mark.parametrize("moment", ["before the lock", "while it comes in"])
def test_what_an_api_leaves_that_is_killed_the_next_start_removes(
    tmp_path: Path, moment: str
) -> None:
    command = [sys.executable, "-c", KILLED, str(tmp_path), moment]
    assert subprocess.run(command, check=False).returncode == 9
    assert len([*tmp_path.iterdir()]) == 1
    assert sweep(tmp_path) == 1
    assert not any(tmp_path.iterdir())


async def _received(
    body: bytes, chunk: int, folder: Path, limits: Limits
) -> tuple[str, int, str, bytes]:
    pieces = [body[at : at + chunk] for at in range(0, len(body), chunk)]

    async def messages() -> AsyncIterator[dict[str, Any]]:
        for number, piece in enumerate(pieces, start=1):
            yield {"type": "http.request", "body": piece, "more_body": number < len(pieces)}

    stream = messages()
    with staging_file(folder) as staging:
        got = await receive(
            Body(lambda: anext(stream)), FORM["Content-Type"], str(len(body)), staging, limits
        )
        return got.filename, got.bytes, got.sha256, got.path.read_bytes()


@pytest.mark.parametrize("chunk", [1, 7, 61, 100_000])
def test_parts_are_found_wherever_the_stream_is_cut(tmp_path: Path, chunk: int) -> None:
    content = b"\r\n--frontie\r\n--front--\r\n" * 40 + b"\r"
    body = form((disposition("note"), b"hello"), (disposition("file", "w.mp4"), content))
    name, size, sha256, kept = asyncio.run(_received(body, chunk, tmp_path, Limits(10**6, 0)))
    assert (name, size, kept) == ("w.mp4", len(content), content)
    assert sha256 == hashlib.sha256(content).hexdigest()


def test_an_upload_that_is_too_slow_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    moment = [1000.0]
    monkeypatch.setattr("api.captures.receiving.time.monotonic", lambda: moment[0])

    async def drips() -> dict[str, Any]:
        moment[0] += 5.0
        return {"type": "http.request", "body": bytes(1000), "more_body": True}

    async def run(min_bytes_per_s: int) -> int:
        taken = 0
        async for chunk in Body(drips, min_bytes_per_s).chunks():
            taken += len(chunk)
            if taken == 100_000:
                break
        return taken

    assert asyncio.run(run(180)) == 100_000  # 200 bytes a second
    with pytest.raises(ApiError) as caught:
        asyncio.run(run(1000))
    assert (caught.value.status, caught.value.code) == (408, "upload_stalled")
    assert moment[0] <= 1000 + 500 + 80, "a minute's patience, not more"


def test_no_more_uploads_come_in_than_may(tmp_path: Path) -> None:
    server = LiveServer(settings_for(tmp_path / "home", max_uploads=2))
    server.start()
    head = (
        "POST /v1/captures HTTP/1.1\r\nHost: test\r\nContent-Length: 9000000\r\n"
        f"Authorization: Bearer {KEY}\r\nContent-Type: {FORM['Content-Type']}\r\n\r\n"
    ).encode()
    try:
        with (
            httpx.Client(base_url=server.url, headers={"Authorization": f"Bearer {KEY}"}) as http,
            ExitStack() as held,
        ):
            for _ in range(2):
                slow = held.enter_context(socket.create_connection(("127.0.0.1", server.port)))
                slow.sendall(head + b"--")
            wait_until(lambda: len([*server.settings.staging_dir.glob("*.upload")]) == 2)
            files = {"file": ("a.zip", zip_of_pictures())}
            refused = http.post("/v1/captures", files=files)
            problem(refused, 503, "uploads_busy")
            assert refused.headers["retry-after"]
            held.close()
            wait_until(lambda: http.post("/v1/captures", files=files).status_code == 201)
    finally:
        server.stop()


def test_a_small_body_that_does_not_end_is_given_up(tmp_path: Path) -> None:
    server = LiveServer(settings_for(tmp_path / "home", small_body_s=0.3))
    server.start()
    try:
        with socket.create_connection(("127.0.0.1", server.port), timeout=10) as slow:
            slow.sendall(
                b"POST /v1/jobs HTTP/1.1\r\nHost: test\r\nContent-Length: 90\r\n"
                b"Content-Type: application/json\r\n"
                + f"Authorization: Bearer {KEY}\r\n\r\n".encode()
                + b'{"capture_id": '
            )
            answer = slow.recv(4096)
            assert answer.startswith(b"HTTP/1.1 408")
            assert b"request_timeout" in answer + slow.recv(4096)
    finally:
        server.stop()


def test_receiving_holds_little_memory(tmp_path: Path) -> None:
    piece = bytes(1 << 20)
    head = b"--frontier\r\n" + disposition("file", "big").encode() + b"\r\n\r\n"

    async def messages() -> AsyncIterator[dict[str, Any]]:
        yield {"type": "http.request", "body": head, "more_body": True}
        for _ in range(64):
            yield {"type": "http.request", "body": piece, "more_body": True}
        yield {"type": "http.request", "body": b"\r\n--frontier--\r\n"}

    async def run() -> int:
        stream = messages()
        with staging_file(tmp_path) as staging:
            got = await receive(
                Body(lambda: anext(stream)), FORM["Content-Type"], None, staging, Limits(10**9, 0)
            )
            return got.bytes

    tracemalloc.start()
    assert asyncio.run(run()) == 64 << 20
    _, peak = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert peak < 8 << 20


def test_announced_length_over_the_limit_is_refused_before_a_byte_is_read() -> None:
    limits = Limits(10**6, 0)
    with pytest.raises(ApiError, match="larger than"):
        limits.check_length(str(10**8))
    assert limits.check_length("1000") == 1000
    assert limits.check_length(None) == 0


@pytest.mark.parametrize(
    ("raw", "clean"),
    [
        (b"walk.mp4", "walk.mp4"),
        (b"../../etc/passwd", "passwd"),
        (b"C:\\films\\walk.mp4", "walk.mp4"),
        ("día\u202e.zip".encode(), "día.zip"),
        (b"a\r\nX-Evil: 1", "aX-Evil: 1"),
        (b"", "capture"),
        (b"x" * 400, "x" * 255),
        (b"\xff\xfe.zip", "\ufffd\ufffd.zip"),
    ],
)
def test_file_names_lose_folders_and_control_characters(raw: bytes, clean: str) -> None:
    assert clean_filename(raw) == clean


def test_openapi_describes_the_upload_as_a_form(service: Service) -> None:
    document = json.loads(service.anyone.get("/openapi.json").text)
    content = document["paths"]["/v1/captures"]["post"]["requestBody"]["content"]
    assert content["multipart/form-data"]["schema"]["required"] == ["file"]
