"""What a stage cannot do, tried from inside a stage, in a real stage process."""

from __future__ import annotations

import json
import os
import signal
import socket
import sqlite3
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.nerf.devices import GPU_EXPECTED
from pipelines.workspace import Workspace
from storage.settings import StorageSettings
from tests.integration.engine import is_running
from tests.photo_writers import dng, heic
from worker.containment import landlock
from worker.containment.apply import ContainmentError, apply_plan
from worker.containment.environment import stage_environment
from worker.containment.plan import Plan
from worker.containment.planning import check_plan, make_plan, open_except
from worker.process import StageProcess
from worker.settings import WorkerSettings

REGISTRY = "tests.unit.worker.nosy_stages"
SECRET = "swordfish-7261"
MIB = 2**20
ROOT = Path(__file__).resolve().parents[3]

linux = pytest.mark.skipif(
    sys.platform != "linux", reason="containment is NOT tested: only Linux has it"
)
files_closed = pytest.mark.skipif(
    landlock.version() < landlock.OLDEST,
    reason="containment is NOT tested: this kernel has no Landlock",
)
signals_closed = pytest.mark.skipif(
    landlock.version() < 6, reason="closed signals are NOT tested: no Landlock 6"
)


class Nosy:
    """A home with secrets, and a stage process beside it that tries what it is told."""

    def __init__(self, folder: Path, *, has_gpu: bool = False, **settings: Any) -> None:
        self.home = folder / "home"
        self.storage = StorageSettings(home=self.home)
        self.plan = make_plan(
            self.storage, WorkerSettings(**settings), self.environment(), has_gpu=has_gpu
        )
        for name in ("secrets.json", "signing.key", "logs/worker.log", "objects/captures/c"):
            path = self.home / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(SECRET)
        with sqlite3.connect(self.home / "nerfworks.db") as database:
            database.execute("CREATE TABLE api_keys (hash TEXT)")
        self.workspace = Workspace(self.storage.work_dir / "job")
        self.workspace.root.mkdir()
        self.process = StageProcess(REGISTRY, self.plan)
        self.messages: list[dict[str, Any]] = []
        self.lines: list[str] = []

    def environment(self) -> dict[str, str]:
        return {
            **os.environ,
            "NERFWORKS_HOME": str(self.home),
            "NERFWORKS_DATABASE_URL": f"postgresql://u:{SECRET}@h/d",
            "NERFWORKS_SECRET_KEY": SECRET,
            "AWS_SECRET_ACCESS_KEY": SECRET,
            "HARMLESS_NAME": SECRET,
        }

    def run(
        self, *strict: list[Any], tolerant: tuple[list[Any], ...] = (), cpu_s: float = 600
    ) -> dict[str, Any]:
        """How a run of these orders ended: its last message."""
        orders = {"tolerant": tolerant, "strict": strict}
        (self.workspace.root / "orders.json").write_text(json.dumps(orders))
        self.process.start_run(
            "r1", self.lines.append, do="run", stage="ingest", token=1, options={}, seed=0,
            root=str(self.workspace.root), threads=1, cpu_s=cpu_s, memory="full",
            temporary=str(self.workspace.temporary("ingest")),
        )  # fmt: skip
        while True:
            message = self.process.messages.get(timeout=120)
            self.messages.append(message)
            if message["type"] in ("done", "failed", "exit"):
                return message

    def ask(self, *orders: list[Any]) -> list[Any]:
        """What came of each order."""
        message = self.run(tolerant=orders)
        assert message["type"] == "done", "\n".join(self.lines)
        said: list[Any] = message["manifest"]["summary"]["said"]
        return said


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Nosy]:
    made = Nosy(tmp_path_factory.mktemp("nosy"))
    yield made
    made.process.kill()


@pytest.fixture
def nosy(shared: Nosy) -> Nosy:
    """The same process for all: it is warm, and must stay so whatever a stage tried."""
    if not shared.process.is_alive():
        shared.process = StageProcess(REGISTRY, shared.plan)
    shared.messages.clear()
    return shared


@linux
@files_closed
def test_secrets_database_and_objects_are_closed_to_a_stage_and_its_programs(nosy: Nosy) -> None:
    paths = [
        *("secrets.json", "signing.key", "nerfworks.db", "logs/worker.log", "objects/captures/c")
    ]
    orders = [["read", str(nosy.home / name)] for name in paths]
    assert nosy.ask(*orders) == ["PermissionError"] * len(paths)
    orders = [["read_by_program", str(nosy.home / name)] for name in paths]
    assert nosy.ask(*orders) == [""] * len(paths)


