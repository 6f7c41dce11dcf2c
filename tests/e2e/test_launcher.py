"""`make up` and `make demo` as a terminal sees them: what is printed, kept, and left behind."""

from __future__ import annotations

import json
import os
import signal
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import httpx
import pytest

from deploy.embedded import free_port
from pipelines.sample.film import film_capture
from tests.e2e.processes import processes_mentioning

pytestmark = [pytest.mark.services, pytest.mark.slow]

ROOT = Path(__file__).resolve().parent.parent.parent


def environment(home: Path) -> dict[str, str]:
    return {
        **os.environ,
        "NERFWORKS_HOME": str(home),
        "PYTHONPATH": str(ROOT),
        "PYTHONUNBUFFERED": "1",
    }


def wait_for(path: Path, process: subprocess.Popen[str], timeout_s: float = 60.0) -> None:
    deadline = time.monotonic() + timeout_s
    while not path.exists():
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline, f"{path.name} did not appear"
        time.sleep(0.1)


@contextmanager
def up(home: Path, port: int) -> Iterator[subprocess.Popen[str]]:
    process = subprocess.Popen(
        [sys.executable, "-m", "deploy.local", "--port", str(port)],
        cwd=home.parent,
        env=environment(home),
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    try:
        wait_for(home / "service.json", process)
        yield process
    finally:
        if process.poll() is None:
            process.send_signal(signal.SIGINT)
        process.communicate(timeout=40)


def test_up_writes_its_url_and_key_for_its_owner_alone_and_leaves_nothing(tmp_path: Path) -> None:
    home, port = tmp_path / "home", free_port()
    with up(home, port) as process:
        file = home / "service.json"
        assert stat.S_IMODE(file.stat().st_mode) == 0o600
        service = json.loads(file.read_text("utf-8"))
        assert service["url"] == f"http://127.0.0.1:{port}"
        headers = {"Authorization": f"Bearer {service['api_key']}"}
        assert httpx.get(f"{service['url']}/v1/jobs", headers=headers).status_code == 200
        assert httpx.get(f"{service['url']}/v1/jobs").status_code == 401

        second = subprocess.run(
            [sys.executable, "-m", "deploy.local", "--port", str(free_port())],
            cwd=tmp_path,
            env=environment(home),
            capture_output=True,
            text=True,
            timeout=60,
        )
        assert second.returncode == 1
        assert "already runs" in second.stderr
    assert process.returncode == 0
    assert not file.exists()
    assert processes_mentioning(str(home)) == []


def test_key_stays_the_same_over_a_restart(tmp_path: Path) -> None:
    home = tmp_path / "home"
    keys = []
    for _ in range(2):
        with up(home, free_port()):
            keys.append(json.loads((home / "service.json").read_text("utf-8"))["api_key"])
    assert keys[0] == keys[1]


def test_killed_launcher_takes_its_processes_along(tmp_path: Path) -> None:
    home = tmp_path / "home"
    with up(home, free_port()) as process:
        assert processes_mentioning(str(home))
        process.kill()
        process.wait()
        deadline = time.monotonic() + 20
        while processes_mentioning(str(home)) and time.monotonic() < deadline:
            time.sleep(0.2)
        assert processes_mentioning(str(home)) == []


def test_demo_stops_all_it_started_when_interrupted_and_when_it_fails(tmp_path: Path) -> None:
    broken = tmp_path / "broken.mp4"
    broken.write_bytes(b"this is no video" * 100)
    home = tmp_path / "home"
    failed = subprocess.run(
        [sys.executable, "-m", "deploy.demo"],
        cwd=tmp_path,
        env={**environment(home), "CAPTURE": str(broken)},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert failed.returncode == 1
    assert "Traceback" not in failed.stdout + failed.stderr
    assert processes_mentioning(str(home)) == []

    # The demo films its sample once and keeps it there; here it is interrupted before it matters
    # how large that is.
    (home / "cache").mkdir(exist_ok=True)
    film_capture(home / "cache" / "sample.mp4", num_frames=80, long_side_px=160)
    process = subprocess.Popen(
        [sys.executable, "-m", "deploy.demo"],
        cwd=tmp_path,
        env={**environment(home), "CAPTURE": ""},
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        start_new_session=True,
    )
    deadline = time.monotonic() + 120
    while not any("worker" in command for command in processes_mentioning(str(home))):
        assert process.poll() is None, process.communicate()[0]
        assert time.monotonic() < deadline
        time.sleep(0.2)
    time.sleep(2.0)
    os.killpg(process.pid, signal.SIGINT)
    output, _ = process.communicate(timeout=60)
    assert process.returncode == 130, output
    assert "Filming" not in output
    assert processes_mentioning(str(home)) == []