@linux
@files_closed
def test_a_name_of_its_own_for_a_secret_is_refused(nosy: Nosy) -> None:
    """A worker that uploads a stage's folder would read what the stage cannot."""
    secret = str(nosy.home / "secrets.json")
    assert nosy.ask(["symlink", secret], ["link", secret])[0] == "PermissionError"
    assert not any(path.is_symlink() for path in nosy.workspace.root.rglob("*"))
    assert not list(nosy.workspace.root.rglob("link"))


@linux
@files_closed
def test_its_parents_environment_and_memory_are_closed(nosy: Nosy) -> None:
    me = os.getpid()
    orders: list[list[Any]] = [
        *(["read", f"/proc/{pid}/{name}"] for pid in (me, 1) for name in ("environ", "mem")),
        *(["peek", me], ["trace", me]),
    ]
    assert nosy.ask(*orders) == ["PermissionError"] * len(orders)


@linux
def test_a_stage_gets_no_variable_that_is_not_on_the_list(nosy: Nosy) -> None:
    own, programs = nosy.ask(["environment"], ["environment_of_program"])
    assert SECRET not in json.dumps(own)
    assert SECRET not in programs
    assert own["NERFWORKS_HOME"] == str(nosy.home)
    assert own["HOME"] == str(nosy.home / "cache" / "home")


@linux
@files_closed
def test_a_stage_writes_to_its_job_and_caches_alone(nosy: Nosy, tmp_path: Path) -> None:
    elsewhere = [
        *(nosy.home / "secrets.json", nosy.home / "new", tmp_path / "new", "/tmp/nosy-was-here"),
        *(ROOT / "worker" / "nosy.py", ROOT / "pipelines" / "__pycache__" / "nosy.pyc"),
        "/proc/sys/kernel/core_pattern",
    ]
    orders = [["write", str(path)] for path in elsewhere]
    assert nosy.ask(*orders) == ["PermissionError"] * len(orders)
    assert (nosy.home / "secrets.json").read_text() == SECRET


@linux
@files_closed
def test_with_a_gpu_a_stage_names_its_own_threads_and_nothing_more_of_the_kernels_is_open(
    nosy: Nosy, tmp_path: Path
) -> None:
    """NVIDIA's driver does so as it starts, and does not start where it must not."""
    assert nosy.ask(["name_thread"]) == ["PermissionError"]
    beside = Nosy(tmp_path, has_gpu=True)
    try:
        # Twice: the kernel may forget a folder of /proc that nobody holds, and the rule with it.
        assert beside.ask(["name_thread"], ["name_thread"]) == ["nosy", "nosy"]
        theirs = f"/proc/{os.getpid()}/task/{os.getpid()}/comm"
        closed = ["/proc/sys/kernel/core_pattern", theirs, "/proc/self/oom_score_adj"]
        assert beside.ask(*(["write", path] for path in closed)) == ["PermissionError"] * 3
    finally:
        beside.process.kill()


@linux
def test_a_stage_reaches_nobody_over_sockets(nosy: Nosy, tmp_path: Path) -> None:
    with socket.create_server(("127.0.0.1", 0)) as server, socket.socket(socket.AF_UNIX) as local:
        path = f"/tmp/nosy-{os.getpid()}.sock"
        local.bind(path)
        local.listen()
        try:
            port = server.getsockname()[1]
            orders: list[list[Any]] = [
                ["connect", "AF_INET", ["127.0.0.1", port]],
                ["connect", "AF_INET6", ["::1", port]],
                ["connect", "AF_UNIX", path],
            ]
            assert nosy.ask(*orders) == ["PermissionError"] * 3
        finally:
            os.unlink(path)


@linux
@signals_closed
def test_a_stage_cannot_signal_its_worker_or_its_guardian(nosy: Nosy) -> None:
    nosy.ask()  # the guardian is known from the first word on
    pids = [os.getpid(), nosy.process._guardian]
    assert nosy.ask(*(["kill", pid, 0] for pid in pids)) == ["PermissionError"] * 2


@linux
def test_what_stages_do_goes_on_working(nosy: Nosy) -> None:
    pixels = np.random.default_rng(0).integers(0, 256, (64, 96, 3), np.uint8)
    (nosy.workspace.root / "photo.heic").write_bytes(heic(pixels))
    (nosy.workspace.root / "photo.dng").write_bytes(dng(pixels))
    message = nosy.run(["work"])
    assert message["type"] == "done", "\n".join(nosy.lines)
    assert "checkpoint" in [told["type"] for told in nosy.messages]
    assert nosy.run(["environment"])["type"] == "done", "warm, for the next stage"


@linux
def test_what_compiles_kernels_is_contained_and_has_a_temporary_folder(nosy: Nosy) -> None:
    def run(statement: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "worker.containment", "--plan", nosy.plan.to_json()]
        return subprocess.run(
            [*command, "timeit", "-n1", "-r1", statement],
            env=dict(nosy.plan.environment),
            capture_output=True,
            text=True,
            check=False,
        )

    done = run("import tempfile; tempfile.TemporaryFile()")
    assert done.returncode == 0, done.stderr
    if landlock.version() >= landlock.OLDEST:
        done = run(f"open({str(nosy.home / 'secrets.json')!r})")
        assert "PermissionError" in done.stderr
    kept = Path(nosy.plan.environment["NUMBA_CACHE_DIR"])
    assert not list(kept.rglob("*.nbc"))
    done = run(
        "import numpy as np; from pipelines.nerf.engines.cpu.parts.intervals import spread_edges;"
        "edges = np.zeros(3, np.float32); spread_edges(edges, 2, 0.1, 1.0, edges)"
    )
    assert done.returncode == 0, done.stderr
    assert list(kept.rglob("*.nbc")), "what was compiled is kept for the next process"


@linux
def test_too_much_memory_is_an_error_of_the_stage_and_its_process_lives(tmp_path: Path) -> None:
    nosy = Nosy(tmp_path, stage_memory_bytes=600 * MIB)
    try:
        message = nosy.run(["allocate", 700 * MIB])
        assert (message["type"], message["error"]["code"]) == ("failed", "out_of_memory")
        assert nosy.run(["allocate", 100 * MIB])["type"] == "done"
    finally:
        nosy.process.kill()


@linux
def test_files_that_grow_too_large_or_too_many_are_an_error_of_the_stage(tmp_path: Path) -> None:
    nosy = Nosy(tmp_path, stage_file_bytes=MIB, stage_open_files=100)
    try:
        assert nosy.ask(["open_files", 200])[0] < 100
        message = nosy.run(["fill_file", 2 * MIB])
        assert (message["type"], message["error"]["code"]) == ("failed", "file_too_large")
        assert nosy.run(["fill_file", MIB // 2])["type"] == "done"
    finally:
        nosy.process.kill()


@linux
def test_processor_time_ends_and_is_counted_anew_for_each_run(nosy: Nosy) -> None:
    for _ in range(2):
        assert nosy.run(["environment"], cpu_s=1.0)["type"] == "done"
    assert nosy.run(["spin"], cpu_s=1.0)["type"] == "exit"
    assert nosy.process.exit_reason() == (-signal.SIGXCPU, False)


@linux
def test_a_process_that_left_every_group_is_gone_after_the_stage(nosy: Nosy) -> None:
    (pid,) = nosy.ask(["escape"])
    assert is_running(pid)
    assert nosy.process.end_leftovers() == 1
    assert not is_running(pid)
    assert nosy.run(["environment"])["type"] == "done", "and the stage process lives"


@linux
def test_a_process_that_left_every_group_is_gone_with_its_stage_process(nosy: Nosy) -> None:
    (pid,) = nosy.ask(["escape"])
    nosy.process.kill()
    deadline = time.monotonic() + 20
    while is_running(pid) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not is_running(pid)


@linux
def test_temporary_files_go_with_the_run(nosy: Nosy) -> None:
    (folder,) = nosy.ask(["litter"])
    assert Path(folder).is_relative_to(nosy.workspace.root)
    assert not nosy.workspace.temporary("ingest").exists()
    assert nosy.run(["litter"], ["die"])["type"] == "exit"
    assert list(nosy.workspace.temporary("ingest").iterdir())


@linux
def test_processes_are_bounded_for_all_but_root(tmp_path: Path) -> None:
    """Run by another user where we are root, whom the kernel lets have as many as it likes."""
    script = (
        "import os\n"
        "from tests.unit.worker.nosy_stages import VERBS\n"
        "from worker.containment.limits import Limits, apply_limits\n"
        "if os.getuid() == 0:\n"
        "    os.setgroups([]); os.setgid(64321); os.setuid(64321)\n"
        "said = apply_limits(Limits(0, 0, 20, 100))\n"
        "assert 'processes' in said, said\n"
        "print(VERBS['fork_bomb'](None, 100))\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    assert 10 <= int(done.stdout) <= 20


def test_the_environment_is_a_list_of_names(tmp_path: Path) -> None:
    environment = {
        "PATH": "/bin",
        "NERFWORKS_HOME": "/h",
        "NERFWORKS_LPIPS_WEIGHTS": "/w",
        "NERFWORKS_LPIPS_SHA256": "0",
        "NERFWORKS_FFMPEG": "/f",
        "NERFWORKS_DATABASE_URL": "postgresql://u:p@h/d",
        "NERFWORKS_REDIS_URL": "redis://:p@h",
        "NERFWORKS_S3_SECRET_ACCESS_KEY": "s",
        "AWS_ACCESS_KEY_ID": "a",
        "GOOGLE_APPLICATION_CREDENTIALS": "/g",
        "MY_COMPANYS_LOGIN": "k",
        "HTTPS_PROXY": "http://u:p@proxy",
        "OMP_NUM_THREADS": "3",
        "CUDA_VISIBLE_DEVICES": "0",
        "LC_ALL": "C",
        "PYTHONSTARTUP": "/x",
    }
    kept = stage_environment(environment, home=tmp_path, more=["MY_COMPANYS_LICENCE"])
    assert set(kept) - {"PYTHONUSERBASE"} == {
        *("PATH", "NERFWORKS_HOME", "NERFWORKS_LPIPS_SHA256", "NERFWORKS_LPIPS_WEIGHTS"),
        *("NERFWORKS_FFMPEG", "OMP_NUM_THREADS", "OMP_WAIT_POLICY", "PYTHONPATH"),
        *("PYTHONUNBUFFERED", "CUDA_VISIBLE_DEVICES", "LC_ALL", "HOME", "NUMBA_CACHE_DIR"),
        "TMPDIR",
    }
    assert kept["OMP_NUM_THREADS"] == "3"
    assert kept["OMP_WAIT_POLICY"] == "passive"
    assert kept["NUMBA_CACHE_DIR"] == "/h/numba"
    wanted = {"MY_COMPANYS_LOGIN": "k"}
    assert stage_environment(wanted, home=tmp_path, more=wanted)["MY_COMPANYS_LOGIN"] == "k"


def test_an_open_folder_is_split_around_what_is_private(tmp_path: Path) -> None:
    for name in ("code/a.py", "code/.env", "state/home/secret", "state/shown"):
        (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
        (tmp_path / name).touch()
    opened, listed = open_except(tmp_path, [tmp_path / "state" / "home"])
    assert opened == [tmp_path / "code", tmp_path / "state" / "shown"]
    assert listed == [tmp_path, tmp_path / "state"]
    assert open_except(tmp_path / "code", [], hidden=False)[0] == [tmp_path / "code" / "a.py"]
    assert open_except(tmp_path / "state" / "home", [tmp_path / "state"]) == ([], [])


@linux
def test_a_plan_opens_no_folder_that_holds_the_home(tmp_path: Path) -> None:
    home = ROOT / f".nosy-{os.getpid()}"
    try:
        plan = make_plan(StorageSettings(home=home), WorkerSettings(), {}, has_gpu=False)
        assert not [path for path in plan.read if home.is_relative_to(path)]
        assert all(Path(path).is_relative_to(home / name) for path in plan.write
                   for name in ("work", "cache") if path.startswith(f"{home}/{name}"))  # fmt: skip
    finally:
        for path in sorted(home.rglob("*"), reverse=True):
            path.rmdir()
        home.rmdir()


def test_a_plan_survives_its_way_to_the_process(tmp_path: Path) -> None:
    plan = make_plan(StorageSettings(home=tmp_path), WorkerSettings(), {}, has_gpu=True)
    assert Plan.of_json(plan.to_json()) == replace(plan, environment={})
    assert plan.limits.memory_bytes == 0, "CUDA writes to address space that it only reserves"
    assert plan.unix_sockets
    assert plan.environment[GPU_EXPECTED]


def test_without_containment_the_log_says_so(tmp_path: Path) -> None:
    settings = WorkerSettings(contain="off")
    plan = make_plan(StorageSettings(home=tmp_path), settings, {}, has_gpu=False)
    assert apply_plan(plan).as_text() == "nothing. Not: all of it, as NERFWORKS_WORKER_CONTAIN says"
    assert stat.S_ISDIR((tmp_path / "cache" / "home").stat().st_mode)


@linux
def test_a_worker_that_must_contain_its_stages_does_not_start_where_it_cannot(
    tmp_path: Path,
) -> None:
    settings = WorkerSettings(contain="required")
    plan = make_plan(StorageSettings(home=tmp_path), settings, dict(os.environ), has_gpu=False)
    if landlock.version() >= landlock.OLDEST:
        check_plan(plan)
    environment = {**plan.environment, "PYTHONPATH": f"{tmp_path}:{ROOT}"}
    (tmp_path / "sitecustomize.py").write_text(
        "import worker.containment.landlock as landlock\nlandlock.version = lambda: 0\n"
    )
    with pytest.raises(ContainmentError, match="no Landlock in this kernel"):
        check_plan(replace(plan, environment=environment))
    check_plan(replace(plan, environment=environment, mode="auto"))
